"""Bags of every kind become recordings; each bad one is refused in one sentence and its good part is kept."""

import signal
import sqlite3
import struct
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.launch.bag_fixtures import HEIGHT, WIDTH, ZERO_NS, BagScript, walking
from typer.testing import CliRunner

from flocc_agent.core.interfaces import Camera
from flocc_agent.lenses import CameraModel
from flocc_agent.runtime.recording import Recording, write_camera
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_lab.bench import bag_speed
from flocc_launch.commands.data import dataset
from flocc_launch.datasets.bag_convert import BagOptions, convert_bag
from flocc_launch.datasets.commands import convert, info, split
from flocc_launch.datasets.presets import GRACO_GROUND, S3E_ALPHA, Team, convert_graco, convert_s3e, convert_team
from flocc_launch.datasets.source import DatasetError

KINDS = ["bag", "db3", "mcap"]
CAMERA = Camera(WIDTH, HEIGHT, 30.0, 31.0, 16.0, 12.0, (0.1, 0.2, 0.3, 0.4))


def bag_path(folder: Path, kind: str) -> Path:
    return folder / ("run.bag" if kind == "bag" else "run")


def camera_file(folder: Path) -> Path:
    write_camera(folder / "camera.toml", CAMERA, np.eye(4))
    return folder / "camera.toml"


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_becomes_a_recording(tmp_path: Path, kind: str) -> None:
    bag = walking(kind == "bag").write(bag_path(tmp_path, kind), kind)
    recording = Recording.open(convert(bag, tmp_path / "out"))
    assert recording.camera == CAMERA
    assert [frame.stamp_s for frame in recording.frames] == pytest.approx([1.6e9 + k + 0.2 for k in range(5)])
    assert [frame.T_odom_body[0, 3] for frame in recording.frames] == pytest.approx([k + 0.2 for k in range(5)])
    assert int(recording.load_image(recording.frames[3]).pixels.mean()) == 30
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "camera.toml", "images", "images.txt", "odometry.tum", "source.txt",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_info_lists_topics(tmp_path: Path, kind: str) -> None:
    found = info(walking(kind == "bag").write(bag_path(tmp_path, kind), kind))
    assert (found.format, found.images, found.faults) == ("bag", 5, ())
    assert "/odom (nav_msgs/msg/Odometry, 10 messages)" in found.topics


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_storage_file_alone_is_a_bag(tmp_path: Path, kind: str) -> None:
    bag = walking(False).write(tmp_path / "run", kind)
    (bag / "metadata.yaml").unlink()
    assert len(Recording.open(convert(bag, tmp_path / "out")).frames) == 5
    assert len(Recording.open(convert(next(bag.glob(f"*.{kind}")), tmp_path / "file")).frames) == 5


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_ros2_folder_may_be_named_like_a_file_of_ros1(tmp_path: Path, kind: str) -> None:
    bag = walking(False).write(tmp_path / "team.bag", kind)
    found = info(bag)
    assert (found.format, found.images, found.faults) == ("bag", 5, ())
    assert len(Recording.open(convert(bag, tmp_path / "out")).frames) == 5


@pytest.mark.parametrize("source", ["pose_stamped", "path"])
def test_odometry_may_be_poses_or_a_path(tmp_path: Path, source: str) -> None:
    script = walking(True, odometry=None)
    stamps_ns = [ZERO_NS + k * 10**9 for k in range(6)]
    if source == "path":
        script.path("/path", stamps_ns[:3])
        script.path("/path", stamps_ns)
    else:
        for k, stamp_ns in enumerate(stamps_ns):
            script.pose_stamped("/pose", stamp_ns, float(k))
    recording = Recording.open(convert(script.write(tmp_path / "run.bag"), tmp_path / "out"))
    assert [frame.T_odom_body[0, 3] for frame in recording.frames] == pytest.approx([k + 0.2 for k in range(5)])
    assert len(read_tum(tmp_path / "out" / "odometry.tum")) == 6


