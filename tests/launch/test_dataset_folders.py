"""Every folder format is read as its publisher describes it, and what is wrong with one is said in one sentence."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import inverse, pose, so3_exp
from flocc_agent.lenses import CameraModel
from flocc_agent.runtime.decoder_noise import quiet_decoders
from flocc_agent.runtime.picture_heads import PictureError
from flocc_agent.runtime.pictures import read_picture
from flocc_agent.runtime.recording import Recording, write_camera
from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_launch.datasets.commands import convert, info, info_lines, infos, split
from flocc_launch.datasets.detect import detect_format, read_source
from flocc_launch.datasets.drift import DriftSpec
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.source import DatasetError
from flocc_protocol.errors import FloccError

Float = NDArray[np.float64]

CAMERA = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
SHARED = Path(os.environ.get("FLOCC_SHARED", Path(__file__).parents[3] / "shared"))


def moving(count: int) -> Float:
    """Poses that start away from the identity, drive on and turn."""
    return np.array([pose(so3_exp(np.array([0.1, 0.0, 0.1 * k])), np.array([5.0 + k, 2.0, 0.5])) for k in range(count)])


def write_image(path: Path, grey: int = 100) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((24, 32, 3), grey, dtype=np.uint8))


def write_plain(path: Path, count: int = 6) -> Path:
    for k in range(count):
        write_image(path / "images" / f"{100 + 0.5 * k:.3f}.png", 10 * k)
    write_tum(path / "groundtruth.tum", Trajectory(np.linspace(100, 99.5 + 0.5 * count, count), moving(count)))
    write_camera(path / "camera.toml", CAMERA, np.eye(4))
    return path


def write_sevenscenes(path: Path, count: int = 6) -> Path:
    for k in range(count):
        write_image(path / f"frame-{2 * k:06d}.color.jpg")
        np.savetxt(path / f"frame-{2 * k:06d}.pose.txt", moving(count)[k])
    return path


def write_kitti(path: Path, images: int = 4, poses: int = 4) -> Path:
    for k in range(images):
        write_image(path / "image_0" / f"{k:06d}.png")
    (path / "calib.txt").write_text("P0: 7 0 16 0 0 8 12 0 0 0 1 0\nP1: 7 0 16 -2 0 8 12 0 0 0 1 0\n")
    (path / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(images)))
    np.savetxt(path / "poses.txt", moving(poses)[:, :3].reshape(poses, 12))
    return path


def write_tum_rgbd(path: Path) -> Path:
    for k in range(3):
        write_image(path / "rgb" / f"{1305.0 + k / 30:.6f}.png")
    names = sorted(file.name for file in (path / "rgb").iterdir())
    (path / "rgb.txt").write_text("# color images\n" + "".join(f"{name[:-4]} rgb/{name}\n" for name in names))
    write_tum(path / "groundtruth.txt", Trajectory(np.linspace(1304.9, 1305.2, 4), moving(4)))
    return path


def write_euroc(path: Path) -> Path:
    cam = path / "mav0" / "cam0"
    for k in range(3):
        write_image(cam / "data" / f"{1403636579763555584 + k * 50000000}.png")
    (cam / "sensor.yaml").write_text(
        "# General sensor definitions.\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        "  data: [0.0, -1.0, 0.0, 0.1,\n         1.0, 0.0, 0.0, 0.2,\n         0.0, 0.0, 1.0, 0.3,\n"
        "         0.0, 0.0, 0.0, 1.0]\nrate_hz: 20\nresolution: [32, 24]\ncamera_model: pinhole\n"
        "intrinsics: [45.8, 45.7, 16.7, 12.4] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    )
    truth = path / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir(parents=True)
    rows = [f"{1403636579763555584 + k * 50000000},{k},2,3,1,0,0,0,0,0,0,0,0,0,0,0,0" for k in range(3)]
    (truth / "data.csv").write_text("#timestamp, p_RS_R_x [m], ...\n" + "\n".join(rows) + "\n")
    return path


def test_sevenscenes_is_stamped_by_its_frame_numbers(tmp_path: Path) -> None:
    source = read_source(write_sevenscenes(tmp_path / "s"))
    assert source.format == "7scenes"
    assert [stamp_s for stamp_s, _ in source.images] == pytest.approx([k / 15 for k in range(6)])
    assert source.truth is not None
    np.testing.assert_allclose(source.truth.T_fixed_body, moving(6), atol=1e-9)
    assert source.lens is not None
    assert source.lens.camera == CameraModel(32, 24, 29.25, 29.25, 16.0, 12.0)


def test_kitti_takes_calibration_times_and_poses(tmp_path: Path) -> None:
    source = read_source(write_kitti(tmp_path / "00"))
    assert source.format == "kitti"
    assert source.lens is not None
    assert source.lens.camera == CameraModel(32, 24, 7.0, 8.0, 16.0, 12.0)
    assert source.truth is not None
    np.testing.assert_allclose(source.truth.T_fixed_body, moving(4), atol=1e-9)
    assert source.faults == ()


def test_tum_needs_a_calibration_unless_its_name_says_which_camera(tmp_path: Path) -> None:
    assert read_source(write_tum_rgbd(tmp_path / "desk")).lens is None
    path = write_tum_rgbd(tmp_path / "rgbd_dataset_freiburg1_desk")
    for file in (path / "rgb").iterdir():
        cv2.imwrite(str(file), np.full((480, 640, 3), 90, np.uint8))
    lens = read_source(path).lens
    assert lens is not None
    assert (lens.camera.fx, lens.camera.distortion[4]) == (517.3, 1.1633)


def test_euroc_takes_the_left_camera_in_the_body(tmp_path: Path) -> None:
    source = read_source(write_euroc(tmp_path / "MH_01"))
    assert source.format == "euroc"
    assert source.images[1][0] - source.images[0][0] == pytest.approx(0.05)
    assert source.lens is not None
    assert source.lens.camera == CameraModel(32, 24, 45.8, 45.7, 16.7, 12.4, (-0.28, 0.07, 0.0002, 1.8e-05))
    assert source.lens.T_body_camera[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert source.truth is not None
    assert source.truth.T_fixed_body[2, :3, 3].tolist() == [2, 2, 3]


def test_a_plain_folder_takes_stamps_from_names(tmp_path: Path) -> None:
    found = info(write_plain(tmp_path / "p"))
    assert (found.format, found.images, found.from_s, found.to_s) == ("plain", 6, 100.0, 102.5)
    assert (found.truth_poses, found.odometry_poses, found.camera) == (6, None, CameraModel.of_camera(CAMERA))
    assert found.length_m == pytest.approx(5.0)


def test_a_folder_of_numbered_images_takes_stamps_from_its_trajectory(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p", 4)
    for k, file in enumerate(sorted((path / "images").iterdir())):
        file.rename(path / "images" / f"{k:06d}.png")
    assert [stamp_s for stamp_s, _ in read_source(path).images] == [100.0, 100.5, 101.0, 101.5]


def test_convert_writes_a_recording_with_odometry_from_its_own_start(tmp_path: Path) -> None:
    out = convert(write_kitti(tmp_path / "00"), tmp_path / "out")
    recording = Recording.open(out)
    assert len(recording.frames) == 4
    np.testing.assert_allclose(recording.frames[3].T_odom_body, inverse(moving(4)[0]) @ moving(4)[3], atol=1e-8)
    T_world_body = recording.ground_truth(0.3)
    assert T_world_body is not None
    np.testing.assert_allclose(T_world_body, moving(4)[3], atol=1e-8)


def test_convert_goes_on_where_it_was_cut_short(tmp_path: Path) -> None:
    source, out = write_plain(tmp_path / "p"), tmp_path / "out"
    convert(source, out)
    first = (out / "images" / "000000.png").stat().st_mtime_ns
    lines = (out / "images.txt").read_text().splitlines(keepends=True)
    (out / "images.txt").write_text("".join(lines[:3]) + lines[3][:9])
    convert(source, out)
    assert (out / "images.txt").read_text() == "".join(lines)
    assert (out / "images" / "000000.png").stat().st_mtime_ns == first


def test_convert_does_not_write_into_another_recording(tmp_path: Path) -> None:
    convert(write_plain(tmp_path / "p"), tmp_path / "out")
    with pytest.raises(DatasetError, match="out: holds another recording"):
        convert(write_kitti(tmp_path / "00"), tmp_path / "out")


def test_convert_takes_odometry_of_its_own(tmp_path: Path) -> None:
    source = write_plain(tmp_path / "p")
    write_tum(tmp_path / "vio.tum", Trajectory(np.array([99.0, 100.5, 102.0]), moving(3)))
    recording = Recording.open(convert(source, tmp_path / "out", odometry=tmp_path / "vio.tum"))
    assert [frame.stamp_s for frame in recording.frames] == [100.0, 100.5, 101.0, 101.5, 102.0]
    np.testing.assert_allclose(recording.frames[1].T_odom_body, inverse(moving(3)[0]) @ moving(3)[1], atol=1e-8)


def test_images_are_undistorted_where_the_camera_has_a_third_coefficient(tmp_path: Path) -> None:
    path = write_tum_rgbd(tmp_path / "t")
    (path / "camera.yaml").write_text(
        "image_width: 32\nimage_height: 24\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [30, 0, 16, 0, 31, 12, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.2, -0.9, -0.005, 0.002, 1.1]\n"
    )
    recording = Recording.open(convert(path, tmp_path / "out"))
    assert recording.camera == Camera(32, 24, 30.0, 31.0, 16.0, 12.0)
    assert recording.frames[0].image_path.suffix == ".jpg"


def test_split_gives_each_robot_its_part_and_its_own_drift(tmp_path: Path) -> None:
    source = write_sevenscenes(tmp_path / "s", 12)
    folders = split(source, tmp_path / "out", 3, seed=4)
    assert [folder.name for folder in folders] == ["alpha", "bravo", "charlie"]
    recordings = [Recording.open(folder) for folder in folders]
    assert [len(recording.frames) for recording in recordings] == [4, 4, 4]
    for k, recording in enumerate(recordings):
        assert recording.frames[0].stamp_s < 0.08
        T_world_body = recording.ground_truth(recording.frames[0].stamp_s)
        assert T_world_body is not None
        np.testing.assert_allclose(T_world_body, moving(12)[4 * k], atol=1e-6)
    steps = [recording.frames[1].T_odom_body[:3, 3] for recording in recordings]
    assert not np.allclose(np.linalg.norm(steps[0]), np.linalg.norm(steps[1]), atol=1e-4)


def test_split_is_repeatable(tmp_path: Path) -> None:
    source = write_plain(tmp_path / "p", 12)
    texts = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        folders = split(source, tmp_path / name, 2, seed=seed, drift=DriftSpec())
        texts.append((folders[1] / "odometry.tum").read_text())
    assert texts[0] == texts[1] != texts[2]


def test_overlap_lengthens_all_parts_but_the_last(tmp_path: Path) -> None:
    folders = split(write_plain(tmp_path / "p", 12), tmp_path / "out", 2, overlap_s=1.0)
    assert [len(Recording.open(folder).frames) for folder in folders] == [8, 6]


def test_progress_counts_images(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    convert(write_kitti(tmp_path / "00"), tmp_path / "out", progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_one_image_fewer_than_poses_is_said_and_the_rest_is_kept(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"poses.txt: has 5 poses, but the sequence has 4 images.*4 images.*kept in"):
        convert(write_kitti(tmp_path / "00", images=4, poses=5), tmp_path / "out")
    assert len(Recording.open(tmp_path / "out").frames) == 4


def test_a_pose_without_its_image_is_said(tmp_path: Path) -> None:
    path = write_sevenscenes(tmp_path / "s")
    (path / "frame-000004.color.jpg").unlink()
    assert info(path).faults == (f"{path}: has 1 poses more than images",)


def test_a_listed_image_that_is_missing_is_said_with_its_line(tmp_path: Path) -> None:
    path = write_tum_rgbd(tmp_path / "t")
    next((path / "rgb").glob("*033333.png")).unlink()
    faults = info(path).faults
    assert "rgb.txt:3: the image" in faults[0]
    assert faults[1].endswith("intrinsics are missing")


def test_missing_intrinsics_are_said_with_what_to_do(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p")
    (path / "camera.toml").unlink()
    with pytest.raises(DatasetError, match=r"p: intrinsics are missing; put a camera.toml .* --camera"):
        convert(path, tmp_path / "out")


def test_a_chain_of_cameras_and_imu_is_taken_before_one_of_cameras_alone(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p")
    size = read_source(path).lens
    assert size is not None
    (path / "camera.toml").unlink()
    (path / "calib.yml").write_text("nothing")
    with pytest.raises(DatasetError, match=r"--camera \(calib.yml may be one\)"):
        convert(path, tmp_path / "out")
    camera = (
        "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n"
        f"  intrinsics: [30, 30, 16, 12]\n  resolution: [{size.camera.width}, {size.camera.height}]\n"
    )
    placed = "  T_cam_imu: [[1, 0, 0, 0.25], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    (path / "run-camchain.yaml").write_text(camera)
    (path / "run-camchain-imucam.yaml").write_text(camera + placed)
    lens = read_source(path).lens
    assert lens is not None
    assert lens.T_body_camera[0, 3] == -0.25
    assert any("not run-camchain.yaml" in note for note in lens.notes)


def test_intrinsics_of_another_size_are_refused(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p")
    write_camera(tmp_path / "other.toml", Camera(64, 48, 30.0, 30.0, 32.0, 24.0), np.eye(4))
    with pytest.raises(DatasetError, match="the image is 32x24, but the intrinsics are for 64x48"):
        convert(path, tmp_path / "out", camera=tmp_path / "other.toml")


def test_a_folder_without_motion_is_refused(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p")
    (path / "groundtruth.tum").unlink()
    with pytest.raises(DatasetError, match="neither odometry nor ground truth"):
        convert(path, tmp_path / "out")


def test_more_robots_than_images_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="6 images cannot be cut into 9 robots"):
        split(write_plain(tmp_path / "p"), tmp_path / "out", 9)


@pytest.mark.parametrize(("make", "sentence"), [(False, "does not exist"), (True, "is none of the known data sets")])
def test_an_unknown_folder_is_refused(tmp_path: Path, make: bool, sentence: str) -> None:
    if make:
        (tmp_path / "x").mkdir()
    with pytest.raises(DatasetError, match=sentence):
        detect_format(tmp_path / "x")


def test_kalibr_gives_the_inverse_of_its_mounting(tmp_path: Path) -> None:
    T_camera_imu = pose(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([0.1, 0.2, 0.3]))
    rows = "".join("  - [" + ", ".join(str(value) for value in row) + "]\n" for row in T_camera_imu)
    (tmp_path / "camchain.yaml").write_text(
        f"cam0:\n  T_cam_imu:\n{rows}  camera_model: pinhole\n  distortion_coeffs: [0.1, 0.2, 0.3, 0.4]\n"
        "  distortion_model: radtan\n  intrinsics: [30.0, 31.0, 16.0, 12.0]\n  resolution: [32, 24]\n"
    )
    lens = read_lens(tmp_path / "camchain.yaml")
    assert lens.camera == CameraModel(32, 24, 30.0, 31.0, 16.0, 12.0, (0.1, 0.2, 0.3, 0.4))
    np.testing.assert_allclose(lens.T_body_camera, inverse(T_camera_imu), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("fx: 1\n", "of the intrinsics, fy, cx, cy is missing"),
        ("fx: 1\nfy: 1\ncx: 1\ncy: 1\n", "the image size is missing"),
        ("width: 3\nheight: 4\n", "the intrinsics are missing"),
        ("resolution: [3, 4]\nintrinsics: [1, 1, 1, 1]\ndistortion_model: equidistant\n", "'equidistant'"),
    ],
)
def test_a_camera_file_of_no_use_is_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(DatasetError, match=f"camera.yaml: .*{sentence}"):
        read_lens(tmp_path / "camera.yaml")


@pytest.mark.data
def test_the_real_sevenscenes_sequence_splits_into_three(tmp_path: Path) -> None:
    path = SHARED / "data" / "sevenscenes"
    if not path.is_dir():
        pytest.skip(f"{path} is not here")
    folders = split(path, tmp_path / "out", 3, seed=1)
    recordings = [Recording.open(folder) for folder in folders]
    assert [len(recording.frames) for recording in recordings] == [167, 166, 167]
    assert sum(recording.truth.length_m() for recording in recordings if recording.truth) == pytest.approx(7.1, abs=0.1)


@pytest.mark.data
def test_real_kitti_and_euroc_files_are_read(tmp_path: Path) -> None:
    if not (SHARED / "data" / "kitti_short").is_dir():
        pytest.skip(f"{SHARED / 'data' / 'kitti_short'} is not here")
    found = info(SHARED / "data" / "kitti_short" / "KITTI_sequence_1")
    assert (found.format, found.images, found.truth_poses, found.faults) == ("kitti", 51, 51, ())
    vio = SHARED / "data" / "euroc" / "vio" / "MH_01.vislam.txt"
    with pytest.raises(RecordingError, match=r"MH_01.vislam.txt:1: nothing says whether the quaternion is x y z w"):
        read_trajectory(vio)
    assert len(read_trajectory(vio, "tum")[0]) > 1000


def test_images_go_by_their_numbers_in_every_reader(tmp_path: Path) -> None:
    """As text, 10 comes before 2, and every pose would be of another image."""
    wanted = [f"{k}.png" for k in range(12)]
    kitti = write_kitti(tmp_path / "00", 12, 12)
    for file in (kitti / "image_0").iterdir():
        file.rename(file.with_name(f"{int(file.stem)}.png"))
    assert [file.name for _, file in read_source(kitti).images] == wanted
    scenes = write_sevenscenes(tmp_path / "s", 12)
    for file in sorted(scenes.iterdir()):
        file.rename(file.with_name(f"frame-{int(file.name[6:12])}{file.name[12:]}"))
    found = read_source(scenes)
    assert found.truth is not None
    np.testing.assert_allclose(found.truth.T_fixed_body, moving(12), atol=1e-9)
    colmap = tmp_path / "c"
    for name in wanted:
        write_image(colmap / "images" / name)
    (colmap / "cameras.txt").write_text("1 PINHOLE 32 24 7 8 16 12\n")
    (colmap / "images.txt").write_text("".join(f"{k + 1} 1 0 0 0 0 0 {k} 1 {k}.png\n\n" for k in range(12)))
    assert [file.name for _, file in read_source(colmap).images] == wanted


@pytest.mark.parametrize("times", [True, False])
def test_a_missing_image_of_kitti_shifts_no_other(tmp_path: Path, times: bool) -> None:
    path = write_kitti(tmp_path / "00", 6, 6)
    (path / "image_0" / "000002.png").unlink()
    if not times:
        (path / "times.txt").unlink()
    source = read_source(path)
    stamps_s = {int(file.stem): stamp_s for stamp_s, file in source.images}
    assert stamps_s == pytest.approx({k: 0.1 * k for k in (0, 1, 3, 4, 5)})
    assert source.truth is not None
    assert len(source.truth) == 6
    assert len(source.faults) >= 1


def test_a_missing_image_of_a_raw_drive_shifts_no_other(tmp_path: Path) -> None:
    for k in (0, 1, 3):
        write_image(tmp_path / "image_00" / "data" / f"{k:010d}.png")
    stamps = "".join(f"2011-09-26 13:02:{25 + k}.500000000\n" for k in range(4))
    (tmp_path / "image_00" / "timestamps.txt").write_text(stamps)
    images = read_source(tmp_path).images
    assert [stamp_s - images[0][0] for stamp_s, _ in images] == [0, 1, 3]


def test_euroc_images_that_are_no_stamps_are_listed_or_said(tmp_path: Path) -> None:
    path = write_euroc(tmp_path / "MH_01")
    write_image(path / "mav0/cam0/data" / "overview.png")
    assert any("1 of 4 images were left out, as overview.png is no" in note for note in read_source(path).notes)
    stamps = []
    for k, file in enumerate(sorted((path / "mav0/cam0/data").glob("14*.png"))):
        stamps.append(int(file.stem))
        file.rename(file.with_name(f"{k:06d}.png"))
    with pytest.raises(DatasetError, match="no stamps in nanoseconds"):
        read_source(path)
    lines = "".join(f"{stamp},{k:06d}.png\n" for k, stamp in enumerate(stamps))
    (path / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n" + lines)
    assert [stamp_s for stamp_s, _ in read_source(path).images] == pytest.approx([stamp * 1e-9 for stamp in stamps])


@pytest.mark.parametrize("form", ["{t} rgb\\{n}", "{t} rgb/{n} {t} depth/{n}", "{t} rgb/{n}"])
def test_lists_are_read_as_windows_and_associations_write_them(tmp_path: Path, form: str) -> None:
    path = write_plain(tmp_path / "p", 4)
    (path / "images").rename(path / "rgb")
    names = sorted(file.name for file in (path / "rgb").iterdir())
    (path / "images.txt").write_text("".join(form.format(t=name[:-4], n=name) + "\n" for name in names))
    assert [file.name for _, file in read_source(path).images] == names


def test_a_list_of_nothing_that_exists_names_the_first(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p", 4)
    (path / "images.txt").write_text("1.0 other/1.png\n2.0 other/2.png\n")
    with pytest.raises(DatasetError, match=r"images.txt:1: the image .*other/1.png does not exist \(and 1 others\)"):
        read_source(path)


@pytest.mark.parametrize("name", ["camera.toml", "groundtruth.tum"])
def test_a_link_to_nowhere_is_said(tmp_path: Path, name: str) -> None:
    path = write_plain(tmp_path / "p", 4)
    (path / name).unlink()
    (path / name).symlink_to("/nowhere")
    with pytest.raises(FloccError, match=rf"{name}: cannot be read: No such file"):
        read_source(path)


def test_the_trajectory_that_was_not_taken_is_said(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p", 4)
    shutil.copy(path / "groundtruth.tum", path / "gt.txt")
    told = read_source(path).notes
    assert any(note.endswith("groundtruth.tum: was taken as the groundtruth, not gt.txt") for note in told)


def test_two_poses_of_one_image_are_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png")
    frames = [{"file_path": "a.png", "transform_matrix": moving(2)[k].tolist()} for k in range(2)]
    table = {"w": 32, "h": 24, "fl_x": 7, "fl_y": 8, "cx": 16, "cy": 12, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    with pytest.raises(DatasetError, match=r"gives a.png two poses"):
        read_source(tmp_path)


def write_colmap(path: Path, last: str = "4 1 0 0 0 0 0 3 1 3.png\n\n", count: int = 4) -> Path:
    for k in range(4):
        write_image(path / "images" / f"{k}.png")
    (path / "cameras.txt").write_text("1 PINHOLE 32 24 7 8 16 12\n")
    rows = [f"{k + 1} 1 0 0 0 0 0 {k} 1 {k}.png\n{k}.5 2.5 -1 7.5 3.5 {k}\n" for k in range(3)]
    (path / "images.txt").write_text(f"# Number of images: {count}, mean observations: 2\n{''.join(rows)}{last}")
    return path


@pytest.mark.parametrize(
    ("last", "said"),
    [
        ("4 1 0 0 0 0 0 3 1", "images.txt:8: is no whole row of an image"),
        ("4 1 0 0 0 0 0", "images.txt:8: is no whole row of an image"),
        ("4 1 0 0 0 0", "images.txt:8: is no whole row of an image"),
        ("", "says that it has 4 images, but has 3: it may be cut off"),
    ],
)
def test_a_row_of_colmap_that_was_cut_is_said(tmp_path: Path, last: str, said: str) -> None:
    source = read_source(write_colmap(tmp_path, last))
    assert [note for note in source.notes if said in note]
    assert len(source.images) == 3
    assert not [note for note in read_source(write_colmap(tmp_path)).notes if "images.txt" in note]


def test_of_several_models_of_colmap_the_largest_is_taken_and_said(tmp_path: Path) -> None:
    rows = [f"{k + 1} 1 0 0 0 0 0 {k} 1 {k}.png\n1.5 2.5 -1\n" for k in range(4)]
    for number, kept in enumerate((rows[:1], rows[1:])):
        place = tmp_path / "sparse" / str(number)
        place.mkdir(parents=True)
        (place / "cameras.txt").write_text("1 PINHOLE 32 24 7 8 16 12\n")
        (place / "images.txt").write_text("".join(kept))
    for k in range(4):
        write_image(tmp_path / "images" / f"{k}.png")
    source = read_source(tmp_path)
    assert len(source.images) == 3
    assert f"{tmp_path}: the model sparse/1 was taken; not those of other frames: sparse/0" in source.notes


def test_a_camera_of_colmap_that_is_no_number_is_refused_with_its_line(tmp_path: Path) -> None:
    path = write_colmap(tmp_path, "4 1 0 0 0 0 0 3 1.5 3.png\n")
    with pytest.raises(DatasetError, match=r"images\.txt:8: CAMERA_ID must be a whole number, not '1\.5'"):
        read_source(path)


@pytest.mark.parametrize("poses", [0, 4, 7])
def test_numbers_of_kitti_with_gaps_are_times_where_nothing_else_is(tmp_path: Path, poses: int) -> None:
    """Numbers 0, 1, 4, 6: with as many poses as images, or one for every number."""
    path = write_kitti(tmp_path / "00", 7, 7)
    (path / "times.txt").unlink()
    for number in (2, 3, 5):
        (path / "image_0" / f"{number:06d}.png").unlink()
    (path / "poses.txt").unlink()
    if poses:
        np.savetxt(path / "poses.txt", moving(7)[:poses, :3].reshape(poses, 12))
    source = read_source(path)
    assert [stamp_s for stamp_s, _ in source.images] == pytest.approx([0.0, 0.1, 0.4, 0.6])
    assert any("number N was taken at N/10 s" in note for note in source.notes)
    if poses:
        assert source.truth is not None
        wanted = [0.0, 0.1, 0.4, 0.6] if poses == 4 else [0.1 * k for k in range(7)]
        assert source.truth.stamps_s == pytest.approx(wanted)


def test_a_trajectory_or_a_graph_alone_is_named(tmp_path: Path) -> None:
    (tmp_path / "tracks").mkdir()
    write_tum(tmp_path / "tracks" / "robot.txt", Trajectory(np.linspace(0, 1, 9), moving(9)))
    (tmp_path / "graphs").mkdir()
    (tmp_path / "graphs" / "r1.g2o").write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n")
    said = {
        "tracks": r"tracks: holds trajectories only \(robot\.txt\); flocc needs the images, too",
        "tracks/robot.txt": r"robot\.txt: is a trajectory; flocc needs the images, too",
        "graphs": r"graphs: holds r1\.g2o: a pose graph, which has no images: flocc optimise",
        "graphs/r1.g2o": r"r1\.g2o: is a pose graph, which has no images: flocc optimise",
    }
    for name, sentence in said.items():
        with pytest.raises(DatasetError, match=sentence):
            read_source(tmp_path / name)


def test_info_names_the_file_of_each_trajectory(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "mine")
    write_tum(path / "vio.txt", Trajectory(np.linspace(100, 102.5, 6), moving(6)))
    lines = dict(info_lines(info(path)))
    assert (lines["odometry"], lines["ground truth"]) == ("6 poses, vio.txt", "6 poses, groundtruth.tum")


def test_decoders_do_not_speak_for_themselves(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A damaged PNG: libpng writes to stderr, past Python."""
    _, encoded = cv2.imencode(".png", np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8))
    damaged = encoded.tobytes()[:2000] + b"\0" + encoded.tobytes()[2001:]
    with pytest.raises(PictureError, match="damaged PNG"):
        read_picture(damaged)
    assert capfd.readouterr().err == ""
    with quiet_decoders():
        os.write(2, b"somebody else\nlibpng error: x\n")
    assert capfd.readouterr().err == "somebody else\n"


