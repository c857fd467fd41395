"""Topics, frames and clocks of a bag belong together as the bag says, or the bag is refused with what there is."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from tests.launch.bag_fixtures import ZERO_NS, BagScript, walking

from flocc_agent.runtime.recording import Recording
from flocc_launch.datasets.commands import convert, info, infos
from flocc_launch.datasets.journeys import JourneyWatch
from flocc_launch.datasets.source import DatasetError
from flocc_launch.datasets.stamp_gaps import StampGaps
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.shipped import read_scenario

S = 10**9
FORWARD = (-0.5, 0.5, -0.5, 0.5)


def mounted(script: BagScript, body: str = "body") -> BagScript:
    """The camera 0.2 m ahead and 0.3 m up, looking forward, by way of its housing."""
    script.transform("/tf_static", ZERO_NS, (body, "housing"), (0.2, 0.0, 0.3))
    script.transform("/tf_static", ZERO_NS, ("housing", "camera"), q_xyzw=FORWARD)
    script.messages.sort(key=lambda message: message[2])
    return script


@pytest.mark.parametrize("ros1", [False, True])
def test_the_mounting_is_the_chain_of_static_transforms(tmp_path: Path, ros1: bool) -> None:
    bag = mounted(walking(ros1)).write(tmp_path / ("run.bag" if ros1 else "run"), "bag" if ros1 else "mcap")
    T = Recording.open(convert(bag, tmp_path / "out")).T_body_camera
    expected = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]])
    np.testing.assert_allclose(T, expected, atol=1e-9)


def test_transforms_that_do_not_reach_the_camera_are_refused(tmp_path: Path) -> None:
    bag = mounted(walking(False), "trailer").write(tmp_path / "run", "db3")
    with pytest.raises(
        DatasetError, match="no chain of static transforms leads from body, which /odom moves, to camera"
    ):
        convert(bag, tmp_path / "out")
    assert "no chain of static transforms" in info(bag).faults[0]


def test_a_bag_that_says_nothing_of_the_mounting_is_told_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    convert(walking(False).write(tmp_path / "run", "db3"), tmp_path / "out")
    assert "nothing says where the camera (camera) sits on the body (body)" in caplog.text


def test_odometry_may_be_transforms_alone(tmp_path: Path) -> None:
    script = walking(False, odometry=None)
    for k in range(11):
        stamp_ns = ZERO_NS + k * S // 2
        script.transform("/tf", stamp_ns, ("map", "odom"), (100.0, 0.0, 0.0))
        script.transform("/tf", stamp_ns, ("odom", "body"), (0.5 * k, 0.0, 0.0))
        script.transform("/tf", stamp_ns, ("body", "wheel"), q_xyzw=(0.0, 1.0, 0.0, 0.0))
    bag = mounted(script).write(tmp_path / "run", "mcap")
    assert "odometry /tf:odom.body" in info(bag).robots[0]
    frames = Recording.open(convert(bag, tmp_path / "out")).frames
    assert [frame.T_odom_body[0, 3] for frame in frames] == pytest.approx([k + 0.2 for k in range(5)])
    named = convert(bag, tmp_path / "named", odometry_topic="/tf:odom.body")
    assert len(Recording.open(named).frames) == 5
    with pytest.raises(DatasetError, match=r"has no transform /tf:odom.base; there are /tf:body.wheel, /tf:map.odom"):
        convert(bag, tmp_path / "other", odometry_topic="/tf:odom.base")


def team(frames: tuple[str, str] | None = None) -> BagScript:
    """Two robots with cameras, intrinsics and odometry under their namespaces; frames of image and odometry."""
    script = BagScript(False)
    for number, name in enumerate(("Alpha", "bob_2")):
        script.frame, script.child = frames or (f"{name}/camera", f"{name}/camera")
        script.camera_info(f"/{name}/cam/camera_info", ZERO_NS)
        for k in range(4):
            script.odometry(f"/{name}/odom", ZERO_NS + k * S, float(10 * number + k))
            script.compressed(f"/{name}/cam/image/compressed", ZERO_NS + k * S, 50 + number)
            script.raw(f"/{name}/depth/image", ZERO_NS + k * S, np.zeros((4, 4), np.uint16), "16UC1")
    script.messages.sort(key=lambda message: message[2])
    return script


def test_what_is_so_for_all_robots_of_a_bag_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    convert(team(("camera", "body")).write(tmp_path / "team", "mcap"), tmp_path / "out")
    assert re.findall(r"nothing says where the camera .* if not(.*)", caplog.text) == [" (so for 2 robots)"]


def test_a_bag_of_two_robots_becomes_two_recordings(tmp_path: Path) -> None:
    bag = team().write(tmp_path / "team", "mcap")
    convert(bag, tmp_path / "out")
    found = {name: Recording.open(tmp_path / "out" / name) for name in ("alpha", "bob_2")}
    assert [recording.frames[0].T_odom_body[0, 3] for recording in found.values()] == [0.0, 10.0]
    assert [len(recording.frames) for recording in found.values()] == [4, 4]
    assert (
        info(bag).robots[0].startswith("Alpha: images /Alpha/cam/image/compressed, intrinsics /Alpha/cam/camera_info")
    )


def test_a_bag_of_two_robots_is_launched_as_two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    told: list[str] = []
    scenario = read_scenario(str(team().write(tmp_path / "team", "db3")), {}, tell=told.append)
    assert scenario.names() == ["alpha", "bob_2"]
    assert "Alpha: images /Alpha/cam/image/compressed, " in told[0]
    paths = recordings(scenario)
    assert [Recording.open(path).frames[0].T_odom_body[0, 3] for path in paths.values()] == [0.0, 10.0]


def robot_of(
    script: BagScript,
    images: str | None,
    odometry: str | None,
    x_m: float,
    frames: tuple[str, str] = ("camera", "body"),
) -> BagScript:
    """A robot's part of a bag, or half of one; its intrinsics lie beside its images."""
    script.frame, script.child = frames
    if images is not None:
        script.camera_info(images.replace("image_raw", "camera_info").replace("image_", "info_"), ZERO_NS, 30.0 + x_m)
    for k in range(4):
        if odometry is not None:
            script.odometry(odometry, ZERO_NS + k * S, x_m + k)
        if images is not None:
            script.compressed(f"{images}/compressed", ZERO_NS + k * S, 50)
    script.messages.sort(key=lambda message: message[2])
    return script