COLOUR = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
RAW = [
    ("rgb8", COLOUR, COLOUR),
    ("bgr8", COLOUR[..., ::-1], COLOUR),
    ("bgra8", np.dstack([COLOUR[..., ::-1], COLOUR[..., 0]]), COLOUR),
    ("mono8", COLOUR[..., 1], np.repeat(COLOUR[..., 1:2], 3, axis=2)),
    ("mono16", COLOUR[..., 1].astype(np.uint16) * 256 + 7, np.repeat(COLOUR[..., 1:2], 3, axis=2)),
]


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(("encoding", "pixels", "expected"), RAW)
def test_raw_images_keep_their_pixels(tmp_path: Path, encoding: str, pixels, expected, padding: int) -> None:  # type: ignore[no-untyped-def]
    script = BagScript(False)
    script.camera_info("/cam/camera_info", ZERO_NS)
    script.raw("/cam/image_raw", ZERO_NS, np.ascontiguousarray(pixels), encoding, padding)
    script.odometry("/odom", ZERO_NS, 0.0)
    recording = Recording.open(convert(script.write(tmp_path / "run", "db3"), tmp_path / "out"))
    np.testing.assert_array_equal(recording.load_image(recording.frames[0]).pixels, expected)


def test_a_bayer_image_gets_its_colours_back(tmp_path: Path) -> None:
    mosaic = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mosaic[0::2, 0::2] = 200
    script = BagScript(False)
    script.camera_info("/cam/camera_info", ZERO_NS)
    script.raw("/cam/image_raw", ZERO_NS, mosaic, "bayer_rggb8")
    script.odometry("/odom", ZERO_NS, 0.0)
    recording = Recording.open(convert(script.write(tmp_path / "run", "db3"), tmp_path / "out"))
    assert recording.load_image(recording.frames[0]).pixels[10, 10].tolist() == [200, 0, 0]


def test_raw_images_may_be_written_as_jpeg(tmp_path: Path) -> None:
    script = BagScript(False)
    script.raw("/cam/image_raw", ZERO_NS, np.full((HEIGHT, WIDTH, 3), (200, 10, 10), np.uint8), "rgb8")
    script.odometry("/odom", ZERO_NS, 0.0)
    bag = script.write(tmp_path / "run", "db3")
    recording = Recording.open(convert(bag, tmp_path / "out", camera=camera_file(tmp_path), jpeg=True))
    assert recording.frames[0].image_path.suffix == ".jpg"
    assert recording.load_image(recording.frames[0]).pixels[5, 5].tolist() == pytest.approx([200, 10, 10], abs=4)


def test_every_thins_images_out(tmp_path: Path) -> None:
    recording = Recording.open(convert(walking(False).write(tmp_path / "run", "mcap"), tmp_path / "out", every=2))
    assert [round(frame.stamp_s - 1.6e9, 1) for frame in recording.frames] == [0.2, 2.2, 4.2]


@pytest.mark.parametrize("kind", KINDS)
def test_a_conversion_that_was_killed_goes_on(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = walking(kind == "bag", 40).write(bag_path(tmp_path, kind), kind)
    whole, out = convert(bag, tmp_path / "whole"), tmp_path / "out"
    monkeypatch.setattr("flocc_launch.datasets.bag_convert.CHECKPOINT_MESSAGES", 10)

    def stop(done: int, total: int) -> None:
        if done == 25:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert_bag(bag, out, progress=stop)
    reread: list[int] = []
    convert_bag(bag, out, progress=lambda done, total: reread.append(done))
    assert len(reread) < 25
    for name in ("images.txt", "odometry.tum"):
        assert (out / name).read_text() == (whole / name).read_text()


KILLED_CONVERSION = """
import os, signal, sys
from pathlib import Path
from flocc_launch.datasets import bag_convert

bag_convert.CHECKPOINT_MESSAGES = 25
kill_at = int(sys.argv[3])
bag_convert.convert_bag(
    Path(sys.argv[1]), Path(sys.argv[2]),
    progress=lambda done, total: os.kill(os.getpid(), signal.SIGKILL) if done == kill_at else None,
)
"""


@pytest.mark.parametrize(("kind", "kills"), [("bag", (3, 61, 139)), ("db3", (118,)), ("mcap", (33, 140))])
def test_a_conversion_that_met_kill_9_loses_nothing(tmp_path: Path, kind: str, kills: tuple[int, ...]) -> None:
    bag = walking(kind == "bag", 140).write(bag_path(tmp_path, kind), kind)
    whole, out = convert(bag, tmp_path / "whole"), tmp_path / "out"
    killed = 0
    for kill_at in kills:
        ran = subprocess.run([sys.executable, "-c", KILLED_CONVERSION, str(bag), str(out), str(kill_at)], check=False)
        killed += ran.returncode == -signal.SIGKILL
    assert killed == len(kills)
    convert(bag, out)
    images = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    assert sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file()) == images
    assert [file for file in images if (out / file).read_bytes() != (whole / file).read_bytes()] == []


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_was_cut_off_is_kept_as_far_as_it_goes(tmp_path: Path, kind: str) -> None:
    script = walking(kind == "bag", 400)
    bag = script.write(bag_path(tmp_path, kind), kind)
    file = bag if kind == "bag" else next(bag.glob(f"*.{kind}"))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 3 // 5])
    with pytest.raises(DatasetError, match=r"run.*(damaged|cut off).*images were kept in"):
        convert(bag, tmp_path / "out", camera=camera_file(tmp_path))
    assert len(Recording.open(tmp_path / "out").frames) > 100


