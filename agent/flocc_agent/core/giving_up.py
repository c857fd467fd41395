"""Which log makes room for another one, where a robot holds as many as it may.

A log may go that nothing refers to: no closure and no measurement is in it or of it, its writer is not in range, and
nothing new of it came for an hour. Whoever fills the places with logs of keyframes alone holds them so long, and the
places of robots that lost their disks many times come free.
"""

from collections import Counter
from collections.abc import Callable, Collection

from flocc_agent.core.gossip import LIVES_MAX
from flocc_protocol.ids import LogId

SILENT_S = 3600.0
LOOK_PERIOD_S = 10.0
"""Least pause between two looks: who asks for room again and again must not cost more than one."""


def expendable(
    held: Collection[LogId], wanting: LogId, may_go: Callable[[LogId], bool], silent_s: Callable[[LogId], float]
) -> LogId | None:
    """The log that makes room for one that is wanted, None where none may go.

    Args:
        held: All that are held.
        wanting: The one for which there is no room.
        may_go: Whether nothing refers to a log.
        silent_s: For how long nothing new of it came.

    Returns:
        Of those of its own robot, where that has as many as it may, or of all: one of the robot that has most, and of
        these the one that is silent for longest.
    """
    lives = Counter(log.robot for log in held)
    same = lives[wanting.robot] >= LIVES_MAX
    free = [
        log for log in held if (log.robot == wanting.robot or not same) and silent_s(log) >= SILENT_S and may_go(log)
    ]
    return max(free, key=lambda log: (lives[log.robot], silent_s(log), log), default=None)
