"""From a pose graph to optimised poses and scales. GTSAM lives here only.

`optimiser.optimise` is the entry point; everything else is a step of it. Knows the core's pose-graph types and the
configuration; must not know images, messages or clocks of others.
"""

from collections.abc import Callable
from functools import partial

from flocc_agent.config import BackendConfig
from flocc_agent.core.blocks import BlockProblem, BlockStep
from flocc_agent.core.pose_graph import GraphSolution, OptimisationFailed, PoseGraph

Optimiser = Callable[[PoseGraph, GraphSolution | None], GraphSolution | OptimisationFailed]
Iterator = Callable[[BlockProblem], BlockStep | OptimisationFailed]


def build_optimiser(config: BackendConfig) -> Optimiser:
    """Make the pose-graph optimiser; it can be sent to a worker process."""
    return partial(optimise_graph, config)


def build_iterator(config: BackendConfig) -> Iterator:
    """Make what iterates on a robot's block in distributed mode; it can be sent to a worker process."""
    return partial(iterate_own_block, config)


def optimise_graph(
    config: BackendConfig, graph: PoseGraph, initial: GraphSolution | None
) -> GraphSolution | OptimisationFailed:
    """Optimise in whatever process this is called in; only that process pays for loading GTSAM."""
    from flocc_agent.backend.optimiser import optimise

    return optimise(graph, config, initial)


def iterate_own_block(config: BackendConfig, problem: BlockProblem) -> BlockStep | OptimisationFailed:
    """Do one iteration of a robot's block (distributed optimisation), in whatever process this is called in."""
    from flocc_agent.backend.block import iterate_block

    return iterate_block(config, problem)