def test_memory_does_not_grow_with_the_bag(tmp_path: Path) -> None:
    peaks = []
    for count in (60, 300):
        script = walking(False, 0)
        script.odometry("/odom", ZERO_NS, 0.0)
        for k in range(count):
            script.compressed("/cam/image/compressed", ZERO_NS + k * 10**8, form="noise", size=(320, 240))
        bag = script.write(tmp_path / f"run{count}", "mcap")
        write_camera(tmp_path / "large.toml", Camera(320, 240, 300.0, 300.0, 160.0, 120.0), np.eye(4))
        tracemalloc.start()
        convert(bag, tmp_path / f"out{count}", camera=tmp_path / "large.toml")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


def test_a_missing_topic_is_said_with_what_there_is(tmp_path: Path) -> None:
    bag = walking(False).write(tmp_path / "run", "db3")
    with pytest.raises(DatasetError, match=r"run: has no topic /left; it has .*/odom \(nav_msgs/msg/Odometry, 10"):
        convert(bag, tmp_path / "out", image_topic="/left")


def test_a_topic_of_another_type_is_refused(tmp_path: Path) -> None:
    bag = walking(False).write(tmp_path / "run", "db3")
    with pytest.raises(DatasetError, match="topic /odom is of type nav_msgs/msg/Odometry, not one of sensor_msgs"):
        convert(bag, tmp_path / "out", image_topic="/odom")


def test_several_candidates_are_listed(tmp_path: Path) -> None:
    script = walking(True)
    script.compressed("/right/image/compressed", ZERO_NS)
    with pytest.raises(DatasetError, match=r"has 2 image topics, name one with --image-topic: /cam/.*, /right/"):
        convert(script.write(tmp_path / "run.bag"), tmp_path / "out")


def test_a_bag_without_odometry_needs_a_file(tmp_path: Path) -> None:
    bag = walking(True, odometry=None).write(tmp_path / "run.bag")
    with pytest.raises(DatasetError, match=r"run.bag: has no odometry topic; it has /cam/camera_info"):
        convert(bag, tmp_path / "out")
    poses = np.repeat(np.eye(4)[None], 9, axis=0)
    write_tum(tmp_path / "vio.tum", Trajectory(1.6e9 + np.linspace(0, 4, 9), poses))
    assert len(Recording.open(convert(bag, tmp_path / "out", odometry=tmp_path / "vio.tum")).frames) == 4


def test_missing_intrinsics_are_said(tmp_path: Path) -> None:
    script = walking(True)
    script.messages = [message for message in script.messages if "camera_info" not in message[0]]
    with pytest.raises(DatasetError, match=r"run.bag: intrinsics are missing or unclear .* --camera"):
        convert(script.write(tmp_path / "run.bag"), tmp_path / "out")


def test_an_unknown_compression_is_said_and_the_rest_is_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = walking(False)
    script.compressed("/cam/image/compressed", ZERO_NS + 9 * 10**9, form="webp")
    convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")
    assert "/cam/image/compressed: 1 of 6 messages were left out: an image compressed as 'webp'" in caplog.text
    assert len(Recording.open(tmp_path / "out").frames) == 5


def test_an_unknown_encoding_is_said(tmp_path: Path) -> None:
    script = walking(False, 1)
    script.raw("/depth", ZERO_NS, np.zeros((HEIGHT, WIDTH), np.float32), "32FC1")
    with pytest.raises(
        DatasetError, match="topic /depth: 1 of 1 messages were left out: images are encoded as '32FC1', "
    ):
        convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out", image_topic="/depth")


