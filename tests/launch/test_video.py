"""A video file is cut into its frames; where odometry or intrinsics are missing, one sentence says so."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_launch.datasets.commands import convert, info, infos, split
from flocc_launch.datasets.source import DatasetError
from flocc_launch.datasets.video import odometry_beside
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.shipped import read_scenario

FRAMES, RATE_HZ = 30, 10.0


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), RATE_HZ, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MP4")
    for k in range(FRAMES):
        writer.write(np.full((48, 64, 3), 8 * k, np.uint8))
    writer.release()
    return path


def beside(video: Path, zero_s: float = 0.0) -> None:
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = np.arange(40)
    write_tum(video.with_suffix(".tum"), Trajectory(zero_s + 0.1 * np.arange(40.0), poses))
    (video.parent / "camera.yaml").write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 32\ncy: 24\n")


def test_frames_get_the_stamps_of_the_video(video: Path, tmp_path: Path) -> None:
    beside(video)
    found = info(video)
    assert (found.format, found.images, found.odometry_poses, found.faults) == ("video", FRAMES, 40, ())
    assert found.to_s == pytest.approx((FRAMES - 1) / RATE_HZ)  # of the last frame, not the end of the video
    recording = Recording.open(convert(video, tmp_path / "out"))
    assert [frame.stamp_s for frame in recording.frames] == pytest.approx([0.1 * k for k in range(FRAMES)], abs=0.002)
    assert [frame.T_odom_body[0, 3] for frame in recording.frames] == pytest.approx(range(FRAMES), abs=0.03)
    assert recording.load_image(recording.frames[20]).pixels.mean() == pytest.approx(160, abs=6)


def test_what_lies_beside_a_video_under_its_name_is_told(
    video: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    beside(video)
    (video.parent / "walk_timestamps.csv").write_text("0,0.0\n")
    (video.parent / "walker.txt").write_text("of another\n")
    write_tum(video.parent / "odometry.tum", Trajectory(np.arange(40.0), np.tile(np.eye(4), (40, 1, 1))))
    convert(video, tmp_path / "out")
    told = "walk.mp4: not used: odometry.tum, walk_timestamps.csv"
    assert caplog.text.strip().endswith(told)
    assert [note.partition(str(video.parent) + "/")[2] for note in info(video).notes] == [told]
    (video.parent / "walk.csv").write_text(
        "time[s],x,y,z,qx,qy,qz,qw\n" + "".join(f"{k},{k},{k},0,0,0,0,1\n" for k in range(9))
    )
    with pytest.raises(DatasetError, match=r"walk.tum and walk.csv tell different motions"):
        convert(video, tmp_path / "out2")


def test_a_video_without_odometry_says_what_is_needed(video: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"walk.mp4: a video has no odometry: give the camera's metric trajectory"):
        convert(video, tmp_path / "out")
    assert "a video has no odometry" in info(video).faults[0]
    beside(video)
    (video.parent / "camera.yaml").unlink()
    with pytest.raises(DatasetError, match=r"walk.mp4: intrinsics are missing"):
        convert(video, tmp_path / "out")


def test_odometry_of_another_clock_is_refused(video: Path, tmp_path: Path) -> None:
    beside(video, 1.6e9)
    with pytest.raises(DatasetError, match=r"walk.tum: the trajectory is from 1600000000.000 s .* first frame"):
        convert(video, tmp_path / "out")


@pytest.mark.parametrize(
    ("option", "value", "flag"),
    [("time_offset_s", 5.0, "--time-offset"), ("truth", Path("gt.tum"), "--truth"), ("format_name", "tum", "--format")],
)
def test_an_option_that_says_nothing_of_a_video_is_refused(
    video: Path, tmp_path: Path, option: str, value: object, flag: str
) -> None:
    beside(video)
    with pytest.raises(DatasetError, match=rf"walk.mp4: is a video, but {flag} counts for a (folder|bag) only"):
        convert(video, tmp_path / "out", **{option: value})  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_a_video_of_a_wide_lens_keeps_the_field_of_view_that_is_chosen(video: Path, tmp_path: Path) -> None:
    beside(video)
    (video.parent / "camera.yaml").write_text(
        "width: 64\nheight: 48\nfx: 30\nfy: 30\ncx: 32\ncy: 24\ndistortion_model: equidistant\n"
        "distortion: [0.0, 0.0, 0.0, 0.0]\n"
    )
    for view_deg in (60.0, 80.0):
        camera = Recording.open(convert(video, tmp_path / str(view_deg), view_deg=view_deg)).camera
        assert 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx)) == pytest.approx(view_deg, abs=2)
    with pytest.raises(DatasetError, match="holds another recording"):
        convert(video, tmp_path / "60.0", view_deg=80.0)


def test_a_video_is_launched_and_one_that_is_none_is_refused(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    beside(video)
    paths = recordings(read_scenario(str(video), {}, agents=2))
    assert [len(Recording.open(path).frames) for path in paths.values()] == [15, 15]
    with pytest.raises(DatasetError, match="is a video; make a recording of it first"):
        split(video, tmp_path / "parts")
    (tmp_path / "team").mkdir()
    (tmp_path / "team" / "broken.mp4").write_bytes(b"no video")
    with pytest.raises(DatasetError, match="team: 1 of 1 robots cannot be used: broken"):
        list(infos(tmp_path / "team"))
    assert "broken.mp4: cannot be read as a video; write it as MP4" in caplog.text


def test_frames_that_no_pose_covers_are_told_or_refused(
    video: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    beside(video, 1.5)
    assert info(video).posed == 15
    convert(video, tmp_path / "out")
    assert "walk.mp4: 15 of 30 frames lie outside of the trajectory's time, or in a gap of it" in caplog.text
    poses = np.tile(np.eye(4), (30, 1, 1))
    write_tum(video.with_suffix(".tum"), Trajectory(100 * np.arange(30.0), poses))
    with pytest.raises(DatasetError, match=r"walk.tum: .* in steps of 100.000 s, .* so that 1 frame has a pose"):
        convert(video, tmp_path / "other")
    assert "1 frame has a pose" in info(video).faults[0]


def test_what_stands_beside_videos_is_not_called_not_taken(video: Path, caplog: pytest.LogCaptureFixture) -> None:
    beside(video)
    (video.parent / "README").write_text("mine")
    list(infos(video.parent))
    assert caplog.text.rstrip().endswith("bag or video: README")


def test_a_folder_that_is_converted_names_what_it_holds(video: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"inside of it, walk\.mp4 would be"):
        convert(video.parent, tmp_path / "out")
    (tmp_path / "set" / "sequences" / "00" / "image_0").mkdir(parents=True)
    with pytest.raises(DatasetError, match=r"inside of it, sequences.00 would be"):
        convert(tmp_path / "set", tmp_path / "out")


def test_one_trajectory_is_not_that_of_two_videos(video: Path) -> None:
    beside(video)
    (video.parent / f"{video.stem}.tum").rename(video.parent / "odometry.tum")
    assert odometry_beside(video) is not None
    shutil.copyfile(video, video.with_name("other.mp4"))
    assert odometry_beside(video) is None
