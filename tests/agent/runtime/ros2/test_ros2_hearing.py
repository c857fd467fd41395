"""What is said of clocks that differ, offers that do not fit, and what has not come."""

import pytest
from tests.agent.runtime.ros2 import cdr_by_hand
from tests.agent.runtime.ros2.cdr_by_hand import Stamped

from flocc_agent.config import Ros2Config
from flocc_agent.runtime.facts import RosProblem
from flocc_agent.runtime.ros2.hearing import Hearing
from flocc_agent.runtime.ros2.problems import Problems
from flocc_agent.runtime.ros2.satellite import SatelliteFixes
from flocc_agent.runtime.ros2.topics import Offer, Qos, Topic
from flocc_agent.runtime.ros2.types import ODOMETRY, MessageTypes

TYPES = MessageTypes()
HASH = TYPES.hash(ODOMETRY)


class Heard:
    """A robot's hearing and what it said."""

    def __init__(self) -> None:
        self.said: list[str] = []
        problems = Problems(self._report)
        self.hearing = Hearing(Ros2Config(), TYPES, problems, SatelliteFixes(lambda *_: None), lambda _: None)
        self.hearing.subscribed["odometry"] = Topic("/odom", ODOMETRY, HASH, Qos(200))

    def _report(self, fact: RosProblem) -> None:
        self.said.append(fact.sentence)

    def odometry(self, stamp_s: int) -> None:
        sample = Stamped((stamp_s, 0), "odom", "base_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        assert self.hearing.take("odometry", cdr_by_hand.odometry(sample))


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