def test_time_going_backwards_is_said_and_the_rest_is_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = walking(False)
    script.messages[-1][3].header.stamp.sec -= 3
    convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")
    assert "/cam/image/compressed: time goes backwards, from " in caplog.text
    assert "; 1 of 5 messages were left out" in caplog.text
    assert len(Recording.open(tmp_path / "out").frames) == 4


@pytest.mark.parametrize(
    ("x", "q_xyzw", "sentence"),
    [
        (float("nan"), (0, 0, 0, 1), "a pose has a number that is not finite"),
        (1.0, (0, 0, 0, 2), "a pose is not rigid"),
        (1.0, (0, 0, 0, 0), "odometry gives no pose (its quaternion is zero), as where it is lost"),
    ],
)
def test_a_broken_pose_costs_itself(
    tmp_path: Path, x: float, q_xyzw: tuple[float, float, float, float], sentence: str, caplog: pytest.LogCaptureFixture
) -> None:
    script = walking(False, 3)
    script.odometry("/odom", ZERO_NS + 10**10, x, q_xyzw)
    convert(script.write(tmp_path / "run", "db3"), tmp_path / "out")
    assert f"/odom: 1 of 7 messages were left out: {sentence}" in caplog.text
    assert len(Recording.open(tmp_path / "out").frames) == 3


