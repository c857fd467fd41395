"""What is said of clocks that differ, offers that do not fit, and what has not come."""

import pytest
from tests.agent.runtime.ros2 import cdr_by_hand
from tests.agent.runtime.ros2.cdr_by_hand import Stamped

from flocc_agent.config import KeyframeConfig, Ros2Config
from flocc_agent.runtime.facts import RosProblem
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.ros2.hearing import Hearing
from flocc_agent.runtime.ros2.problems import Problems
from flocc_agent.runtime.ros2.satellite import SatelliteFixes
from flocc_agent.runtime.ros2.topics import Offer, Qos, Topic
from flocc_agent.runtime.ros2.types import ODOMETRY, MessageTypes

TYPES = MessageTypes()
HASH = TYPES.hash(ODOMETRY)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class Heard:
    """A robot's hearing and what it said."""

    def __init__(self) -> None:
        self.said: list[str] = []
        problems = Problems(self._report)
        self.hearing = Hearing(Ros2Config(), TYPES, problems, SatelliteFixes(lambda *_: None), lambda _: None)
        self.hearing.subscribed["odometry"] = Topic("/odom", ODOMETRY, HASH, Qos(200))

    def _report(self, fact: RosProblem) -> None:
        self.said.append(fact.sentence)

    def odometry(self, stamp_s: int, x_m: float = 0.0) -> None:
        sample = Stamped((stamp_s, 0), "odom", "base_link", (x_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        assert self.hearing.take("odometry", cdr_by_hand.odometry(sample))

    def image(self, stamp_s: int, frame: str) -> None:
        self.hearing.take("image", cdr_by_hand.image((stamp_s, 0), frame, (2, 4), "mono8", bytes(8), 4))

    def static(self, *frames: tuple[str, tuple[float, ...]]) -> None:
        """Children of base_link with their quaternions, in one message."""
        samples = [Stamped((0, 0), "base_link", child, (1.0, 0.0, 0.0), q) for child, q in frames]
        self.hearing.take("tf_static", cdr_by_hand.transforms(samples))


@pytest.mark.parametrize(
    ("stamp_s", "now_s", "said"),
    [
        (100, 105.0, []),
        (100, 200.0, ["more than 10 s behind"]),
        (300, 200.0, ["more than 10 s ahead of"]),
        (100, 0.0, ["use_sim_time is set, but no /clock has come"]),
    ],
)
def test_clocks_that_differ_are_said_once(stamp_s: int, now_s: float, said: list[str]) -> None:
    heard = Heard()
    for k in range(3):
        heard.odometry(stamp_s + k)
        heard.hearing.compare_clocks(round(now_s * 1e9))
    assert len(heard.said) == len(said)
    assert all(words in sentence for words, sentence in zip(said, heard.said, strict=True))


def test_odometry_that_no_longer_comes_is_not_compared_with_the_clock() -> None:
    heard = Heard()
    heard.odometry(100)
    heard.hearing.compare_clocks(105 * 10**9)
    heard.hearing.compare_clocks(10**9)
    heard.hearing.compare_clocks(2 * 10**9)
    assert heard.said == []


def test_a_clock_that_begins_anew_is_apart_for_a_moment() -> None:
    heard = Heard()
    for stamp_s, now_s in ((100, 101), (102, 1), (103, 103), (104, 1), (105, 106)):
        heard.odometry(stamp_s)
        heard.hearing.compare_clocks(now_s * 10**9)
    assert heard.said == []


def test_a_bad_static_transform_does_not_take_the_others_with_it() -> None:
    heard = Heard()
    heard.static(("wheel", (0.0,) * 4), ("cam", UPRIGHT))
    assert heard.hearing.mounting("cam") is not None
    assert heard.said == [
        "ROS 2: /tf_static: base_link to wheel: position (1, 0, 0) with a quaternion of length 0 is no pose"
    ]


@pytest.mark.parametrize(("frame", "is_taken"), [("camera_link", False), ("camera_link_optical", True), ("cam", True)])
def test_images_of_a_links_frame_have_no_mounting_but_a_configured_one(frame: str, is_taken: bool) -> None:
    heard = Heard()
    heard.static((frame, UPRIGHT))
    assert (heard.hearing.mounting(frame) is not None) == is_taken


def test_images_of_another_camera_do_not_get_the_mounting_of_the_first() -> None:
    heard = Heard()
    heard.static(("left", UPRIGHT), ("right", UPRIGHT))
    K = (4.0, 0.0, 2.0, 0.0, 4.0, 1.0, 0.0, 0.0, 1.0)
    heard.hearing.take("camera_info", cdr_by_hand.camera_info((1, 0), "left", (2, 4), K, [], [0.0] * 12))
    for k, frame in enumerate(("left", "right", "/left")):
        heard.image(1 + k, frame)
    for stamp_s in (0, 1, 2, 3, 4):
        heard.odometry(stamp_s, float(stamp_s))
    selector = KeyframeSelector(KeyframeConfig(distance_m=0.5))
    taken = iter(lambda: heard.hearing.next_wanted(selector), None)
    assert [posed.stamp_ns // 10**9 for posed in taken] == [1, 3]
    assert heard.hearing.synchroniser.dropped == {"image of another camera": 1}
    heard.image(5, "right")
    assert heard.said == ["ROS 2: images are in frame 'right', but the mounting that was read is of 'left'"]


def test_intrinsics_of_another_camera_on_the_topic_do_not_replace_the_first() -> None:
    heard = Heard()
    for frame, focal in (("left", 4.0), ("right", 5.0), ("left", 4.0)):
        K = (focal, 0.0, 2.0, 0.0, focal, 1.0, 0.0, 0.0, 1.0)
        heard.hearing.take("camera_info", cdr_by_hand.camera_info((1, 0), frame, (2, 4), K, [], [0.0] * 12))
        assert heard.hearing.eye is not None
        assert heard.hearing.eye.model.fx == 4.0
    assert heard.said == ["ROS 2: intrinsics are of frame 'right', but those before were of 'left'"]


def test_stamps_that_nobody_filled_in_are_not_called_backwards() -> None:
    heard = Heard()
    for _ in range(2):
        heard.image(0, "left")
    assert heard.said == [
        "ROS 2: the stamps are 0, so nothing can be dated by them; the driver must fill in header.stamp"
    ]


@pytest.mark.parametrize(
    ("offer", "said"),
    [
        (Offer("/driver", "/odom", ODOMETRY, HASH), []),
        (Offer("/driver", "/elsewhere", "x/msg/Y", ""), []),
        (
            Offer("/driver", "/odom", ODOMETRY, HASH, "offers it as best_effort"),
            ["/odom: /driver offers it as best_effort: --ros-args -p qos_overrides (docs/ros2.md)"],
        ),
        (
            Offer("/driver", "/odom", "nav_msgs/msg/Path", HASH),
            ["/odom: /driver publishes it as nav_msgs/msg/Path, but nav_msgs/msg/Odometry is needed"],
        ),
    ],
)
def test_an_offer_that_does_not_fit_is_said(offer: Offer, said: list[str]) -> None:
    heard = Heard()
    heard.hearing.compare(offer)
    heard.hearing.compare(offer)
    assert heard.said == said
