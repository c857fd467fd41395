"""`flocc bench solver --keyframes N --closures M`: what one graph of that size costs, whole and by ten closures more.

CPU seconds, because wall time says more of the machine. The default configuration, marginal covariances included; one
robot closes loops with itself.
"""

import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph
from flocc_agent.geometry import angle_rad, between, inverse
from flocc_lab.bench.generated_graph import generate

NEW_CLOSURES = 10


def run(
    robots: int,
    keyframes: int,
    closures: int,
    formulation: Formulation | None = None,
    solver: Solver | None = None,
    seed: int = 1,
) -> dict[str, Any]:
    """Solve a graph of so many keyframes and closures in all, without ten closures, whole, and whole from the former.

    Args:
        robots: That share the keyframes.
        keyframes: Of all robots.
        closures: Wanted; the robots may meet less often.
        formulation: The default is the agent's.
        solver: The default is the agent's.
        seed: Of the graph.

    Returns:
        `full`, `round` and `ratio` of CPU seconds, how far the round's solution lies from the full one, peak memory.
    """
    generated = generate(np.random.default_rng(seed), robots, keyframes // robots, closures)
    graph = generated.graph
    asked = {"formulation": formulation, "solver": solver}
    config = BackendConfig(weight_by_probability=False, **{k: v for k, v in asked.items() if v is not None})
    before_mb = peak_mb()
    full, full_s = timed(lambda: optimise(graph, config))
    full_mb = peak_mb()
    fewer = PoseGraph(graph.trajectories, graph.closures[:-NEW_CLOSURES])
    earlier, _ = timed(lambda: optimise(fewer, config))
    warm, warm_s = timed(lambda: optimise(graph, config, earlier))
    apart_m, apart_deg = apart(full, warm)
    return {
        "keyframes": sum(len(t) for t in graph.trajectories.values()),
        "closures": len(graph.closures),
        "formulation": config.formulation.value,
        "solver": config.solver.value,
        "full": {"cpu_s": full_s, "solves": full.iterations, "cost": cost(full)},
        "round": {"cpu_s": warm_s, "solves": warm.iterations, "cost": cost(warm)},
        "ratio": warm_s / full_s,
        "apart_m": apart_m,
        "apart_deg": apart_deg,
        "peak_mb": full_mb,
        "peak_before_mb": before_mb,
    }


def timed(call: Callable[[], Any]) -> tuple[GraphSolution, float]:
    """A solution and its CPU seconds."""
    began = time.process_time()
    solution = call()
    assert isinstance(solution, GraphSolution)
    return solution, time.process_time() - began


def cost(solution: GraphSolution) -> float:
    """Cost of all components."""
    return sum(component.cost for component in solution.components)


def apart(a: GraphSolution, b: GraphSolution) -> tuple[float, float]:
    """Greatest distance, m, and angle, degrees, between two solutions' poses of a keyframe."""
    worst_m = worst_rad = 0.0
    of_b = {log: T for component in b.components for log, T in component.T_map_keyframe.items()}
    for component in a.components:
        for log, T_a in component.T_map_keyframe.items():
            difference = inverse(np.asarray(T_a)) @ of_b[log]
            worst_m = max(worst_m, float(np.linalg.norm(difference[:, :3, 3], axis=1).max()))
            furthest = int(np.argmin(np.trace(difference[:, :3, :3], axis1=1, axis2=2)))
            worst_rad = max(worst_rad, angle_rad(between(T_a[furthest], of_b[log][furthest])[:3, :3]))
    return worst_m, float(np.degrees(worst_rad))


def peak_mb() -> float:
    """The most memory that this process had so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def text(result: dict[str, Any]) -> str:
    """One result in a few lines."""
    full, round_ = result["full"], result["round"]
    return (
        f"{result['keyframes']} keyframes, {result['closures']} closures, {result['formulation']}, {result['solver']}\n"
        f"full solve           {full['cpu_s']:.2f} s of CPU, {full['solves']} linear systems, cost {full['cost']:.6g}\n"
        f"ten closures more    {round_['cpu_s']:.2f} s of CPU, {round_['solves']} linear systems, "
        f"{result['ratio']:.3f} of the full solve, {100 * result['apart_m']:.2f} cm and {result['apart_deg']:.3f} "
        f"degrees from it at most\n"
        f"peak memory          {result['peak_mb']:.0f} MB, of which {result['peak_before_mb']:.0f} MB before it"
    )