def test_odometry_that_calls_itself_lost_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = walking(False, 6)
    poses = [message for topic, _, _, message in script.messages if topic == "/odom"]
    poses[5].pose.covariance = np.full(36, 9999.0)
    poses[5].pose.pose.position.x = 99.0
    convert(script.write(tmp_path / "run", "db3"), tmp_path / "out")
    assert "/odom: 1 of 12 messages were left out: odometry calls itself lost" in caplog.text
    assert np.max(np.loadtxt(tmp_path / "out" / "odometry.tum")[:, 1]) < 10


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_of_other_frames_is_not_mixed_in(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    """Two publishers of one topic: the poses of the second were taken for those of the first."""
    script = walking(kind == "bag", count=10)
    script.child = "other"
    for k in range(2):
        script.odometry("/odom", ZERO_NS + k * 10**9 + 10**8, 70.0)
    script.messages.sort(key=lambda message: message[2])
    recording = Recording.open(convert(script.write(bag_path(tmp_path, kind), kind), tmp_path / "out"))
    assert max(frame.T_odom_body[0, 3] for frame in recording.frames) < 10
    assert (
        "2 of 22 messages were left out: a pose is of the frames camera to other, the first one of camera to body"
        in (caplog.text)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_intrinsics_that_change_are_refused(tmp_path: Path, kind: str) -> None:
    script = walking(kind == "bag")
    script.camera_info("/cam/camera_info", ZERO_NS + 2 * 10**9)
    convert(script.write(bag_path(tmp_path, kind), kind), tmp_path / "same")
    script.camera_info("/cam/camera_info", ZERO_NS + 3 * 10**9, 45.0)
    (tmp_path / "zoom").mkdir()
    bag = script.write(bag_path(tmp_path / "zoom", kind), kind)
    with pytest.raises(DatasetError, match=r"/cam/camera_info: intrinsics differ from the first ones in 1 messages"):
        convert(bag, tmp_path / "out")
    assert len(Recording.open(convert(bag, tmp_path / "own", camera=camera_file(tmp_path))).frames) == 5


def test_a_camera_that_is_not_calibrated_is_said_with_what_to_do(tmp_path: Path) -> None:
    script = BagScript(True)
    script.camera_info("/cam/camera_info", ZERO_NS, 0.0)
    script.messages += walking(True).messages[1:]
    bag = script.write(bag_path(tmp_path, "bag"))
    with pytest.raises(DatasetError, match=r"run.bag: topic /cam/camera_info: .*; name a camera file with --camera"):
        convert(bag, tmp_path / "out")


def test_odometry_whose_stamp_stands_still_is_refused(tmp_path: Path) -> None:
    script = walking(True, odometry=None)
    for k in range(5):
        script.odometry("/odom", ZERO_NS + 10**9, float(k))
    with pytest.raises(DatasetError, match="4 of 5 messages were left out: the stamp is that of the pose before"):
        convert(script.write(bag_path(tmp_path, "bag")), tmp_path / "out")


def test_images_in_gaps_of_odometry_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = walking(True, odometry=None)
    for stamp_s, x in ((0.0, 0.0), (1.0, 1.0), (20.0, 20.0)):
        script.odometry("/odom", ZERO_NS + round(stamp_s * 1e9), x)
    convert(script.write(bag_path(tmp_path, "bag")), tmp_path / "out")
    assert "4 of 5 images lie outside of the time of odometry (/odom), or in a gap of it: no robot uses" in caplog.text


def test_two_programs_on_one_topic_of_odometry_are_refused(tmp_path: Path) -> None:
    script = walking(True, odometry=None)
    for k in range(60):
        script.odometry("/odom", ZERO_NS + k * 10**8, 0.1 * k + (80.0 if k // 4 % 2 else 0.0))
    with pytest.raises(DatasetError, match=r"odometry begins anew 14 times in 60 messages, as where two programs"):
        convert(script.write(bag_path(tmp_path, "bag")), tmp_path / "out")


def test_too_many_damaged_messages_are_refused(tmp_path: Path) -> None:
    script = walking(False)
    for k in range(3):
        script.compressed("/cam/image/compressed", ZERO_NS + (9 + k) * 10**9, form="webp")
    with pytest.raises(DatasetError, match=r"3 of 8 messages were left out: an image compressed as 'webp'.*5 images"):
        convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")


def test_images_of_another_size_than_the_intrinsics_are_refused(tmp_path: Path) -> None:
    script = walking(False, 0)
    script.compressed("/cam/image/compressed", ZERO_NS, size=(64, 48))
    script.odometry("/odom", ZERO_NS, 0.0)
    with pytest.raises(DatasetError, match="the image is 64x48, but the intrinsics are for 32x24"):
        convert(script.write(tmp_path / "run", "db3"), tmp_path / "out")


@pytest.mark.parametrize("length", [50, 400])
def test_a_message_that_is_cut_costs_itself(tmp_path: Path, length: int, caplog: pytest.LogCaptureFixture) -> None:
    bag = walking(False, 3).write(tmp_path / "run", "db3")
    with sqlite3.connect(next(bag.glob("*.db3"))) as database:
        database.execute(f"UPDATE messages SET data = substr(data, 1, {length}) WHERE id = 6")
    convert(bag, tmp_path / "out")
    assert "/odom: 1 of 6 messages were left out: a message cannot be read as nav_msgs/msg/Odometry" in caplog.text
    assert len(Recording.open(tmp_path / "out").frames) == 3


def test_a_message_of_another_distribution_is_said(tmp_path: Path) -> None:
    bag = walking(False).write(tmp_path / "run", "db3")
    with sqlite3.connect(next(bag.glob("*.db3"))) as database:
        database.execute("UPDATE messages SET data = substr(data, 1, 9) WHERE topic_id = 2")
        database.execute("UPDATE messages SET data = substr(data, 1, 9) WHERE topic_id = 3")
    with pytest.raises(
        DatasetError, match=r"5 of 5 messages were left out: a message cannot be read as .*distribution"
    ):
        convert(bag, tmp_path / "out")


def small(lens_camera: CameraModel) -> tuple[int, int]:
    return lens_camera.width, lens_camera.height


def write_motion(folder: Path, names: list[str], start_s: float, offset_m: float = 0.0) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        poses = np.repeat(np.eye(4)[None], 9, axis=0)
        poses[:, 0, 3] = offset_m + np.arange(9)
        write_tum(folder / name, Trajectory(start_s + np.linspace(0, 4, 9), poses))
    return folder


def test_s3e_in_its_published_layout(tmp_path: Path) -> None:
    script = BagScript(False)
    for k in range(4):
        for robot in ("Alpha", "Bob", "Carol"):
            stamp_ns = ZERO_NS + k * 10**9
            size = small(S3E_ALPHA.camera) if robot == "Alpha" else (WIDTH, HEIGHT)
            for side in ("left", "right"):
                script.compressed(f"/{robot}/{side}_camera/compressed", stamp_ns, size=size)
    bag = script.write(tmp_path / "S3E_Square_1", "db3")
    team = Team(
        odometry=write_motion(tmp_path / "odometry", ["alpha.tum", "bob.tum", "carol.txt"], 1.6e9),
        truth=write_motion(tmp_path / "truth", ["alpha_gt.txt", "bob_gt.txt", "carol_gt.txt"], 1.6e9),
        cameras={"bob": camera_file(tmp_path), "carol": camera_file(tmp_path)},
    )
    folders = convert_s3e(bag, tmp_path / "out", team)
    assert [folder.name for folder in folders] == ["alpha", "bob", "carol"]
    recordings = [Recording.open(folder) for folder in folders]
    assert recordings[0].camera == S3E_ALPHA.camera.agent_camera()
    np.testing.assert_allclose(recordings[0].T_body_camera, S3E_ALPHA.T_body_camera, atol=1e-6)
    assert [len(recording.frames) for recording in recordings] == [4, 4, 4]
    assert all(recording.truth is not None for recording in recordings)


def test_s3e_says_whose_camera_is_missing(tmp_path: Path) -> None:
    bag = walking(False, image="/Alpha/left_camera/compressed").write(tmp_path / "S3E", "db3")
    team = Team(odometry=write_motion(tmp_path / "odometry", ["alpha.tum", "bob.tum"], 1.6e9))
    with pytest.raises(DatasetError, match="the image is 32x24, but the intrinsics are for 1224x1024"):
        convert_s3e(bag, tmp_path / "out", team)
    team = replace(team, cameras={"alpha": camera_file(tmp_path)})
    with pytest.raises(DatasetError, match="bob: intrinsics are missing: S3E publishes no calibration of Bob"):
        convert_s3e(bag, tmp_path / "out", team)


@pytest.mark.parametrize(
    ("preset", "camera", "sentence"),
    [("kitti", "a=b", "the preset 'kitti' is not known; there are s3e, graco"), ("s3e", "bob", "must be ROBOT=FILE")],
)
def test_a_team_that_cannot_be_is_refused(tmp_path: Path, preset: str, camera: str, sentence: str) -> None:
    with pytest.raises(DatasetError, match=sentence):
        convert_team(preset, tmp_path, tmp_path / "out", tmp_path, None, [camera])


def test_the_command_line_converts_a_bag(tmp_path: Path) -> None:
    bag = walking(True).write(tmp_path / "run.bag")
    options = ["--image-topic", "/cam/image/compressed", "--every", "2", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(dataset, ["convert", str(bag), *options])
    assert result.exit_code == 0, result.output
    assert len(Recording.open(tmp_path / "out").frames) == 3


def test_a_bag_is_converted_before_it_is_split(tmp_path: Path) -> None:
    bag = walking(False, 8).write(tmp_path / "run", "mcap")
    with pytest.raises(DatasetError, match="run: is a bag; make a recording of it first"):
        split(bag, tmp_path / "parts", 2)
    folders = split(convert(bag, tmp_path / "out"), tmp_path / "parts", 2)
    assert [len(Recording.open(folder).frames) for folder in folders] == [4, 4]


def test_graco_in_its_published_layout(tmp_path: Path) -> None:
    (tmp_path / "bags").mkdir()
    width, height = small(GRACO_GROUND.camera)
    pixels = np.full((height, width), 80, dtype=np.uint8)
    for number, day in (("01", 0), ("02", 86400)):
        script = BagScript(True)
        for k in range(3):
            for side in ("left", "right"):
                script.raw(f"/camera_{side}/image_raw", ZERO_NS + (day + k) * 10**9, pixels, "mono8")
        script.write(tmp_path / "bags" / f"ground-{number}.bag")
    odometry, truth = tmp_path / "odometry", tmp_path / "truth"
    for name, start_s in (("ground-01.txt", 1.6e9), ("ground-02.txt", 1.6e9 + 86400)):
        write_motion(odometry, [name], start_s)
        write_motion(truth, [name], start_s, 4.0e5 if "01" in name else 4.0e5 + 7)
    folders = convert_graco(tmp_path / "bags", tmp_path / "out", Team(odometry=odometry, truth=truth))
    recordings = [Recording.open(folder) for folder in folders]
    assert [folder.name for folder in folders] == ["ground-01", "ground-02"]
    assert [[frame.stamp_s for frame in recording.frames] for recording in recordings] == [[0, 1, 2], [0, 1, 2]]
    starts = [recording.ground_truth(0.0) for recording in recordings]
    assert [float(T[0, 3]) for T in starts if T is not None] == pytest.approx([0.0, 7.0], abs=1e-3)
    assert recordings[1].camera == GRACO_GROUND.camera.agent_camera()


@pytest.mark.parametrize("ros1", [True, False])
def test_raw_images_of_twelve_bits_have_one_pair_of_levels(
    tmp_path: Path, ros1: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Case 18: a dark start of the bag does not decide how bright the rest is."""
    script = walking(ros1, 0)
    ramp = np.linspace(0, 3824, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    for k in range(6):
        script.odometry("/odom", ZERO_NS + k * 10**9, float(k))
        dark = ramp / 16 if k < 2 else ramp
        script.raw("/cam/image_raw", ZERO_NS + k * 10**9, dark.astype(np.uint16), "mono16")
    bag = script.write(tmp_path / ("run.bag" if ros1 else "run"), "bag" if ros1 else "mcap")
    recording = Recording.open(convert(bag, tmp_path / "out"))
    found = [cv2.imread(str(frame.image_path), cv2.IMREAD_UNCHANGED) for frame in recording.frames]
    assert [(each.dtype.type, int(each.max())) for each in found if each is not None] == [(np.uint8, 14)] * 2 + [
        (np.uint8, 239)
    ] * 4
    assert "images of 16 bits use 0 to 4095, which become 0 to 255" in caplog.text


def test_a_bag_of_a_wide_lens_becomes_a_pinhole(tmp_path: Path) -> None:
    """Field of view as chosen, and images of the camera that the recording names."""
    script = walking(False, 4)
    info = script.messages[0][3]
    info.distortion_model, info.d = "equidistant", np.array([0.01, 0.0, 0.0, 0.0])
    bag = script.write(tmp_path / "run", "mcap")
    recording = Recording.open(convert(bag, tmp_path / "out", view_deg=45.0))
    assert recording.camera.distortion == (0.0, 0.0, 0.0, 0.0)
    view_deg = 2 * np.degrees(np.arctan(recording.camera.width / 2 / recording.camera.fx))
    assert view_deg == pytest.approx(45.0, abs=1.0)
    assert len(recording.frames) == 4
    assert recording.load_image(recording.frames[3]).pixels.shape[:2] == (
        recording.camera.height,
        recording.camera.width,
    )


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("zeros", [False, True])
def test_a_damaged_chunk_of_an_mcap_costs_itself(tmp_path: Path, compressed: bool, zeros: bool) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    jpeg = cv2.imencode(".jpg", np.random.default_rng(1).integers(0, 255, (60, 80, 3), dtype=np.uint8))[1].ravel()
    writer = Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP)
    if compressed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    kinds = {"/odom": "nav_msgs/msg/Odometry", "/image/compressed": "sensor_msgs/msg/CompressedImage"}
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for k in range(5000):
            topic = "/odom" if k % 5 else "/image/compressed"
            make = bag_speed.odometry if k % 5 else bag_speed.image
            stamp_ns = 10**18 + k * 10**7
            raw = bytes(store.serialize_cdr(make(store, stamp_ns, jpeg), kinds[topic]))
            writer.write(connections[topic], stamp_ns, raw)
    file = next((tmp_path / "run").glob("*.mcap"))
    data = bytearray(file.read_bytes())
    chunks, at = [], 8
    while at + 9 <= len(data) - 8:
        operation, length = struct.unpack_from("<BQ", data, at)
        chunks += [(at + 9, length)] if operation == 6 else []
        at += 9 + length
    assert len(chunks) >= 6
    begin, length = chunks[len(chunks) // 2]
    start, size = (begin, length) if zeros else (begin + length // 2, 400)
    data[start : start + size] = bytes(size) if zeros else b"\xff" * size
    file.write_bytes(data)
    (tmp_path / "camera.yaml").write_text("width: 80\nheight: 60\nfx: 60\nfy: 60\ncx: 40\ncy: 30\n")
    convert_bag(tmp_path / "run", tmp_path / "out", BagOptions(camera=tmp_path / "camera.yaml"))
    frames = Recording.open(tmp_path / "out").frames
    assert len(frames) >= 1000 * (1 - 1.5 / len(chunks))
    assert frames[-1].stamp_s == pytest.approx(10**9 + 49.95)
