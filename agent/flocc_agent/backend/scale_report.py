"""Sentences about scales that the measurements do not fix, or that fell to their bound."""

from collections.abc import Mapping

import numpy as np

from flocc_agent.backend.edges import GAMMA_MIN, scales_at
from flocc_agent.backend.problem import Problem
from flocc_agent.backend.solvers import Solved
from flocc_agent.core.pose_graph import LoopClosure

NAMED_MAX = 5


def scale_warnings(problem: Problem, solved: Solved, closures: Mapping[int, LoopClosure]) -> tuple[str, ...]:
    """Name the closures whose scale collapsed."""
    rows = problem.closure_rows
    gamma = scales_at(problem.edges, solved.state)[rows]
    free = (problem.edges.sigma[rows] > 0) | (problem.edges.cluster[rows] >= 0)
    collapsed = np.flatnonzero(free & (gamma <= 2 * GAMMA_MIN) & (solved.weights[rows] >= 0.5))
    if len(collapsed) == 0:
        return ()
    names = [f"{closures[problem.closure_ids[n]].query} - {closures[problem.closure_ids[n]].match}" for n in collapsed]
    more = f" and {len(names) - NAMED_MAX} more" if len(names) > NAMED_MAX else ""
    return (f"the scale collapsed to its bound: {', '.join(names[:NAMED_MAX])}{more}",)
