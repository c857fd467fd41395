"""`python -m flocc_lab.graph_family.single_false DRAWS [FIRST]`: single false closures, and right ones that are held.

Each seed's member of the family, without its own wrong closures, gets one false closure: anywhere (it bends a chain),
or between keyframes that are near each other, in the opposite direction (its scale collapses). What it does is told by
least squares that trust it: damage is an ATE half as large again and half a metre larger, or a collapsed scale. Then
the member grows in ten rounds, and right closures are counted that are held in more than three of them.
"""

import sys
from dataclasses import dataclass, replace

import numpy as np

from flocc_agent.backend.alarms import held_closures
from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import Solver
from flocc_agent.core.pose_graph import GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import inverse
from flocc_lab.graph_family.family_spec import Lengths, drawn
from flocc_lab.graph_family.graphs import Member, made, stray
from flocc_lab.graph_family.judge import judged
from flocc_lab.graph_family.methods import answer_of, settings

KEYFRAMES_MAX = 400
CLOSURES_LEAST = 6
ROUNDS, ROUNDS_HELD_MAX = 10, 3
WORSE_RATIO, WORSE_M = 1.5, 0.5
APART_LEAST_M, APART_SIGMAS = 3.0, 10.0
"""Nearer to each other keyframes leave a scale no length that could be told from none."""


@dataclass(frozen=True, slots=True)
class SingleFalse:
    """What came of one seed: whether the closure does damage and is held, and right closures, all and held long."""

    kind: str
    damages: bool
    held: bool
    right: int
    held_long: int


def outcome(seed: int) -> SingleFalse | None:
    """One seed; None where the member has too few closures."""
    rng = np.random.default_rng([seed, 16])
    spec = drawn(seed)
    spec = replace(
        spec,
        keyframes=tuple(min(n, KEYFRAMES_MAX) for n in spec.keyframes),
        closures=min(spec.closures, 500),
        outliers=0.0,
        groups=0,
    )
    member = made(spec)
    if len(member.graph.closures) < CLOSURES_LEAST:
        return None
    collapsing = spec.lengths is not Lengths.METRIC and rng.random() < 0.5
    false = reversed_closure(rng, member) if collapsing else stray(rng, member)
    if false is None:
        return None
    with_false = replace(
        member,
        graph=PoseGraph(member.graph.trajectories, [*member.graph.closures, false]),
        is_right=np.append(member.is_right, False),
    )
    held = held_closures(with_false.graph.trajectories, dict(enumerate(with_false.graph.closures)), settings())
    damages = damage(member, with_false, collapsing)
    kind = "collapse" if collapsing else "bend"
    return SingleFalse(kind, damages, len(member.is_right) in held, len(member.is_right), held_long(member))


def reversed_closure(rng: np.random.Generator, member: Member) -> LoopClosure | None:
    """A right closure without a length between keyframes that are apart, moved a keyframe on and reversed."""
    T = member.T_world_keyframe
    apart_m = [
        float(np.linalg.norm(T[c.query.log][c.query.index][:3, 3] - T[c.match.log][c.match.index][:3, 3]))
        for c in member.graph.closures
    ]
    least_m = max(APART_LEAST_M, APART_SIGMAS * member.spec.closure[1] * member.spec.closure_factor)
    free = [c for c, m in zip(member.graph.closures, apart_m, strict=True) if not c.metric and m > least_m]
    if not free:
        return None
    chosen = free[int(rng.integers(len(free)))]
    step = 1 if chosen.query.index + 1 < len(member.graph.trajectories[chosen.query.log]) else -1
    query = chosen.query._replace(index=chosen.query.index + step)
    T_query, T_match = (member.T_world_keyframe[k.log][k.index] for k in (query, chosen.match))
    T_false = inverse(T_query) @ T_match
    length = np.linalg.norm(chosen.T_query_match_unscaled[:3, 3])
    T_false[:3, 3] *= -length / max(float(np.linalg.norm(T_false[:3, 3])), 1e-6)
    return replace(chosen, query=query, T_query_match_unscaled=T_false)


def damage(member: Member, with_false: Member, collapsing: bool) -> bool:
    """Whether least squares that trust the false closure are worse for it."""
    config = settings(solver=Solver.LM)
    before, after = (optimise(m.graph, config) for m in (member, with_false))
    if not isinstance(before, GraphSolution) or not isinstance(after, GraphSolution):
        return False
    if collapsing and any("collapsed" in warning for warning in after.warnings):
        return True
    judge = answer_of(before, 0.0)
    ate_m = [judged(member, "", replace(answer_of(s, 0.0), used=judge.used), judge).ate_m for s in (before, after)]
    return ate_m[1] > max(WORSE_RATIO * ate_m[0], ate_m[0] + WORSE_M)


def held_long(member: Member) -> int:
    """Right closures that are held in more than three of ten rounds, in which all robots' ways grow alike."""
    rounds_held = np.zeros(len(member.graph.closures), dtype=int)
    for share in np.linspace(0.0, 1.0, ROUNDS + 1)[1:]:
        known = {log: max(2, round(share * len(t))) for log, t in member.graph.trajectories.items()}
        ways = {log: beginning(t, known[log]) for log, t in member.graph.trajectories.items()}
        closures = {
            k: c
            for k, c in enumerate(member.graph.closures)
            if c.query.index < known[c.query.log] and c.match.index < known[c.match.log]
        }
        rounds_held[list(held_closures(ways, closures, settings()))] += 1
    return int(np.count_nonzero(rounds_held > ROUNDS_HELD_MAX))


def beginning(trajectory: Trajectory, keyframes: int) -> Trajectory:
    """The first keyframes of a way."""
    assert trajectory.edge_covariances is not None
    return Trajectory(trajectory.T_odom_keyframe[:keyframes], trajectory.edge_covariances[: keyframes - 1])


def main(words: list[str]) -> None:
    """Print what came of each kind of false closure."""
    draws, first = int(words[0]), int(words[1]) if len(words) > 1 else 1
    seeds = range(first, first + draws)
    found = {seed: drawn for seed in seeds if (drawn := outcome(seed)) is not None}
    out = ["| false closure | drawn | do damage | of those held | held of the others |", "|---|---|---|---|---|"]
    for kind in ("bend", "collapse"):
        of_kind = [d for d in found.values() if d.kind == kind]
        harm, harmless = [d for d in of_kind if d.damages], [d for d in of_kind if not d.damages]
        out.append(
            f"| {kind} | {len(of_kind)} | {len(harm)} | {sum(d.held for d in harm)} | {sum(d.held for d in harmless)} |"
        )
    right, long = sum(d.right for d in found.values()), sum(d.held_long for d in found.values())
    missed = [seed for seed, d in found.items() if d.damages and not d.held]
    out.append(f"\nRight closures held in more than {ROUNDS_HELD_MAX} of {ROUNDS} rounds: {long} of {right}.")
    out.append(f"Seeds whose damaging closure was not held: {missed or 'none'}.")
    sys.stdout.write("\n".join(out) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