@pytest.mark.parametrize("kind", ["size", "text", "black", "folder"])
def test_a_mask_that_is_none_is_said_of_the_folder_it_lies_in(tmp_path: Path, kind: str) -> None:
    path = write_plain(tmp_path / "p")
    mask = np.full((24, 32), 255, np.uint8)
    cv2.imwrite(str(path / "mask.png"), mask)
    assert not [line for line in (*info(path).notes, *info(path).faults) if "mask" in line]
    convert(path, tmp_path / "good")
    assert (tmp_path / "good" / "mask.png").is_file()
    (path / "mask.png").unlink()
    if kind == "folder":
        (path / "mask.png").mkdir()
    elif kind == "text":
        (path / "mask.png").write_text("x")
    else:
        cv2.imwrite(str(path / "mask.png"), mask[:12] if kind == "size" else 0 * mask)
    (fault,) = info(path).faults
    assert str(path / "mask.png") in fault
    with pytest.raises(FloccError, match="mask") as raised:
        convert(path, tmp_path / "bad")
    assert str(path / "mask.png") in str(raised.value)


def test_images_that_no_pose_covers_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_plain(tmp_path / "p")
    write_tum(path / "groundtruth.tum", Trajectory(np.array([100.0, 102.5]), moving(2)))
    assert info(path).posed == 2
    convert(path, tmp_path / "out")
    assert "4 of 6 images lie outside of the trajectory's time, or in a gap of it: no robot uses them" in caplog.text


