"""By which clock a bag's images and odometry are stamped: their headers', or the recorder's for both.

Headers are better: they say when something was measured. But a camera that counts from its start, beside odometry that
counts from 1970, or stamps that nobody set, can only be brought together by when they were recorded. One of the two is
never mixed with the other.
"""

from dataclasses import dataclass
from statistics import median, median_low

from flocc_launch.datasets.bag_layout import Layout, RobotTopics
from flocc_launch.datasets.bag_messages import header_ns
from flocc_launch.datasets.bag_reader import Bag, BagTopic

SAMPLE_MAX = 9

STRAY_MAX_NS = 60 * 10**9
"""A header further off the recorder's time than the first ones is a stamp that went wrong."""
APART_MAX_S = 1.0
"""Headers of one clock are recorded within this of each other; more is another clock, not a delay."""


@dataclass(frozen=True, slots=True)
class ClockChoice:
    """Which clock is taken.

    Attributes:
        is_bag: The recorder's for images and odometry, in place of their headers'.
        note: Why, where it is the recorder's.
        offset_ns: What headers are ahead of the recorder, or None where that is not known.
    """

    is_bag: bool
    note: str | None = None
    offset_ns: int | None = None

    def is_off(self, header_ns: int, bag_ns: int) -> bool:
        """Whether a header's stamp is of another time than the messages before it."""
        return self.offset_ns is not None and abs(header_ns - bag_ns - self.offset_ns) > STRAY_MAX_NS


def choose_clock(layout: Layout, robot: RobotTopics) -> ClockChoice:
    """Take the headers' clock where images and odometry have one and the same, else the recorder's."""
    where = layout.bag.path
    image = _stamps(layout.bag, robot.image)
    moves = robot.poses is not None and robot.poses.edge is None
    poses = _stamps(layout.bag, robot.poses.topic) if robot.poses is not None and moves else []
    unset = [
        topic.name
        for topic, stamps in ((robot.image, image), *([(robot.poses.topic, poses)] if robot.poses else []))
        if stamps and median(stamp_ns for stamp_ns, _ in stamps) == 0
    ]
    if unset:
        return ClockChoice(True, f"{where}: stamps of {', '.join(unset)} are zero; the recorder's time is used for all")
    offset_ns = _offset_ns(image or poses) if image or poses else None
    if not image or not poses:
        return ClockChoice(False, offset_ns=offset_ns)
    apart_s = (_offset_ns(image) - _offset_ns(poses)) * 1e-9
    if abs(apart_s) <= APART_MAX_S:
        return ClockChoice(False, offset_ns=offset_ns)
    return ClockChoice(
        True,
        f"{where}: {robot.image.name} and {robot.poses} are stamped by clocks {apart_s:+.3f} s apart; the recorder's "
        "time is used for both",
    )


def _stamps(bag: Bag, topic: BagTopic) -> list[tuple[int, int]]:
    """Headers' and the recorder's times of a topic's first messages, nanoseconds."""
    return [(header_ns(message), bag_ns) for bag_ns, message in bag.firsts(topic.name, SAMPLE_MAX)]


def _offset_ns(stamps: list[tuple[int, int]]) -> int:
    """What headers are ahead of the recorder; one message that was kept back says little."""
    return median_low(stamp_ns - bag_ns for stamp_ns, bag_ns in stamps)
