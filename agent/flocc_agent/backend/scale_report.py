"""Sentences about scales that the measurements do not fix, or that fell to their bound."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend import rotations
from flocc_agent.backend.alignment import evenly
from flocc_agent.backend.descent import Solved
from flocc_agent.backend.edges import GAMMA_MIN, scales_at
from flocc_agent.backend.problem import Problem
from flocc_agent.backend.solvers import ACCEPTED_WEIGHT_MIN
from flocc_agent.core.pose_graph import LoopClosure, OdometryScale
from flocc_protocol.ids import LogId

NAMED_MAX = 5
COLLAPSED_RATIO = 2.0
TOLD_SIGMAS = 3.0
PARALLEL_RAD = 0.3
"""Directions nearer to each other than this are one direction: a closure's own direction is often no better."""
AXES_MAX = 100
EXCEPTIONS_RATIO = 0.1
"""So many closures with other directions may be wrong ones that nothing contradicts."""


def scale_warnings(problem: Problem, solved: Solved, closures: Mapping[int, LoopClosure]) -> tuple[str, ...]:
    """Name the closures whose scale collapsed to its bound, and the pairs whose scales nothing fixes."""
    rows = problem.closure_rows
    gamma = scales_at(problem.edges, solved.state)[rows]
    free = (problem.edges.sigma[rows] > 0) | (problem.edges.cluster[rows] >= 0)
    used = solved.weights[rows] >= ACCEPTED_WEIGHT_MIN
    collapsed = np.flatnonzero(free & used & (gamma <= COLLAPSED_RATIO * GAMMA_MIN))
    sentences = []
    if len(collapsed):
        sentences.append(f"the scale collapsed to its bound: {_names(collapsed, problem, closures)}")
    lonely = unobservable(problem, free, used)
    if len(lonely):
        sentences.append(f"the scale is not observable and stays at its prior: {_names(lonely, problem, closures)}")
    sentences += [
        f"the distance between robots {a} and {b} is not observable: {parallel} of the {count} closures that join them "
        "have one direction, and only first guesses of their lengths hold it"
        for a, b, parallel, count in parallel_pairs(problem, solved, free, used)
    ]
    return tuple(sentences)


def parallel_pairs(
    problem: Problem, solved: Solved, free: NDArray[np.bool_], used: NDArray[np.bool_]
) -> list[tuple[LogId, LogId, int, int]]:
    """Pairs of logs that only closures without a length join, in one direction, and how many of how many do.

    Moved along that direction, one robot contradicts nothing: only the scales' priors hold it.
    """
    u = directions(problem, solved)
    pairs = log_pairs(problem)
    joined = [tuple(pair) for pair in np.unique(pairs[used], axis=0).tolist()]
    found = []
    for a, b in joined:
        of_pair = used & np.all(pairs == (a, b), axis=1)
        count = int(np.count_nonzero(of_pair))
        if a == b or count == 1 or not np.all(free[of_pair]) or not _is_bridge((a, b), joined):
            continue
        parallel = in_one_direction(u[of_pair])
        if parallel >= count - int(EXCEPTIONS_RATIO * count):
            found.append((problem.logs[a], problem.logs[b], parallel, count))
    return found


def in_one_direction(u: NDArray[np.float64]) -> int:
    """How many of the directions (N, 3) are parallel to the one that most of them have."""
    tried = evenly(np.arange(len(u)), AXES_MAX)
    sines = np.linalg.norm(np.cross(u[tried][:, None], u[None]), axis=2)
    return int(np.max(np.count_nonzero(sines < PARALLEL_RAD, axis=1)))


def directions(problem: Problem, solved: Solved) -> NDArray[np.float64]:
    """Measured direction (L, 3) of each closure's translation, in the map."""
    edges, rows = problem.edges, problem.closure_rows
    R_query = rotations.matrices(solved.state.q[edges.i[rows]])
    t = np.einsum("eij,ej->ei", R_query @ rotations.matrices(edges.q_hat[rows]), edges.d[rows, 3:])
    return np.asarray(t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-12))


def log_pairs(problem: Problem) -> NDArray[np.int64]:
    """Places in `logs` (L, 2) of the two robots of each closure, the lower one first."""
    rows = problem.closure_rows
    starts = np.array([problem.offsets[log] for log in problem.logs])
    i, j = (np.searchsorted(starts, side[rows], side="right") - 1 for side in (problem.edges.i, problem.edges.j))
    return np.sort(np.stack([i, j], axis=1), axis=1)


def odometry_warnings(scales: Mapping[LogId, OdometryScale]) -> tuple[str, ...]:
    """Name the robots whose odometry measures lengths too short or too long."""
    sentences = [
        f"odometry of robot {log} measures lengths {100 * abs(scale.ratio - 1):.1f} % too "
        f"{'long' if scale.ratio > 1 else 'short'} (give or take {100 * scale.sigma_ratio:.1f} %)"
        f"{_against(scale)}; {'its poses are corrected' if scale.is_applied else 'its poses are as measured'}"
        for log, scale in sorted(scales.items())
        if abs(scale.ratio - 1) > TOLD_SIGMAS * scale.sigma_ratio
    ]
    return tuple(sentences)


def _against(scale: OdometryScale) -> str:
    return "" if scale.is_metric else ", compared with the mean of all robots, because nothing was measured in metres"


def unobservable(problem: Problem, free: NDArray[np.bool_], used: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Closures with a free scale that alone hold two groups of logs together: nothing else fixes their length."""
    pairs = log_pairs(problem)
    joined, first, counts = np.unique(pairs[used], axis=0, return_index=True, return_counts=True)
    lonely = [
        int(n)
        for (a, b), n, count in zip(joined.tolist(), np.flatnonzero(used)[first], counts, strict=True)
        if count == 1 and a != b and free[n] and _is_bridge((a, b), joined.tolist())
    ]
    return np.array(sorted(lonely), dtype=np.int64)


def _is_bridge(pair: tuple[int, int], joined: Sequence[Sequence[int]]) -> bool:
    """Whether the two logs of a pair fall apart without it."""
    reached = {pair[0]}
    for _ in joined:
        for a, b in joined:
            if (a, b) != pair and (a in reached or b in reached):
                reached |= {a, b}
    return pair[1] not in reached


def _names(chosen: Sequence[int] | NDArray[np.int64], problem: Problem, closures: Mapping[int, LoopClosure]) -> str:
    pairs = [closures[problem.closure_ids[int(n)]] for n in chosen]
    more = f" and {len(pairs) - NAMED_MAX} more" if len(pairs) > NAMED_MAX else ""
    return ", ".join(f"{c.query} - {c.match}" for c in pairs[:NAMED_MAX]) + more