def test_images_that_a_model_has_no_pose_of_are_counted(tmp_path: Path) -> None:
    for k in range(5):
        write_image(tmp_path / "images" / f"{k}.png")
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 32 24 7 8 16 12\n")
    (tmp_path / "images.txt").write_text("".join(f"{k + 1} 1 0 0 0 0 0 {k} 1 {k}.png\n\n" for k in range(3)))
    notes = read_source(tmp_path).notes
    assert f"{tmp_path / 'images'}: 2 more images have no pose in the model and were left out" in notes


def test_a_frame_without_matrix_is_not_taken_for_two(tmp_path: Path) -> None:
    frames = [{"file_path": "images/0.png", "transform_matrix": None}]
    table = {"camera_model": "PINHOLE", "w": 32, "h": 24, "fl_x": 7, "fl_y": 8, "cx": 16, "cy": 12, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    write_image(tmp_path / "images" / "0.png")
    with pytest.raises(DatasetError, match=r"the transform_matrix of images/0\.png is no matrix"):
        read_source(tmp_path)


def test_intrinsics_of_bundlefusion_are_not_those_of_sevenscenes(tmp_path: Path) -> None:
    for k in range(3):
        write_image(tmp_path / f"frame-{k:06d}.color.jpg")
        rows = "\n".join(" ".join(map(str, row)) for row in moving(3)[k].tolist())
        (tmp_path / f"frame-{k:06d}.pose.txt").write_text(rows)
    (tmp_path / "_info.txt").write_text(
        "m_versionNumber = 4\nm_colorWidth = 32\nm_colorHeight = 24\n"
        "m_calibrationColorIntrinsic = 31 0 15 0 0 30 11 0 0 0 1 0 0 0 0 1\n"
    )
    lens = read_source(tmp_path).lens
    assert lens is not None
    assert (lens.camera.fx, lens.camera.fy, lens.camera.cx, lens.camera.cy) == (31.0, 30.0, 15.0, 11.0)


def test_a_folder_that_is_refused_by_name_is_no_team(tmp_path: Path) -> None:
    write_image(tmp_path / "keyframes" / "images" / "0.jpg")
    (tmp_path / "mesh_info.json").write_text("{}")
    with pytest.raises(DatasetError, match="is Polycam's raw export, which flocc does not read"):
        list(infos(tmp_path))


def test_published_intrinsics_are_not_those_of_images_of_another_shape(tmp_path: Path) -> None:
    path = write_sevenscenes(tmp_path / "s")
    for file in path.glob("*.jpg"):
        cv2.imwrite(str(file), np.zeros((18, 32), np.uint8))
    assert read_source(path).lens is None


def test_ground_truth_of_a_sensor_is_brought_to_the_body(tmp_path: Path) -> None:
    path = write_euroc(tmp_path / "e")
    before = read_source(path).truth
    sensor = "T_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    (path / "mav0" / "state_groundtruth_estimate0" / "sensor.yaml").write_text(
        "sensor_type: visual-inertial\n" + sensor
    )
    after = read_source(path).truth
    assert before is not None
    assert after is not None
    np.testing.assert_allclose(before.T_fixed_body[:, :3, 3] - after.T_fixed_body[:, :3, 3], [[0.5, 0, 0]] * 3)