@pytest.mark.parametrize(
    ("images", "odometry", "names"),
    [
        ("/cam_{}/image_raw", "/odom_{}", ("r1", "r2")),
        ("/image_{}", "/odom_{}", ("r1", "r2")),
        ("/{}_camera/image_raw", "/{}_odom", ("r1", "r2")),
        ("/camera{}/image_raw", "/odom{}", ("1", "2")),
    ],
)
def test_robots_are_told_apart_by_a_part_of_a_name(
    tmp_path: Path, images: str, odometry: str, names: tuple[str, str]
) -> None:
    script = BagScript(False)
    for number, name in enumerate(names):
        robot_of(script, images.format(name), odometry.format(name), float(number), (f"{name}_c", f"{name}_b"))
    convert(script.write(tmp_path / "team", "mcap"), tmp_path / "out")
    found = {name: Recording.open(tmp_path / "out" / name) for name in names}
    assert [recording.frames[0].T_odom_body[0, 3] for recording in found.values()] == [0.0, 1.0]
    assert [recording.camera.fx for recording in found.values()] == [30.0, 31.0]


def test_two_cameras_of_one_odometry_are_not_two_robots(tmp_path: Path) -> None:
    script = robot_of(robot_of(BagScript(False), "/camera1/image_raw", "/odom", 0.0), "/camera2/image_raw", None, 1.0)
    with pytest.raises(DatasetError, match="has 2 image topics, name one with --image-topic"):
        convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")


@pytest.mark.parametrize(("first", "second"), [("r1", "r2"), ("r2", "r1")])
@pytest.mark.parametrize("half", ["images", "odometry"])
def test_a_whole_robot_is_taken_beside_half_of_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, first: str, second: str, half: str
) -> None:
    script = robot_of(BagScript(False), f"/{first}/cam/image_raw", f"/{first}/odom", 1.0)
    parts = (f"/{second}/cam/image_raw", None) if half == "images" else (None, f"/{second}/odom")
    bag = robot_of(script, parts[0], parts[1], 7.0).write(tmp_path / "team", "mcap")
    recording = Recording.open(convert(bag, tmp_path / "out"))
    assert recording.frames[0].T_odom_body[0, 3] == 1.0
    assert recording.camera.fx == 31.0
    told = f"{second} has images but no odometry" if half == "images" else f"not taken: /{second}/odom"
    assert told in caplog.text


