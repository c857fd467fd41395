"""Faults of whoever leads: the robot is known only when the fault happens."""

from collections import Counter
from collections.abc import Iterable, Sequence

from flocc_launch.scenarios.scenario import Fault
from flocc_protocol.errors import FloccError


class FaultError(FloccError):
    """A fault that cannot happen when its time has come."""


def placed_fault(fault: Fault, robots: Sequence[str], followed: Iterable[str | None]) -> Fault:
    """The fault with the name of the robot that leads now, where it names none.

    Args:
        fault: What is to happen.
        robots: All names of the scenario.
        followed: The leader of each running robot, None where it follows nobody.

    Raises:
        FaultError: It concerns the leader, and nobody leads.
    """
    if not fault.names_leader(robots):
        return fault
    votes = Counter(leader for leader in followed if leader is not None)
    if not votes:
        raise FaultError(f"a fault '{fault.kind.value}' at {fault.at_s:g} s concerns the leader, but nobody leads then")
    return fault.with_leader(min(votes, key=lambda name: (-votes[name], name)))
