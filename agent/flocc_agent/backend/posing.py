"""A component as the solver takes it: arrays, what is minimised, where it starts."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.chains import Chains
from flocc_agent.backend.descent import Objective, Solved
from flocc_agent.backend.edges import State, off_half_turns, state_of
from flocc_agent.backend.initial import Aligned, trusted_closures
from flocc_agent.backend.linear import LinearSolver
from flocc_agent.backend.placing import Places
from flocc_agent.backend.problem import Problem, build
from flocc_agent.backend.solvers import ACCEPTED_WEIGHT_MIN
from flocc_agent.backend.votes import grouped, votes_of
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import GraphSolution, LoopClosure, Trajectory
from flocc_protocol.ids import LogId

ODOMETRY_SCALE_SIGMA = 0.1
"""Prior standard deviation around 1 of a scale of odometry."""


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """A component as the solver takes it.

    Attributes:
        problem: Poses, scales and edges as arrays.
        objective: What is minimised.
        start: Where it starts.
        trusted: Which closures (L,) an earlier solution did not reject; None where the start is not that solution.
        places: Where rejected closures would put robots.
    """

    problem: Problem
    objective: Objective
    start: State
    trusted: NDArray[np.bool_] | None
    places: Places

    def is_confirmed(self, solved: Solved) -> bool:
        """Whether a solution rests on the closures that the one before it trusted."""
        chosen = solved.weights[self.problem.closure_rows] >= ACCEPTED_WEIGHT_MIN
        return self.trusted is not None and np.array_equal(chosen, self.trusted)

    def with_scaled(self, scales: Mapping[LogId, float], divides: bool = False) -> "Posed":
        """The same in which the odometry of these logs, and of no others, has a scale that starts as given."""
        if not scales and not self.problem.scaled:
            return self
        problem, config = self.problem.with_scaled(scales, divides), self.objective.config
        sigmas = np.full(problem.scales, config.scale_prior_unknown_sigma_ratio)
        sigmas[problem.clusters :] = ODOMETRY_SCALE_SIGMA
        started = [*self.start.scale[: problem.clusters].tolist(), *(scales[log] for log in problem.scaled)]
        return replace(
            self,
            problem=problem,
            objective=replace(self.objective, edges=problem.edges, linear=LinearSolver(0, sigmas)),
            start=replace(self.start, scale=np.array(started)),
            places=replace(self.places, problem=problem),
        )


def posed(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    aligned: Aligned,
    config: BackendConfig,
    initial: GraphSolution | None,
    recorded: Mapping[int, LoopClosure] | None = None,
    held: Collection[int] = (),
) -> Posed:
    """The problem of aligned logs and the closures that are left, with all odometry taken as true.

    Where the closures' keyframes are named by their places in chains, `recorded` has them under their own numbers.
    Closures that are `held` count once the poses that others give agree with them.
    """
    problem = build(trajectories, closures, config, recorded).with_lengths(aligned.lengths_m)
    in_order = [(recorded or closures)[k] for k in problem.closure_ids]
    linear = LinearSolver(0, config.scale_prior_unknown_sigma_ratio)
    groups = grouped(trajectories, closures, recorded or closures, config)
    is_held = np.array([k in held for k in problem.closure_ids], dtype=bool)
    aligned_state = state_of(np.concatenate([aligned.T_map_keyframe[log] for log in problem.logs]), problem.clusters)
    return Posed(
        problem,
        Objective(problem.edges, problem.closure_rows, linear, config, is_held),
        off_half_turns(problem.edges, aligned_state),
        trusted_closures(in_order, is_held, initial) if aligned.is_warm and initial is not None else None,
        Places(problem, trajectories, closures, votes_of(groups), groups, config.steepness),
    )


def posed_by_chains(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    chains: Chains | None,
    aligned: Aligned,
    config: BackendConfig,
    initial: GraphSolution | None = None,
    held: Collection[int] = (),
) -> Posed:
    """The same by the component's chains, where its odometry is shortened to these."""
    if chains is None:
        return posed(trajectories, closures, aligned, config, initial, None, held)
    shorter = aligned._replace(T_map_keyframe=chains.shortened(aligned.T_map_keyframe))
    return posed(chains.trajectories, chains.closures, shorter, config, initial, chains.recorded, held)