@pytest.mark.parametrize(("unit", "read"), [(1.0, True), (1000.0, False)])
def test_stamps_of_frames_are_taken(tmp_path: Path, unit: float, read: bool) -> None:
    for k in range(4):
        write_image(tmp_path / f"{k}.png")
    frames = [
        {"file_path": f"{k}.png", "timestamp": unit * (5 + k / 10), "transform_matrix": moving(4)[k].tolist()}
        for k in range(4)
    ]
    table = {"w": 32, "h": 24, "fl_x": 7, "fl_y": 8, "cx": 16, "cy": 12, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    if not read:
        with pytest.raises(DatasetError, match="timestamp must be seconds in every frame"):
            read_source(tmp_path)
        return
    assert [stamp_s for stamp_s, _ in read_source(tmp_path).images] == pytest.approx([5.0, 5.1, 5.2, 5.3])


@pytest.mark.parametrize(
    ("applied", "said"),
    [
        ({"applied_scale": 0.1}, ""),
        ({"applied_scale": 0.0}, "applied_scale must be a number above 0"),
        ({"applied_scale": 0.1, "camera_convention": "OpenGL", "orientation_override": "up"}, ""),
        ({"camera_convention": "opencv"}, "camera_convention is 'opencv', but poses are read as those of a camera"),
        ({"w2c": True}, "w2c is 'True', but poses are read as those of a camera in the world"),
        ({"applied_transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}, "applied_transform is not rigid"),
    ],
)
def test_a_scale_that_nerfstudio_applied_is_undone(tmp_path: Path, applied: dict[str, Any], said: str) -> None:
    frames = []
    for k in range(4):
        write_image(tmp_path / f"{k}.png")
        frames.append({"file_path": f"{k}.png", "time": k / 4, "transform_matrix": moving(4)[k].tolist()})
    table = {"w": 32, "h": 24, "fl_x": 7, "fl_y": 8, "cx": 16, "cy": 12, "frames": frames, **applied}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    if said:
        with pytest.raises(DatasetError, match=said):
            read_source(tmp_path)
        return
    source = read_source(tmp_path)
    assert source.truth is not None
    np.testing.assert_allclose(source.truth.T_fixed_body[:, :3, 3], 10 * moving(4)[:, :3, 3])
    assert f"{tmp_path / 'transforms.json'}: not used of its frames: time" in source.notes


def test_a_matrix_that_is_not_finite_is_not_taken_for_two(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png")
    frames = [{"file_path": "a.png", "transform_matrix": np.full((4, 4), np.nan).tolist()}]
    table = {"w": 32, "h": 24, "fl_x": 7, "fl_y": 8, "cx": 16, "cy": 12, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    with pytest.raises(FloccError, match=r"a\.png: the pose has a number that is not finite"):
        read_source(tmp_path)


CHAIN = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [30.0, 30.0, 16.0, 12.0]
  resolution: [32, 24]
  timeshift_cam_imu: 0.125
"""


@pytest.mark.parametrize("clock", ["of the body", "of the pictures", "by order"])
def test_kalibrs_time_shift_is_added_to_pictures_where_poses_are_of_the_bodys_clock(tmp_path: Path, clock: str) -> None:
    path = write_plain(tmp_path / "p")
    (path / "camera.toml").unlink()
    (path / "camera.yaml").write_text(CHAIN)
    stamps_s = np.arange(99.5, 104.0, 0.05) + 0.01
    if clock == "of the body":
        poses = np.tile(np.eye(4), (len(stamps_s), 1, 1))
        poses[:, 0, 3] = stamps_s
        write_tum(path / "groundtruth.tum", Trajectory(stamps_s, poses))
    elif clock == "by order":
        for k, file in enumerate(sorted((path / "images").iterdir())):
            file.rename(path / "images" / f"{k:04d}.png")
    found = read_source(path)
    told = [note for note in found.notes if "timeshift_cam_imu is +0.125 s (t_imu = t_cam + shift)" in note]
    assert len(told) == 1
    shifted = clock == "of the body"
    assert found.images[1][0] == pytest.approx(100.625 if shifted else 100.5)
    assert ("was not added" in told[0]) is not shifted
    convert(path, tmp_path / "out")
    back = Recording.open(tmp_path / "out")
    assert back.frames[1].stamp_s == pytest.approx(100.625 if shifted else 100.5)
    if shifted:
        assert back.frames[1].T_odom_body[0, 3] == pytest.approx(100.625 - stamps_s[0], abs=1e-6)


def test_a_mask_is_straightened_with_its_pictures(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p")
    (path / "camera.toml").write_text(
        "[camera]\nwidth = 32\nheight = 24\nfx = 14.0\nfy = 14.0\ncx = 15.5\ncy = 11.5\nmodel = 'equidistant'\n"
        "distortion = [0.01, 0.0, 0.0, 0.0]\n"
    )
    mask = np.full((24, 32), 255, np.uint8)
    mask[:6] = 0
    cv2.imwrite(str(path / "mask.png"), mask)
    back = Recording.open(convert(path, tmp_path / "out"))
    assert back.hidden is not None
    assert back.hidden.shape == (back.camera.height, back.camera.width)
    assert back.hidden[0].any()
    assert not back.hidden[-1].any()


def phone_folder(path: Path, images: str, trajectory: str, names: str = "IMG_{:04d}.png") -> Path:
    for k in range(6):
        write_image(path / images / names.format(k), 10 * k)
    write_tum(path / trajectory, Trajectory(np.linspace(100.0, 102.5, 6), moving(6)))
    write_camera(path / "camera.toml", CAMERA, np.eye(4))
    return path


@pytest.mark.parametrize("images", ["DCIM/Camera", "DCIM/100ANDRO", "photos", "Pictures", "Frames", "RGB"])
def test_folders_as_a_phone_copies_them_are_plain_ones(tmp_path: Path, images: str) -> None:
    found = read_source(phone_folder(tmp_path / "p", images, "odometry.tum"))
    assert [stamp_s for stamp_s, _ in found.images] == [100.0, 100.5, 101.0, 101.5, 102.0, 102.5]
    assert found.odometry is not None


@pytest.mark.parametrize("name", ["arcore_poses.txt", "ARKit_poses.txt", "ARposes.txt"])
def test_a_phones_axes_are_said_or_asked_for(tmp_path: Path, name: str) -> None:
    path = phone_folder(tmp_path / "p", "DCIM/Camera", name)
    with pytest.raises(DatasetError, match=r"y points up and z backwards; write T_body_camera = \[\[1, 0, 0, 0\]"):
        read_source(path)
    write_camera(path / "camera.toml", CAMERA, np.diag([1.0, -1.0, -1.0, 1.0]))
    assert read_source(path).odometry is not None


@pytest.mark.parametrize(
    "form", ["{s:.6f}", "{ns}", "{k:05d} {s:.6f} 0.02", "{s:.6f},{k}.png", "{k}.png {s:.6f}", "{k},{ns}"]
)
@pytest.mark.parametrize("name", ["times.txt", "timestamps.txt"])
def test_images_that_only_count_take_the_stamps_of_times(tmp_path: Path, form: str, name: str) -> None:
    path = phone_folder(tmp_path / "p", "images", "odometry.tum", "{}.png")
    zero_s = 1_700_000_000
    lines = [form.format(k=k, s=zero_s + 0.2 * k, ns=zero_s * 10**9 + k * 2 * 10**8) for k in range(6)]
    (path / name).write_text("\n".join(lines) + "\n")
    stamps_s = np.linspace(zero_s, zero_s + 1.45, 30)
    write_tum(path / "odometry.tum", Trajectory(stamps_s, np.tile(np.eye(4), (30, 1, 1))))
    found = read_source(path)
    assert [stamp_s for stamp_s, _ in found.images] == pytest.approx([zero_s + 0.2 * k for k in range(6)], abs=1e-6)
    assert any(f"{name} gives them" in note for note in found.notes)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["0.1", "0.2"], "has 2 stamps, but .* has 6 images"),
        (["0", "1", "2", "3", "4", "5"], "stamps can be seconds"),
        (["0.5", "0.4", "0.6", "0.7", "0.8", "0.9"], "time goes backwards"),
        ([f"{7 * k} {0.2 * k}" for k in range(6)], "its lines must be stamps"),
        (["a", "b", "c", "d", "e", "f"], "stamps"),
    ],
)
def test_times_that_are_none_are_refused(tmp_path: Path, lines: list[str], said: str) -> None:
    path = phone_folder(tmp_path / "p", "images", "odometry.tum", "{}.png")
    (path / "times.txt").write_text("\n".join(lines) + "\n")
    with pytest.raises(DatasetError, match=said):
        read_source(path)


def test_names_that_neither_say_stamps_nor_count_alike_give_no_order(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "p")
    for k, file in enumerate(sorted((path / "images").iterdir())):
        file.rename(path / "images" / f"{1_700_000_000_000_000_000 + 100_000_000 * k:016x}.jpg")
    with pytest.raises(DatasetError, match="nothing says which pose is of which"):
        read_source(path)


def test_what_lies_beside_the_files_that_are_read_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_plain(tmp_path / "p")
    for name in ("extrinsics.txt", "calib.txt", "given.tum"):
        (path / name).write_text((path / "groundtruth.tum").read_text())
    convert(path, tmp_path / "out", odometry=path / "given.tum")
    assert f"{path}: not used: calib.txt, extrinsics.txt" in caplog.text
    assert info(tmp_path / "out").notes == ()


def test_a_trajectory_of_the_folder_that_is_named_again_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_plain(tmp_path / "p")
    text = "# said by nobody\n" + (path / "groundtruth.tum").read_text()
    (path / "odometry.tum").write_text(text)
    convert(path, tmp_path / "out", odometry=path / "odometry.tum")
    assert caplog.text.count("comments that were not used: 'said by nobody'") == 1
