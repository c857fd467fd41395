"""What must come true in distributed mode, where no leader owes anything: chosen, solved, and agreed in one frame."""

from collections.abc import Iterator

from flocc_agent.core.distributed_optimisation import DistributedOptimisation
from flocc_agent.core.pose_graph import groups_of
from flocc_launch.simulation.invariants import core, groups
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.ids import LogId

AGREED = 0.05
"""How far two robots may have a pose that both have, in metres or entries of a rotation."""


def part_of(station: Station) -> DistributedOptimisation:
    """A running station's part."""
    part = core(station).distributed
    assert part is not None, f"{station.name} is not in distributed mode"
    return part


def partners(group: list[Station]) -> dict[LogId, set[LogId]]:
    """Who agrees with whom, of robots that hear each other."""
    told = {station.log: part_of(station).shares_with() for station in group}
    return {log: {other for other in others if log in told.get(other, ())} for log, others in told.items()}


def uncorrected(swarm: Swarm) -> Iterator[str]:
    """No starvation: robots with keyframes that have not corrected themselves, or not all of them."""
    for group in groups(swarm):
        for station in group:
            applied, held = core(station).corrections.applied, core(station).gossip.logs[station.log].keyframes
            if held and (applied is None or applied.term.leader != station.log):
                yield f"{station.name} has not corrected itself"
            if part_of(station).solved < held:
                yield f"{station.name} has {part_of(station).solved} of its {held} keyframes in its part"
            if not part_of(station).has_chosen:
                yield f"{station.name} has closures of which it has chosen nothing"


def in_other_frames(swarm: Swarm) -> Iterator[str]:
    """One frame: robots that agree with each other, directly or over others, in frames of several names."""
    for group in groups(swarm):
        agreeing = partners(group)
        links = [(log, other) for log, others in agreeing.items() for other in others]
        applied = {station.log: core(station).corrections.applied for station in group}
        for logs in groups_of(sorted(agreeing), links):
            frames = sorted({str(each.anchor) for log in logs if (each := applied[log]) is not None})
            if len(frames) > 1:
                yield f"{' '.join(map(str, logs))} agree, in the frames of {' '.join(frames)}"


def apart(swarm: Swarm) -> Iterator[str]:
    """Agreement: robots whose neighbours, all of them here, have the shared poses elsewhere than they."""
    for group in groups(swarm):
        agreeing = partners(group)
        for station in group:
            part = part_of(station)
            if set(part.shares_with()) == agreeing[station.log] and part.gap > AGREED:
                yield f"{station.name} is {part.gap:.3f} from where its neighbours have what both have"
