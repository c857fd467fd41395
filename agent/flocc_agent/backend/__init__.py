"""From a pose graph to optimised poses and scales. GTSAM lives here only.

`optimiser.optimise` is the entry point; everything else is a step of it. Knows the core's pose-graph types and the
configuration; must not know images, messages or clocks of others.
"""

from collections.abc import Callable
from functools import partial

from flocc_agent.config import BackendConfig
from flocc_agent.core.own_part import ConsensusProblem, ConsensusStep
from flocc_agent.core.pose_graph import GraphSolution, OptimisationFailed, PoseGraph

Optimiser = Callable[[PoseGraph, GraphSolution | None], GraphSolution | OptimisationFailed]
ConsensusStepper = Callable[[ConsensusProblem], ConsensusStep | OptimisationFailed]


def build_optimiser(config: BackendConfig) -> Optimiser:
    """Make the pose-graph optimiser; it can be sent to a worker process."""
    return partial(optimise_graph, config)


def build_stepper(config: BackendConfig) -> ConsensusStepper:
    """Make what does a step of a robot's part in distributed mode; it can be sent to a worker process."""
    return partial(step_own_part, config)


def optimise_graph(
    config: BackendConfig, graph: PoseGraph, initial: GraphSolution | None
) -> GraphSolution | OptimisationFailed:
    """Optimise in whatever process this is called in; only that process pays for loading GTSAM."""
    from flocc_agent.backend.optimiser import optimise

    return optimise(graph, config, initial)


def step_own_part(config: BackendConfig, problem: ConsensusProblem) -> ConsensusStep | OptimisationFailed:
    """Do one step of a robot's part (distributed optimisation), in whatever process this is called in."""
    from flocc_agent.backend.consensus_step import consensus_step

    return consensus_step(config, problem)
