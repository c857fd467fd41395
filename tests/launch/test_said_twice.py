"""What a folder says twice must agree, or is refused with both files; an option settles it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flocc_agent.geometry import pose, so3_exp
from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_launch.datasets.commands import convert, info
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.said_twice import cameras_differ, motions_differ
from flocc_launch.datasets.source import DatasetError, Lens
from flocc_launch.datasets.unread import unused

CAMERA = "width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 32\ncy: 24\n"
STAMPS_S = np.linspace(1_700_000_000, 1_700_000_001.75, 8)
T = np.array([pose(so3_exp(np.array([0.0, 0.1, 0.1 * k])), np.array([3.0 + 0.2 * k, 2.0, 0.5])) for k in range(8)])
MOTION = Trajectory(STAMPS_S, T)
OTHER = Trajectory(STAMPS_S, T @ pose(so3_exp(np.array([0.0, 0.0, 0.5])), np.array([0.3, 0.1, 0.0])))


def folder(path: Path) -> Path:
    (path / "images").mkdir(parents=True)
    for k, stamp_s in enumerate(STAMPS_S):
        cv2.imwrite(str(path / "images" / f"{stamp_s:.2f}.png"), np.full((48, 64, 3), 20 * k, np.uint8))
    (path / "camera.yaml").write_text(CAMERA)
    write_tum(path / "odometry.tum", MOTION)
    return path


def test_two_trajectories_that_differ_are_refused_until_one_is_named(tmp_path: Path) -> None:
    path = folder(tmp_path / "data")
    write_tum(path / "vio.txt", OTHER)
    sentence = r"odometry.tum and vio.txt tell different motions \(0\.\d\d m and \d+ degrees apart after .* s\): keep"
    for ask in (read_source, info, lambda each: convert(each, tmp_path / "out")):
        with pytest.raises(DatasetError, match=sentence):
            ask(path)
    named = Recording.open(convert(path, tmp_path / "named", odometry=path / "vio.txt"))
    np.testing.assert_allclose(
        named.frames[3].T_odom_body, np.linalg.inv(OTHER.T_fixed_body[0]) @ OTHER.T_fixed_body[3], atol=1e-6
    )


def test_what_is_called_odometry_counts_before_a_trajectory_which_may_be_anything(tmp_path: Path) -> None:
    path = folder(tmp_path / "data")
    write_tum(path / "trajectory.txt", OTHER)
    source = read_source(path)
    assert source.odometry is not None
    np.testing.assert_allclose(source.odometry.T_fixed_body, T, atol=1e-6)
    assert any("odometry.tum: was taken as the odometry, not trajectory.txt" in note for note in source.notes)


def test_two_truths_that_differ_are_refused(tmp_path: Path) -> None:
    path = folder(tmp_path / "data")
    write_tum(path / "groundtruth.txt", MOTION)
    write_tum(path / "gt.tum", OTHER)
    with pytest.raises(
        DatasetError, match=r"groundtruth.txt and gt.tum tell different motions .*: keep the one that counts$"
    ):
        read_source(path)


def test_two_cameras_that_differ_are_refused_until_one_is_named(tmp_path: Path) -> None:
    path = folder(tmp_path / "data")
    (path / "calibration.yaml").write_text(CAMERA.replace("fx: 60", "fx: 66"))
    with pytest.raises(
        DatasetError, match=r"camera.yaml and calibration.yaml describe different cameras \(fx 60 and 66"
    ):
        convert(path, tmp_path / "out")
    assert read_source(path, camera=path / "calibration.yaml").lens.camera.fx == 66  # type: ignore[union-attr]
    (path / "calibration.yaml").write_text("just: text\n")
    assert any("calibration.yaml: " in note and "it was passed over" in note for note in read_source(path).notes)


def test_odometry_beside_a_reconstruction_is_its_odometry(tmp_path: Path) -> None:
    path = folder(tmp_path / "data")
    (path / "camera.yaml").unlink()
    (path / "sparse").mkdir()
    (path / "sparse" / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    (path / "sparse" / "images.txt").write_text(
        "".join(f"{k + 1} 1 0 0 0 {-k} 0 0 1 {stamp_s:.2f}.png\n\n" for k, stamp_s in enumerate(STAMPS_S))
    )
    source = read_source(path)
    assert source.format == "colmap"
    assert source.odometry is not None
    np.testing.assert_allclose(source.odometry.T_fixed_body, T, atol=1e-6)
    (path / "transforms.json").write_text("{}")
    assert any("transforms.json" in note and "passed over" in note for note in read_source(path).notes)


LENS = Lens(CameraModel(64, 48, 60.0, 60.0, 32.0, 24.0))


@pytest.mark.parametrize(
    ("other", "how"),
    [
        (LENS, None),
        (replace(LENS, camera=replace(LENS.camera, fx=60.01)), None),
        (replace(LENS, camera=replace(LENS.camera, width=65)), "of 64x48 and of 65x48 pixels"),
        (replace(LENS, camera=replace(LENS.camera, distortion=(-0.2, 0.0, 0.0, 0.0))), "pixels apart"),
        (
            replace(LENS, camera=replace(LENS.camera, distortion=(0.1, 0.0, 0.0, 0.0), kind=LensKind.EQUIDISTANT)),
            "pinhole and equidistant",
        ),
        (replace(LENS, T_body_camera=T[0]), "differently on the body"),
        (replace(LENS, time_shift_s=0.02), "0 s and 0.02 s off"),
    ],
)
def test_cameras_agree_to_their_digits(other: Lens, how: str | None) -> None:
    found = cameras_differ(LENS, other)
    assert (found is None) == (how is None)
    assert how is None or (found is not None and how in found)


def test_a_calibration_that_says_less_contradicts_nothing() -> None:
    mounted = replace(LENS, T_body_camera=T[0], time_shift_s=0.02)
    assert cameras_differ(mounted, LENS) is None
    assert cameras_differ(LENS, mounted) is not None


def test_a_motion_is_the_same_in_another_frame_and_of_some_of_its_poses() -> None:
    elsewhere = Trajectory(
        STAMPS_S[1::3], pose(so3_exp(np.array([1.0, 0.2, 0.0])), np.array([9.0, 0.0, 1.0])) @ T[1::3]
    )
    assert motions_differ(MOTION, elsewhere) is None
    assert motions_differ(MOTION, MOTION.later(100.0)) == "they have no time in common"


def test_a_published_data_set_names_what_its_reader_passes_over_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "image_0").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "image_0" / f"{k:06d}.png"), np.full((48, 64, 3), 20 * k, np.uint8))
    (tmp_path / "poses.txt").write_text("".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(3)))
    (tmp_path / "calib.txt").write_text("P0: 60 0 32 0 0 60 24 0 0 0 1 0\n")
    write_tum(tmp_path / "odometry.tum", Trajectory(np.array([0.0, 0.1, 0.2]), T[:3]))
    write_tum(tmp_path / "trajectory.tum", MOTION)
    source = read_source(tmp_path)
    assert (source.format, unused(source)) == ("kitti", (f"{tmp_path}: not used: trajectory.tum",))
    (tmp_path / "camera.yaml").write_text(CAMERA.replace("cx: 32", "cx: 30"))
    with pytest.raises(DatasetError, match=r"camera.yaml and calib.txt#P0 describe different cameras"):
        read_source(tmp_path)


def test_two_files_of_stamps_that_differ_are_refused(tmp_path: Path) -> None:
    path = folder(tmp_path / "data")
    for k, image in enumerate(sorted((path / "images").iterdir())):
        image.rename(image.with_name(f"{k:04d}.png"))
    (path / "times.txt").write_text("".join(f"{stamp_s:.2f}\n" for stamp_s in STAMPS_S))
    (path / "timestamps.csv").write_text("".join(f"{k:04d}.png,{1e9 * s:.0f}\n" for k, s in enumerate(STAMPS_S)))
    assert [stamp_s for stamp_s, _ in read_source(path).images] == pytest.approx(STAMPS_S)
    (path / "timestamps.csv").write_text("".join(f"{stamp_s + 0.1:.2f}\n" for stamp_s in STAMPS_S))
    with pytest.raises(DatasetError, match=r"times.txt and timestamps.csv give the images different stamps"):
        read_source(path)