@pytest.mark.parametrize(
    ("images", "odometry", "frames"),
    [
        ("/r1/cam/image_raw", "/r2/odom", ("", "")),
        ("/alpha/cam/image_raw", "/bob/odom", ("", "")),
        ("/image_raw", "/odom", ("r1/cam", "r2/base")),
    ],
)
def test_images_of_one_robot_do_not_get_the_odometry_of_another(
    tmp_path: Path, images: str, odometry: str, frames: tuple[str, str]
) -> None:
    script = robot_of(BagScript(False), images, None, 0.0, (frames[0] or "camera", ""))
    if "bob" in odometry:
        script.camera_info("/bob/cam/camera_info", ZERO_NS)
    robot_of(script, None, odometry, 5.0, (frames[1] or "odom", frames[1] or "body"))
    with pytest.raises(DatasetError, match=r"is another robot's odometry than that of .*image"):
        convert(script.write(tmp_path / "team", "mcap"), tmp_path / "out")


def test_a_body_that_odometry_does_not_name_is_found_on_tf_or_refused(tmp_path: Path) -> None:
    script = mounted(robot_of(BagScript(False), "/cam/image_raw", "/odom", 0.0, ("camera", "")))
    with pytest.raises(
        DatasetError, match=r"the camera \(camera\) sits on housing, but /odom does not say which frame"
    ):
        convert(script.write(tmp_path / "unnamed", "mcap"), tmp_path / "out")
    for frame in ("odom", "body"):
        script.transform("/tf", ZERO_NS, ("camera" if frame == "odom" else "odom", frame))
    bag = script.write(tmp_path / "run", "mcap")
    assert Recording.open(convert(bag, tmp_path / "found")).T_body_camera[:3, 3] == pytest.approx([0.2, 0.0, 0.3])


def test_a_mounting_that_static_transforms_give_twice_is_refused(tmp_path: Path) -> None:
    script = mounted(walking(False))
    script.transform("/tf_static", ZERO_NS + 9 * S, ("housing", "camera"), (0.0, 0.1, 0.0), FORWARD)
    with pytest.raises(DatasetError, match="place camera, between body and camera, in more than one way"):
        convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")


@pytest.mark.parametrize(("images", "info"), [("cam0", "cam1"), ("stereo/left", "stereo/right")])
@pytest.mark.parametrize("frame", ["", "camera"])
def test_intrinsics_of_the_other_camera_are_not_taken(tmp_path: Path, images: str, info: str, frame: str) -> None:
    script = robot_of(BagScript(False), f"/{images}/image_raw", "/odom", 0.0, (frame, "body"))
    script.messages = [
        (name.replace(images, info) if "info" in name else name, *rest) for name, *rest in script.messages
    ]
    with pytest.raises(DatasetError, match="intrinsics are missing or unclear"):
        convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")


