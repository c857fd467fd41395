"""A recording reads back as it was written, and every broken one is refused by file and line."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import angle_rad, pose, so3_exp
from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.runtime.recording import Recording, RecordingError, read_camera, write_camera
from flocc_agent.runtime.straightening import Straightener
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_agent.runtime.trajectory_text import read_tum

CAMERA = Camera(32, 24, 30.0, 31.0, 16.0, 12.0, (0.1, -0.2, 0.01, 0.02))
T_BODY_CAMERA = pose(so3_exp(np.array([0.1, -1.2, 0.4])), np.array([0.1, 0.0, 0.3]))


def motion(count: int = 5, step_s: float = 1.0) -> Trajectory:
    stamps_s = np.linspace(0.0, (count - 1) * step_s, count)
    poses = [pose(so3_exp(np.array([0.0, 0.0, 0.2 * s])), np.array([s, 0.0, 0.0])) for s in stamps_s]
    return Trajectory(stamps_s, np.array(poses))


def write_recording(path: Path, stamps_s: tuple[float, ...] = (0.0, 1.5, 4.0)) -> Path:
    (path / "images").mkdir(parents=True)
    lines = []
    for index, stamp_s in enumerate(stamps_s):
        pixels = np.full((24, 32, 3), (10, 20, 200 + index), dtype=np.uint8)
        cv2.imwrite(str(path / "images" / f"{index:06d}.png"), pixels)
        lines.append(f"{stamp_s} images/{index:06d}.png\n")
    (path / "images.txt").write_text("# stamp path\n" + "".join(lines))
    write_tum(path / "odometry.tum", motion())
    write_camera(path / "camera.toml", CAMERA, T_BODY_CAMERA)
    return path


def test_reads_back_what_was_written(tmp_path: Path) -> None:
    recording = Recording.open(write_recording(tmp_path / "r"))
    assert recording.camera == CAMERA
    np.testing.assert_allclose(recording.T_body_camera, T_BODY_CAMERA, atol=1e-9)
    assert [frame.stamp_s for frame in recording.frames] == [0.0, 1.5, 4.0]
    assert recording.truth is None
    assert recording.ground_truth(1.0) is None


def test_pixels_are_rgb(tmp_path: Path) -> None:
    recording = Recording.open(write_recording(tmp_path / "r"))
    assert recording.load_image(recording.frames[1]).pixels[3, 4].tolist() == [201, 20, 10]


def test_odometry_is_interpolated_to_the_image(tmp_path: Path) -> None:
    T = Recording.open(write_recording(tmp_path / "r")).frames[1].T_odom_body
    np.testing.assert_allclose(T, pose(so3_exp(np.array([0.0, 0.0, 0.3])), np.array([1.5, 0.0, 0.0])), atol=1e-9)


def test_images_outside_of_the_odometry_are_left_out(tmp_path: Path) -> None:
    recording = Recording.open(write_recording(tmp_path / "r", (1.0, 4.01, 9.0)))
    assert [frame.stamp_s for frame in recording.frames] == [1.0, 4.01]


def test_two_poses_that_cannot_be_cost_their_images_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_recording(tmp_path / "r", tuple(np.linspace(0.0, 9.5, 20)))
    long = motion(20, 0.5)
    long.T_fixed_body[[4, 11], 0, 3] = (1e12, 9e6)
    write_tum(path / "odometry.tum", long)
    frames = Recording.open(path).frames
    assert [frame.T_odom_body[0, 3] for frame in frames] == pytest.approx([0.5 * k for k in range(20)])
    assert "1 of 20 rows were left out" in caplog.text
    assert "1 of 19 poses lie out of reach of the others" in caplog.text


def test_odometry_that_lies_beyond_the_map_is_refused_or_its_images_left_out(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "r", tuple(np.linspace(0.0, 9.5, 20)))
    far = motion(20, 0.5)
    far.T_fixed_body[:, 0, 3] += 2e7
    write_tum(path / "odometry.tum", far)
    with pytest.raises(RecordingError, match="over 10000 km"):
        Recording.open(path)
    far.T_fixed_body[:, 0, 3] += 9.999e6 - far.T_fixed_body[9, 0, 3]
    write_tum(path / "odometry.tum", far)
    assert len(Recording.open(path).frames) == 10


def test_a_camera_that_sits_far_from_its_body_is_refused(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "r")
    write_camera(path / "camera.toml", CAMERA, pose(np.eye(3), np.array([1e12, 0.0, 0.0])))
    with pytest.raises(RecordingError, match="T_body_camera: the camera sits over 1000 m"):
        Recording.open(path)


def test_a_long_gap_is_not_bridged() -> None:
    sparse = motion(step_s=10.0)
    assert sparse.at(4.0) is None
    np.testing.assert_array_equal(sparse.at(10.0), sparse.T_fixed_body[1])
    np.testing.assert_array_equal(sparse.at(9.99), sparse.T_fixed_body[1])
    assert sparse.at(-1.0) is None


def test_a_mask_says_what_moves_with_the_camera(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "r")
    assert Recording.open(path).hidden is None
    camera = Recording.open(path).camera
    mask = np.full((camera.height, camera.width), 255, np.uint8)
    mask[:2] = 0
    cv2.imwrite(str(path / "mask.png"), mask)
    hidden = Recording.open(path).hidden
    assert hidden is not None
    assert hidden[:2].all()
    assert not hidden[2:].any()
    cv2.imwrite(str(path / "mask.png"), mask[:-1])
    with pytest.raises(RecordingError, match=r"mask\.png.*as large as the images"):
        Recording.open(path)
    cv2.imwrite(str(path / "mask.png"), 0 * mask)
    with pytest.raises(RecordingError, match=r"mask\.png: is black all over"):
        Recording.open(path)


def test_ground_truth_is_optional_and_read(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "r")
    write_tum(path / "groundtruth.tum", motion())
    T = Recording.open(path).ground_truth(2.0)
    assert T is not None
    assert T[0, 3] == pytest.approx(2.0)


def test_tum_round_trip_keeps_poses(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.tum", motion())
    back = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(back.T_fixed_body, motion().T_fixed_body, atol=1e-8)
    assert angle_rad(back.T_fixed_body[3][:3, :3].T @ motion().T_fixed_body[3][:3, :3]) < 1e-8


def test_identity_where_extrinsics_are_missing(tmp_path: Path) -> None:
    write_camera(tmp_path / "camera.toml", CAMERA, T_BODY_CAMERA)
    text = (tmp_path / "camera.toml").read_text()
    (tmp_path / "camera.toml").write_text(text[: text.index("T_body_camera = ")])
    np.testing.assert_array_equal(read_camera(tmp_path / "camera.toml")[1], np.eye(4))


BREAKAGES = [
    ("images.txt", "0.0 images/000009.png\n", "images.txt:1: the image .*000009.png does not exist"),
    ("images.txt", "1.0 images/000001.png\n0.5 images/000000.png\n", "images.txt:2: time goes backwards"),
    ("images.txt", "zero images/000000.png\n", "images.txt:1: must be 'stamp_s relative/path'"),
    ("images.txt", "", "images.txt: lists no image"),
    (
        "images.txt",
        "90 images/000000.png\n",
        "odometry.tum: is from 0.000 s to 4.000 s, and has no pose .* where the images of .*90.000 s",
    ),
    ("odometry.tum", "0 0 0 nan 0 0 0 1\n", "odometry.tum:1: the pose has a number that is not finite"),
    ("odometry.tum", "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 2\n", "odometry.tum:2: the pose is not rigid"),
    ("odometry.tum", "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0\n", "odometry.tum:2: 8 numbers are needed, 7 were found"),
    ("odometry.tum", "0 0 0 0 0 x 0 1\n", "odometry.tum:1: 'x' is not a number"),
    ("odometry.tum", "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "odometry.tum:2: time goes backwards"),
    ("odometry.tum", "# nothing\n", "odometry.tum: holds no pose"),
    ("camera.toml", "[camera]\nwidth = 32\n", "camera.toml: the key 'camera.height' is missing"),
    ("camera.toml", "width = 32\n", r"camera.toml: the table \[camera\] is missing"),
    ("camera.toml", "[camera\n", "camera.toml: is not TOML"),
]


@pytest.mark.parametrize(("name", "content", "sentence"), BREAKAGES)
def test_a_broken_file_is_named(tmp_path: Path, name: str, content: str, sentence: str) -> None:
    path = write_recording(tmp_path / "r")
    (path / name).write_text(content)
    with pytest.raises(RecordingError, match=sentence):
        Recording.open(path)


MISSING = {
    "images.txt": "images.txt: cannot be read: No such file",
    "odometry.tum": "odometry.tum: cannot be read: No such file",
    "camera.toml": "has no camera.toml, .* `flocc dataset convert",
}


@pytest.mark.parametrize("name", MISSING)
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    path = write_recording(tmp_path / "r")
    (path / name).unlink()
    with pytest.raises(RecordingError, match=MISSING[name]):
        Recording.open(str(path))


def test_intrinsics_of_another_size_are_refused(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "r")
    write_camera(path / "camera.toml", Camera(64, 48, 30.0, 30.0, 32.0, 24.0), np.eye(4))
    with pytest.raises(
        RecordingError, match=r"000000.png: the image is 32x24, but the intrinsics are for 64x48 .*camera.toml"
    ):
        Recording.open(path)


def test_a_damaged_image_is_named(tmp_path: Path) -> None:
    recording = Recording.open(write_recording(tmp_path / "r"))
    recording.frames[1].image_path.write_bytes(b"\x89PNG broken")
    with pytest.raises(RecordingError, match=r"000001.png: the image is (damaged|cut off)"):
        recording.load_image(recording.frames[1])


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("fov = 3", "the key 'camera.fov' does not exist"),
        ("T_body_camera = [[1, 0], [0, 1]]", "four rows of four numbers"),
        ("T_body_camera = [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]", "the pose is not rigid"),
        ("distortion = [0, 0]", r"distortion of the pinhole model must be \[k1, k2, p1, p2, ...\] .* 0 or 4 or 5 or 8"),
        ("model = 'ds'\nxi = 0.1", "the key 'camera.alpha' is missing"),
        ("model = 'equidistant'", r"distortion of the equidistant model must be \[k1, k2, k3, k4\]"),
        ("model = 'thin_prism_fisheye'", "camera.model is 'thin_prism_fisheye'; flocc reads"),
    ],
)
def test_a_wrong_camera_key_is_named(tmp_path: Path, line: str, sentence: str) -> None:
    base = "[camera]\nwidth = 4\nheight = 4\nfx = 1.0\nfy = 1.0\ncx = 2.0\ncy = 2.0\n"
    (tmp_path / "camera.toml").write_text(base + line + "\n")
    with pytest.raises(RecordingError, match=sentence):
        read_camera(tmp_path / "camera.toml")


@pytest.mark.parametrize(
    ("lines", "model"),
    [
        ("distortion = [-0.3, 0.1, 0.0, 0.0, 0.05]", CameraModel(32, 24, 30, 31, 16, 12, (-0.3, 0.1, 0, 0, 0.05))),
        (
            "distortion = [0.5, -2.6, 0.0, 0.0, 1.5, 0.4, -2.5, 1.4]",
            CameraModel(32, 24, 30, 31, 16, 12, (0.5, -2.6, 0, 0, 1.5, 0.4, -2.5, 1.4)),
        ),
        (
            "model = 'kannala_brandt'\ndistortion = [0.02, -0.01, 0.003, 0.0]",
            CameraModel(32, 24, 30, 31, 16, 12, (0.02, -0.01, 0.003, 0.0), LensKind.EQUIDISTANT),
        ),
        ("model = 'fov'\nomega = 0.9", CameraModel(32, 24, 30, 31, 16, 12, (), LensKind.FOV, (0.9,))),
        (
            "model = 'omni'\nxi = 1.2\ndistortion = [0.1, 0.0, 0.0, 0.0]",
            CameraModel(32, 24, 30, 31, 16, 12, (0.1, 0, 0, 0), LensKind.OMNIDIRECTIONAL, (1.2,)),
        ),
        (
            "model = 'double-sphere'\nxi = -0.2\nalpha = 0.59",
            CameraModel(32, 24, 30, 31, 16, 12, (), LensKind.DOUBLE_SPHERE, (-0.2, 0.59)),
        ),
        (
            "model = 'eucm'\nalpha = 0.6\nbeta = 1.1",
            CameraModel(32, 24, 30, 31, 16, 12, (), LensKind.EUCM, (0.6, 1.1)),
        ),
    ],
)
def test_a_recording_takes_every_camera_model_and_straightens_its_pictures(
    tmp_path: Path, lines: str, model: CameraModel
) -> None:
    path = write_recording(tmp_path / "r")
    base = "[camera]\nwidth = 32\nheight = 24\nfx = 30.0\nfy = 31.0\ncx = 16.0\ncy = 12.0\n"
    (path / "camera.toml").write_text(base + lines + "\n")
    cv2.imwrite(str(path / "mask.png"), np.vstack([np.zeros((8, 32), np.uint8), np.full((16, 32), 255, np.uint8)]))
    recording = Recording.open(path)
    assert recording.model == model
    assert recording.camera == Straightener(model).camera
    image = recording.load_image(recording.frames[0])
    assert image.pixels.shape == (recording.camera.height, recording.camera.width, 3)
    assert recording.hidden is not None
    assert recording.hidden.shape == image.pixels.shape[:2]
    middle = recording.camera.width // 2
    assert recording.hidden[0, middle]
    assert not recording.hidden[-1, middle]
