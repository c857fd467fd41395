"""By which clock a bag's images and odometry are stamped: their headers', or the recorder's for both.

Headers are better: they say when something was measured. But a camera that counts from its start, beside odometry that
counts from 1970, or stamps that nobody set, can only be brought together by when they were recorded. One of the two is
never mixed with the other.
"""

from dataclasses import dataclass

from flocc_launch.datasets.bag_layout import Layout, RobotTopics

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
    image = layout.head(robot.image)
    poses = layout.head(robot.poses.topic) if robot.poses is not None and robot.poses.edge is None else None
    where = layout.bag.path
    heads = [(robot.image, image), *([(robot.poses.topic, poses)] if robot.poses else [])]
    unset = [topic.name for topic, head in heads if head is not None and head.stamp_ns == 0]
    if unset:
        return ClockChoice(True, f"{where}: stamps of {', '.join(unset)} are zero; the recorder's time is used for all")
    known = image or poses
    offset_ns = known.stamp_ns - known.bag_ns if known is not None else None
    if image is None or poses is None:
        return ClockChoice(False, offset_ns=offset_ns)
    apart_s = ((image.stamp_ns - image.bag_ns) - (poses.stamp_ns - poses.bag_ns)) * 1e-9
    if abs(apart_s) <= APART_MAX_S:
        return ClockChoice(False, offset_ns=offset_ns)
    return ClockChoice(
        True,
        f"{where}: {robot.image.name} and {robot.poses} are stamped by clocks {apart_s:+.3f} s apart; the recorder's "
        "time is used for both",
    )
