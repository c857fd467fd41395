"""Liveness: what must come true within a while after faults have stopped, in every connected component."""

from collections.abc import Iterator

from flocc_agent.core.pose_graph import components_of, map_frame
from flocc_agent.runtime.reporting import counted
from flocc_launch.simulation.invariants import core, groups, names
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import ClosureRecord


def without_one_leader(swarm: Swarm) -> Iterator[str]:
    """Agreement: components without a leader, with two, or with more than one term."""
    for group in groups(swarm):
        leading = [station.name for station in group if core(station).election.leading]
        terms = {core(station).election.term for station in group}
        if len(leading) != 1 or len(terms) != 1:
            yield f"{names(group)}: {leading} lead, terms {sorted(map(str, terms))}"


def uncorrected(swarm: Swarm) -> Iterator[str]:
    """No starvation: robots with keyframes that the present leader has not corrected."""
    for group in groups(swarm):
        terms = {core(station).election.term for station in group if core(station).election.leading}
        for station in group:
            applied = core(station).corrections.applied
            has_keyframes = core(station).gossip.logs[station.log].keyframes > 0
            if has_keyframes and (applied is None or applied.term not in terms):
                got = "nothing" if applied is None else f"{applied.term}"
                yield f"{station.name} has {got} of {sorted(map(str, terms))}"


def unregistered(swarm: Swarm) -> Iterator[str]:
    """Once: pairs that nobody registered, or rejected, though both owners are here, and one has an odometry pair.

    An owner that lost its disk counts as here: it is asked, directly or by relays, and says that a latent is lost.
    """
    for group in groups(swarm):
        for station in group:
            here = {other.log.robot for other in group}
            logs = core(station).gossip.logs
            for pair in core(station).closing.open_pairs():
                ends = (pair.low.log, pair.high.log)
                reachable = all(log.robot in here for log in ends)
                if reachable and any(logs[log].keyframes > 1 for log in ends if log in logs):
                    yield f"{station.name} still has {pair.low} {pair.high}"


def in_other_frames(swarm: Swarm) -> Iterator[str]:
    """One frame: robots whose map frame is not that of their part of the pose graph, as their leader holds it.

    Where a rolled-back disk made two versions of a log, others may hold the one without the closures that join parts.
    """
    for group in groups(swarm):
        leader = next((station for station in group if core(station).election.leading), group[0])
        graph = core(leader).assembly.graph()
        parts = components_of(list(graph.trajectories), graph.closures)
        frames = {log: map_frame(logs[0]) for logs in parts for log in logs}
        for station in group:
            applied = core(station).corrections.applied
            if applied is not None and map_frame(applied.anchor) != frames.get(station.log):
                yield f"{station.name} is in {map_frame(applied.anchor)}, not in {frames.get(station.log)}"


def not_everywhere(swarm: Swarm) -> Iterator[str]:
    """Nothing lost: copies of logs that differ, and closures that the leader's graph lacks.

    Of a log that a rolled-back disk made two versions of, everybody keeps the one that he heard first.
    """
    for group in groups(swarm):
        held_by = {station.name: core(station).gossip.digests() for station in group}
        digests = {name: tuple(d for d in held if d.log not in swarm.forked) for name, held in held_by.items()}
        if len(set(digests.values())) > 1:
            counts = {name: [f"{d.log}:{d.count}" for d in held] for name, held in digests.items()}
            yield f"logs differ: {counts}"
        for station in group:
            if core(station).election.leading and core(station).distributed is None:
                yield from _unused_closures(station)


def _unused_closures(leader: Station) -> Iterator[str]:
    """Closures between keyframes in the logs that the last solution of a leader does not know."""
    known = set() if leader.solution is None else {CandidatePair.of(c.query, c.match) for c in leader.solution.closures}
    logs = core(leader).gossip.logs
    keyframes = {log: copy.keyframes for log, copy in logs.items()}
    for record in counted(core(leader)):
        if not isinstance(record, ClosureRecord) or CandidatePair.of(record.query, record.match) in known:
            continue
        if all(end.index < keyframes.get(end.log, 0) for end in (record.query, record.match)):
            yield f"closure {record.query} {record.match} is not in the graph of {leader.name}"