@pytest.mark.parametrize("stamped", ["now", "never", "each"])
def test_a_path_gives_where_its_end_is(tmp_path: Path, stamped: str) -> None:
    script = walking(False, odometry=None)
    for k in range(1, 6):
        now_ns = ZERO_NS + k * S
        each = {"now": [now_ns] * (k + 1), "never": [0] * (k + 1), "each": [ZERO_NS + j * S for j in range(k + 1)]}
        script.path("/path", each[stamped], now_ns)
    frames = Recording.open(convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")).frames
    first = 0 if stamped == "each" else 1
    assert [frame.T_odom_body[0, 3] for frame in frames] == pytest.approx([k + 0.2 for k in range(first, 5)])


@pytest.mark.parametrize(("topic", "fixed"), [("/goal_pose", "map"), ("/plan", "map"), ("/marker/pose", "camera")])
def test_poses_of_goals_and_of_what_is_seen_are_no_odometry(tmp_path: Path, topic: str, fixed: str) -> None:
    script = walking(False, odometry=None)
    script.fixed = fixed
    for k in range(11):
        script.transform("/tf", ZERO_NS + k * S // 2, ("odom", "body"), (0.5 * k, 0.0, 0.0))
        script.pose_stamped(topic, ZERO_NS + k * S // 2, 50.0)
    frames = Recording.open(convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")).frames
    assert [frame.T_odom_body[0, 3] for frame in frames] == pytest.approx([k + 0.2 for k in range(5)])


@pytest.mark.parametrize(
    ("ways", "said"),
    [((0.0, 0.0), "nothing moves"), ((1.0, 3.0), "rotations never change though the path turns"), ((1.0, 1.0), "")],
)
def test_odometry_that_says_nothing_of_rotations_or_motion_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, ways: tuple[float, float], said: str
) -> None:
    script = walking(False, odometry=None)
    for k in range(11):
        along, across = (min(k, 5) * ways[0], max(k - 5, 0) * (ways[1] - ways[0]))
        script.transform("/tf", ZERO_NS + k * S // 2, ("odom", "camera"), (along + max(k - 5, 0) * ways[0], across, 0))
    convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")
    told = [word for word in ("nothing moves", "rotations never change though the path turns") if word in caplog.text]
    assert told == ([said] if said else [])


@pytest.mark.parametrize("other", ["/odometry/gps", "/vicon/odom", "/amcl_pose"])
def test_what_says_where_a_robot_is_does_not_stand_before_its_odometry(tmp_path: Path, other: str) -> None:
    for source in ("tf", "/pose"):
        script = walking(False, odometry=None)
        for k in range(11):
            stamp_ns = ZERO_NS + k * S // 2
            (script.pose_stamped if other == "/amcl_pose" else script.odometry)(other, stamp_ns, 500.0)
            script.transform("/tf", stamp_ns, ("body", "camera"), (0.1, 0.0, 0.0))
            script.transform("/tf", stamp_ns, ("odom", "body"), (0.5 * k, 0.0, 0.0))
            if source != "tf":
                script.pose_stamped(source, stamp_ns, 0.5 * k)
        bag = script.write(tmp_path / source.strip("/"), "mcap")
        recording = Recording.open(convert(bag, tmp_path / f"out{source.strip('/')}"))
        assert [frame.T_odom_body[0, 3] for frame in recording.frames] == pytest.approx([k + 0.2 for k in range(5)])
        assert recording.T_body_camera[0, 3] == pytest.approx(0.1)


def test_a_robot_with_two_odometries_is_not_left_out_of_its_team(tmp_path: Path) -> None:
    script = team()
    for k in range(4):
        script.odometry("/Alpha/vio/odom", ZERO_NS + k * S, 0.0)
        script.pose_stamped("/bob_2/amcl_pose", ZERO_NS + k * S, 70.0)
    script.messages.sort(key=lambda message: message[2])
    with pytest.raises(DatasetError, match=r"has 2 odometry topics, name one with .* /Alpha/vio/odom"):
        convert(script.write(tmp_path / "team", "mcap"), tmp_path / "out")
    script.messages = [message for message in script.messages if "/vio/" not in message[0]]
    convert(script.write(tmp_path / "other", "mcap"), tmp_path / "found")
    assert Recording.open(tmp_path / "found" / "bob_2").frames[0].T_odom_body[0, 3] == 10.0


@pytest.mark.parametrize(
    ("frame", "topic", "edge", "said"),
    [
        ("", "/tf_static", ("body", "lidar"), "leads from body, which /odom moves, to none"),
        ("camera", "/tf_static", ("camera", "body"), "the camera (camera) sits on body, but /pose does not say"),
        ("camera", "/tf", ("body", "camera"), "the camera (camera) sits on body, but /pose does not say"),
    ],
)
def test_a_bag_that_places_cameras_but_not_this_one_is_refused(
    tmp_path: Path, frame: str, topic: str, edge: tuple[str, str], said: str
) -> None:
    script = robot_of(BagScript(False), "/cam/image_raw", "/odom" if not frame else None, 0.0, (frame, "body"))
    for k in range(4 if frame else 0):
        script.pose_stamped("/pose", ZERO_NS + k * S, float(k))
    script.transform(topic, ZERO_NS, edge)
    with pytest.raises(DatasetError, match=re.escape(said)):
        convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")


def test_odometry_that_is_ground_truth_by_its_name_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = walking(False, odometry="/vicon/odom").write(tmp_path / "run", "mcap")
    convert(bag, tmp_path / "out")
    assert "odometry is /vicon/odom, by its name no odometry, but ground truth or GPS" in caplog.text


@pytest.mark.parametrize("moves", [False, True])
def test_robots_with_transforms_of_their_own_may_have_the_same_frames(tmp_path: Path, moves: bool) -> None:
    script = BagScript(False)
    for number, name in enumerate(("r1", "r2")):
        odometry = None if moves else f"/{name}/odom"
        robot_of(script, f"/{name}/cam/image_raw", odometry, float(number), ("camera", "body"))
        script.transform(f"/{name}/tf_static", ZERO_NS, ("body", "camera"), (0.1 + number, 0.0, 0.0))
        for k in range(9 if moves else 0):
            script.transform(f"/{name}/tf", ZERO_NS + k * S // 2, ("odom", "body"), (number + 0.5 * k, 0.0, 0.0))
    script.messages.sort(key=lambda message: message[2])
    convert(script.write(tmp_path / "team", "mcap"), tmp_path / "out")
    found = [Recording.open(tmp_path / "out" / name) for name in ("r1", "r2")]
    assert [recording.T_body_camera[0, 3] for recording in found] == pytest.approx([0.1, 1.1])
    assert [recording.frames[0].T_odom_body[0, 3] for recording in found] == [0.0, 1.0]


def test_one_robot_without_intrinsics_costs_no_other(tmp_path: Path) -> None:
    script = team()
    script.messages = [message for message in script.messages if message[0] != "/bob_2/cam/camera_info"]
    with pytest.raises(DatasetError, match="intrinsics are missing or unclear"):
        convert(script.write(tmp_path / "team", "mcap"), tmp_path / "out")
    assert len(Recording.open(tmp_path / "out" / "alpha").frames) == 4


def test_images_of_another_frame_and_repeated_ones_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    script = walking(False, count=12)
    script.frame = "other"
    script.compressed("/cam/image/compressed", ZERO_NS + S // 2)
    script.frame = "camera"
    repeated = [(name, kind, ns + 1000, message) for name, kind, ns, message in script.messages if "image" in name]
    script.messages = sorted([*script.messages, *repeated[:-1]], key=lambda message: message[2])
    bag = script.write(tmp_path / "run", "mcap")
    assert len(Recording.open(convert(bag, tmp_path / "out")).frames) == 12
    assert "12 of 25 messages repeat a stamp" in caplog.text
    assert "1 of 25 messages were left out: an image is of the frame other, the first one of camera" in caplog.text


def test_topics_without_messages_are_not_chosen_from(tmp_path: Path) -> None:
    script = walking(False)
    path = tmp_path / "run"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/rear/image_raw", "sensor_msgs/msg/Image", typestore=script.store)
        writer.add_connection("/wheels/odom", "nav_msgs/msg/Odometry", typestore=script.store)
        connections = {
            (name, kind): writer.add_connection(name, kind, typestore=script.store)
            for name, kind in dict.fromkeys(message[:2] for message in script.messages)
        }
        for name, kind, stamp_ns, message in script.messages:
            raw = bytes(script.store.serialize_cdr(message, kind))
            writer.write(connections[name, kind], stamp_ns, raw)
    assert len(Recording.open(convert(path, tmp_path / "out")).frames) == 5


@pytest.mark.parametrize("storage", ["bag", "db3"])
def test_images_that_come_late_go_where_they_belong(tmp_path: Path, storage: str) -> None:
    script = walking(storage == "bag", count=12)
    at = [k for k, message in enumerate(script.messages) if "image" in message[0]]
    for one, other in ((3, 4), (7, 9)):
        (*_, first), (*_, second) = script.messages[at[one]], script.messages[at[other]]
        script.messages[at[one]] = (*script.messages[at[one]][:3], second)
        script.messages[at[other]] = (*script.messages[at[other]][:3], first)
    bag = script.write(tmp_path / ("run.bag" if storage == "bag" else "run"), storage)
    recording = Recording.open(convert(bag, tmp_path / "out"))
    assert [frame.T_odom_body[0, 3] for frame in recording.frames] == pytest.approx([k + 0.2 for k in range(12)])
    pictures = [cv2.imread(str(frame.image_path), cv2.IMREAD_GRAYSCALE) for frame in recording.frames]
    greys = [picture[0, 0] for picture in pictures if picture is not None]
    assert greys == pytest.approx([10 * k for k in range(12)], abs=2)


def test_a_clock_that_was_set_back_fills_no_gaps() -> None:
    gaps = StampGaps()
    forward = [gaps.fits(k * 100) for k in range(50)]
    back = [gaps.fits(4000 + phase + k * 100) for phase in (30, 50) for k in range(9)]
    assert all(forward)
    assert not any(back)
    assert gaps.fits(5000)


def test_a_message_that_was_kept_back_does_not_choose_the_clock(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    script = walking(False)
    first = next(k for k, message in enumerate(script.messages) if message[0] == "/odom")
    stale = BagScript(False)
    stale.odometry("/odom", ZERO_NS - 20 * S, -1.0)
    script.messages[first] = (*script.messages[first][:3], stale.messages[0][3])
    assert len(Recording.open(convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")).frames) == 4
    assert "stamped by clocks" not in caplog.text


def test_the_left_camera_of_two_is_taken(tmp_path: Path) -> None:
    script = walking(False, image="/left/image/compressed")
    script.camera_info("/left/camera_info", ZERO_NS)
    script.compressed("/right/image/compressed", ZERO_NS)
    convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")
    assert "/left/image/compressed" in (tmp_path / "out" / "source.txt").read_text()


def test_intrinsics_of_another_frame_are_refused(tmp_path: Path) -> None:
    script = walking(False)
    script.messages = [message for message in script.messages if message[0] != "/cam/camera_info"]
    script.frame = "other_camera"
    script.camera_info("/cam/camera_info", ZERO_NS)
    with pytest.raises(DatasetError, match="camera_info is of frame other_camera, but /cam/image/compressed of camera"):
        convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")


@pytest.mark.parametrize(
    ("image_ns", "odometry_ns", "note"),
    [
        (lambda ns: ns - ZERO_NS + 512 * S, lambda ns: ns, "are stamped by clocks -1599999488.000 s apart"),
        (lambda ns: 0, lambda ns: 0, "stamps of /cam/image/compressed, /odom are zero"),
        (lambda ns: ns, lambda ns: 0, "stamps of /odom are zero"),
    ],
)
def test_two_clocks_are_brought_together_by_the_recorders(  # type: ignore[no-untyped-def]
    tmp_path: Path, image_ns, odometry_ns, note: str, caplog: pytest.LogCaptureFixture
) -> None:
    script = walking(False)
    for topic, _, stamp_ns, message in script.messages:
        changed = odometry_ns(stamp_ns) if topic == "/odom" else image_ns(stamp_ns)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(changed, S)
    frames = Recording.open(convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")).frames
    assert [frame.T_odom_body[0, 3] for frame in frames] == pytest.approx([k + 0.2 for k in range(5)])
    assert note in caplog.text


def test_odometry_that_begins_anew_is_another_recording(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = BagScript(False)
    script.camera_info("/cam/camera_info", ZERO_NS)
    for k in range(40):
        script.odometry("/odom", ZERO_NS + k * S // 10, 0.2 * (k if k < 20 else k - 20))
        script.compressed("/cam/image/compressed", ZERO_NS + k * S // 10)
    convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")
    first, second = (Recording.open(tmp_path / name) for name in ("out", "out-2"))
    assert [frame.T_odom_body[0, 3] for frame in first.frames[-2:]] == pytest.approx([3.6, 3.8])
    assert [frame.T_odom_body[0, 3] for frame in second.frames[:2]] == pytest.approx([0.2, 0.4], abs=0.21)
    assert len(first.frames) + len(second.frames) >= 38
    assert "odometry begins anew at 1600000002.000 s" in caplog.text


def test_a_single_pose_that_jumps_is_left_out() -> None:
    watch = JourneyWatch()
    xs_m = [0.0, 0.1, 0.2, 9.0, 0.4, 0.5]
    taken = [out for k, x in enumerate(xs_m) for out in watch.take(k * S // 20, (x, 0, 0, 0, 0, 0, 1))]
    assert [numbers[0] for _, _, numbers in taken] == [0.0, 0.1, 0.2, 0.4, 0.5]
    assert (watch.outliers, any(is_new for is_new, _, _ in taken)) == (1, False)


def test_a_robot_that_drives_home_stays_on_its_journey() -> None:
    watch = JourneyWatch()
    xs_m = [0.0, 1.0, 2.0, 1.0, 0.0, 1.0]
    taken = [out for k, x in enumerate(xs_m) for out in watch.take(k * S, (x, 0, 0, 0, 0, 0, 1))]
    assert [(is_new, numbers[0]) for is_new, _, numbers in taken] == [(False, x) for x in xs_m]


def write_parts(folder: Path, times: list[range]) -> Path:
    folder.mkdir()
    for number, seconds in enumerate(times):
        script = BagScript(True)
        script.camera_info("/cam/camera_info", ZERO_NS + seconds[0] * S)
        for k in seconds:
            script.odometry("/odom", ZERO_NS + k * S, float(k))
            script.compressed("/cam/image/compressed", ZERO_NS + k * S)
        script.write(folder / f"drive_{number}.bag")
    return folder


def test_parts_of_a_ros1_recording_are_one_robot(tmp_path: Path) -> None:
    folder = write_parts(tmp_path / "robot", [range(0, 3), range(3, 6), range(6, 9)])
    assert info(folder).images == 9
    assert len(Recording.open(convert(folder, tmp_path / "out")).frames) == 9
    assert read_scenario(str(folder), {}).dataset is not None


def test_bags_of_the_same_time_are_a_robot_each(tmp_path: Path) -> None:
    folder = write_parts(tmp_path / "team", [range(0, 6), range(1, 6)])
    assert read_scenario(str(folder), {}).names() == ["drive_0", "drive_1"]
    assert [found.images for found in infos(folder)] == [6, 5]


@pytest.mark.parametrize("topic", ["/odom", "/cam/image/compressed"])
def test_one_stamp_in_the_future_costs_itself(tmp_path: Path, topic: str, caplog: pytest.LogCaptureFixture) -> None:
    script = walking(False, 20)
    [message for name, _, _, message in script.messages if name == topic][5].header.stamp.sec = 2**31 - 1
    recording = Recording.open(convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out"))
    assert len(recording.frames) == (20 if topic == "/odom" else 19)
    assert f"{topic}: 1 of {40 if topic == '/odom' else 20} messages were left out: the stamp is zero" in caplog.text


def test_a_robot_without_odometry_is_left_out_of_a_team(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = team()
    for k in range(4):
        script.compressed("/carol/cam/image/compressed", ZERO_NS + k * S)
    convert(script.write(tmp_path / "team", "mcap"), tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["alpha", "bob_2"]
    assert "carol has images but no odometry of its own, and is left out" in caplog.text


def test_other_topics_of_poses_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = walking(False)
    script.pose_stamped("/vio/pose", ZERO_NS + S, 1.0)
    convert(script.write(tmp_path / "run", "mcap"), tmp_path / "out")
    assert "odometry is /odom; not taken: /vio/pose (--odometry-topic)" in caplog.text


@pytest.mark.parametrize("spoil", ["empty storage", "no storage", "broken metadata"])
def test_a_broken_ros_2_folder_is_one_sentence(tmp_path: Path, spoil: str) -> None:
    bag = walking(False).write(tmp_path / "run", "db3")
    if spoil == "broken metadata":
        (bag / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: [\n")
    elif spoil == "no storage":
        next(bag.glob("*.db3")).unlink()
    else:
        next(bag.glob("*.db3")).write_bytes(b"")
    with pytest.raises(DatasetError, match=r"run: (cannot be opened|is damaged or cut off): ") as caught:
        convert(bag, tmp_path / "out")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("turns", [False, True])
def test_a_mounting_that_is_repeated_on_tf_is_taken_unless_it_moves(tmp_path: Path, turns: bool) -> None:
    script = walking(True)
    for k in range(5):
        script.transform("/tf", ZERO_NS + k * S, ("/body", "housing"), (0.2, 0.0, 0.1 * k if turns else 0.3))
        script.transform("/tf", ZERO_NS + k * S, ("housing", "camera"), q_xyzw=FORWARD)
    script.messages.sort(key=lambda message: message[2])
    bag = script.write(tmp_path / "run.bag")
    if turns:
        with pytest.raises(DatasetError, match=r"the camera \(camera\) moves on the body \(body\), as /tf says"):
            convert(bag, tmp_path / "out")
        return
    T = Recording.open(convert(bag, tmp_path / "out")).T_body_camera
    expected = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]])
    np.testing.assert_allclose(T, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("image", "focal_px"),
    [("/cam/image_rect/compressed", 28.0), ("/cam/rect/image", 28.0), ("/cam/direct/image_raw", 30.0)],
)
def test_of_rectified_images_the_projection_counts(tmp_path: Path, image: str, focal_px: float) -> None:
    script = walking(False, image=image)
    for topic, _, _, message in script.messages:
        if topic == "/cam/camera_info":
            message.p[[0, 5, 2, 6]] = 28.0, 28.0, 16.0, 12.0
    camera = Recording.open(convert(script.write(tmp_path / "run", "db3"), tmp_path / "out")).camera
    assert camera.fx == pytest.approx(focal_px)
