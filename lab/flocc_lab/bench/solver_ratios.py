"""`flocc bench solver`: the back end against GTSAM's own factors and optimisers on one generated problem, as ratios.

Every contender starts from the same poses and stops by the same rule (GTSAM's defaults: relative decrease 1e-5), in
one process, one after the other, repeated; what is compared are medians. Timed is solving, without building the
graph, on both sides. The contenders of GTSAM:

- `base+LM`: `BetweenFactorPose3`, scales fixed at their initial values, `LevenbergMarquardtOptimizer`;
- `base+GNC`: the same with `GncLMOptimizer`, truncated least squares, odometry known to be right;
- `smoothed with CustomFactor`: our residual and our scale model, one Python factor per closure.
"""

import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.descent import Objective, Solved
from flocc_agent.backend.edges import Edges, state_of
from flocc_agent.backend.initial import initial_poses
from flocc_agent.backend.linear import LinearSolver
from flocc_agent.backend.optimiser import optimise
from flocc_agent.backend.problem import Problem, build
from flocc_agent.backend.rotations import matrices
from flocc_agent.backend.solvers import solve
from flocc_agent.config import BackendConfig, Formulation, Solver
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph
from flocc_agent.geometry import hat
from flocc_lab.bench.generated_graph import GeneratedGraph, generate
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

SIZES = ((6, 500, 5000), (6, 1000, 10000))
NEW_CLOSURES = 50
CUSTOM_FACTOR_CLOSURES_MAX = 5000
COMMAND = "flocc bench solver --json"
ANCHOR_SIGMA = 1e-6
SCALE_KEYS_FROM = 1 << 40
LIMITS = {
    "smoothed_lm_over_gtsam_base_lm": 1.5,
    "independent_lm_over_gtsam_base_lm": 1.2,
    "smoothed_lm_over_smoothed_custom_factor": 0.04,
    "smoothed_lm_over_gtsam_base_gnc": 0.1,
    "resolve_over_full": 0.3,
    "resolve_over_full_smoothed_lm": 0.3,
}


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """One generated problem and the poses from which every contender starts."""

    generated: GeneratedGraph
    T_start: dict[LogId, Float]

    @property
    def graph(self) -> PoseGraph:
        """The pose graph."""
        return self.generated.graph


def config_of(formulation: Formulation, solver: Solver = Solver.LM) -> BackendConfig:
    """A configuration that trusts the generated covariances."""
    return BackendConfig(formulation=formulation, solver=solver, weight_by_probability=False, covariances=False)


def prepare(robots: int, keyframes: int, closures: int, seed: int) -> Bench:
    """Draw a problem and align its robots."""
    generated = generate(np.random.default_rng(seed), robots, keyframes, closures)
    by_index = dict(enumerate(generated.graph.closures))
    return Bench(generated, initial_poses(generated.graph.trajectories, by_index, 4.0, None)[0])


def run(seed: int = 1, repeats: int = 3, sizes: tuple[tuple[int, int, int], ...] = SIZES) -> dict[str, Any]:
    """Measure everything.

    Args:
        seed: Of the generated problems.
        repeats: How often each fast contender runs; the GNC reference runs once per problem, the
            CustomFactor reference once where there are at most `CUSTOM_FACTOR_CLOSURES_MAX` closures (minutes).
        sizes: Robots, keyframes per robot and closures of each problem.

    Returns:
        `ratios` (name -> median, min, max, limit, met), `costs`, `machine`, `command`, `problems`.
    """
    began = time.perf_counter()
    measured = [measure(prepare(*size, seed), repeats, size) for size in sizes]
    ratios = {f"{name}/{m['problem']}": ratio for m in measured for name, ratio in m["ratios"].items()}
    return {
        "ratios": ratios,
        "costs": {m["problem"]: m["costs"] for m in measured},
        "problems": [
            {"problem": m["problem"], "seconds": m["seconds"], "iterations": m["iterations"]} for m in measured
        ],
        "machine": {"processor": platform.processor() or platform.machine(), "python": platform.python_version()},
        "seed": seed,
        "repeats": repeats,
        "wall_s": time.perf_counter() - began,
        "command": COMMAND,
    }


def measure(bench: Bench, repeats: int, size: tuple[int, int, int]) -> dict[str, Any]:
    """Time every contender on one problem; interleaved, so that a busy machine hits all of them."""
    ours = {
        f: solver_of(bench, config_of(f)) for f in (Formulation.SMOOTHED, Formulation.INDEPENDENT, Formulation.BASE)
    }
    problem = problem_of(bench, config_of(Formulation.SMOOTHED))
    graph, values = gtsam_base(bench)
    default = config_of(BackendConfig().formulation, BackendConfig().solver)
    seconds: dict[str, list[float]] = {}
    solved: dict[str, Any] = {}
    for _ in range(repeats):
        _timed("gtsam_base_lm", lambda: gtsam_lm(graph, values), seconds, solved)
        for formulation, call in ours.items():
            _timed(f"{formulation.value}_lm", call, seconds, solved)
        _rounds(bench, default, "", seconds, solved)
        _rounds(bench, config_of(Formulation.SMOOTHED), "_smoothed_lm", seconds, solved)
    _timed("gtsam_base_gnc", lambda: gtsam_gnc(graph, values, bench), seconds, solved)
    if len(bench.graph.closures) <= CUSTOM_FACTOR_CLOSURES_MAX:
        _timed("smoothed_custom_factor", lambda: custom_factor(problem, bench), seconds, solved)
    return {
        "problem": "x".join(str(n) for n in size),
        "ratios": ratios_of(seconds),
        "seconds": {name: statistics.median(values_s) for name, values_s in seconds.items()},
        "iterations": {
            "smoothed_lm": solved["smoothed_lm"].iterations,
            "independent_lm": solved["independent_lm"].iterations,
            "gtsam_base_lm": solved["gtsam_base_lm"],
        },
        "costs": _costs(solved),
    }


def ratios_of(seconds: dict[str, list[float]]) -> dict[str, dict[str, float | bool]]:
    """Ratios of medians, with the least and greatest ratio that any pair of runs gives."""
    pairs = {
        "smoothed_lm_over_gtsam_base_lm": ("smoothed_lm", "gtsam_base_lm"),
        "independent_lm_over_gtsam_base_lm": ("independent_lm", "gtsam_base_lm"),
        "smoothed_lm_over_smoothed_custom_factor": ("smoothed_lm", "smoothed_custom_factor"),
        "smoothed_lm_over_gtsam_base_gnc": ("smoothed_lm", "gtsam_base_gnc"),
        "resolve_over_full": ("resolve", "full"),
        "resolve_over_full_smoothed_lm": ("resolve_smoothed_lm", "full_smoothed_lm"),
    }
    return {name: ratio(seconds[a], seconds[b], LIMITS[name]) for name, (a, b) in pairs.items() if b in seconds}


def ratio(above: list[float], below: list[float], limit: float) -> dict[str, float | bool]:
    """Median over median, with its extremes and whether it keeps its limit."""
    median = statistics.median(above) / statistics.median(below)
    return {
        "median": median,
        "min": min(above) / max(below),
        "max": max(above) / min(below),
        "limit": limit,
        "met": median <= limit,
    }


def _timed(name: str, call: Callable[[], Any], seconds: dict[str, list[float]], solved: dict[str, Any]) -> None:
    began = time.perf_counter()
    solved[name] = call()
    seconds.setdefault(name, []).append(time.perf_counter() - began)


def _costs(solved: dict[str, Any]) -> dict[str, float]:
    ours = solved["smoothed_lm"].cost
    if "smoothed_custom_factor" not in solved:
        return {"smoothed": ours}
    reference = solved["smoothed_custom_factor"]
    return {
        "smoothed": ours,
        "smoothed_custom_factor": reference,
        "relative_difference": (ours - reference) / reference,
    }


def problem_of(bench: Bench, config: BackendConfig) -> Problem:
    """The arrays of a formulation."""
    by_index = dict(enumerate(bench.graph.closures))
    return build(bench.graph.trajectories, by_index, config)


def solver_of(bench: Bench, config: BackendConfig) -> Callable[[], Solved]:
    """A call that solves one formulation from the start."""
    problem = problem_of(bench, config)
    state = state_of(np.concatenate([bench.T_start[log] for log in problem.logs]), problem.clusters)

    def call() -> Solved:
        linear = LinearSolver(0, config.scale_prior_unknown_sigma_ratio)
        return solve(Objective(problem.edges, problem.closure_rows, linear, config), state)

    return call


def _rounds(
    bench: Bench, config: BackendConfig, suffix: str, seconds: dict[str, list[float]], solved: dict[str, Any]
) -> None:
    """Time a whole solve, and a round that adds closures to a graph that was solved before."""
    graph = bench.graph
    name, earlier = f"resolve{suffix}", f"before{suffix}"
    _timed(f"full{suffix}", lambda: optimise(graph, config), seconds, solved)
    if earlier not in solved:
        solved[earlier] = optimise(PoseGraph(graph.trajectories, graph.closures[:-NEW_CLOSURES]), config)
    before = solved[earlier]
    assert isinstance(before, GraphSolution)
    _timed(name, lambda: optimise(graph, config, before), seconds, solved)


def gtsam_base(bench: Bench) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The base formulation in GTSAM's own factors."""
    return between_factors(problem_of(bench, config_of(Formulation.BASE)), bench.T_start)


def between_factors(
    problem: Problem, T_start: Mapping[LogId, Float]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """GTSAM's own between factors for every edge, own scales put into the covariance; the anchor's prior is last."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses = np.concatenate([T_start[log] for log in problem.logs])
    for n, T in enumerate(poses):
        values.insert(n, gtsam.Pose3(T))
    edges = problem.edges
    T_hat = np.tile(np.eye(4), (len(edges), 1, 1))
    T_hat[:, :3, :3] = matrices(edges.q_hat)
    T_hat[:, :3, 3] = np.einsum("eij,ej->ei", T_hat[:, :3, :3], edges.d[:, 3:])
    for k in range(len(edges)):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(edges.sqrt_information_wide[k])
        graph.add(gtsam.BetweenFactorPose3(int(edges.i[k]), int(edges.j[k]), gtsam.Pose3(T_hat[k]), noise))
    anchor = gtsam.noiseModel.Isotropic.Sigma(6, ANCHOR_SIGMA)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(poses[0]), anchor))
    return graph, values


def gtsam_lm(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> int:
    """Run GTSAM's LM with its default stop rule; returns its iterations."""
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams())
    optimiser.optimize()
    return int(optimiser.iterations())


def gtsam_gnc(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, bench: Bench) -> gtsam.Values:
    """Run GTSAM's GNC; odometry and the anchor are known to be right."""
    closures = len(bench.graph.closures)
    known = [*range(graph.size() - 1 - closures), graph.size() - 1]
    return gnc_with(graph, values, known)[0]


def gnc_with(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, known: list[int]
) -> tuple[gtsam.Values, NDArray[np.float64]]:
    """Run GTSAM's GNC with truncated least squares and its default parameters; poses and every factor's weight."""
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(known)
    optimiser = gtsam.GncLMOptimizer(graph, values, params)
    return optimiser.optimize(), np.asarray(optimiser.getWeights())


def custom_factor(problem: Problem, bench: Bench) -> float:
    """The smoothed formulation with one Python factor per closure and explicit scales; returns its optimal cost."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses = np.concatenate([bench.T_start[log] for log in problem.logs])
    for n, T in enumerate(poses):
        values.insert(n, gtsam.Pose3(T))
    for k in range(len(problem.edges)):
        graph.add(_edge_factor(problem.edges, k))
    rows = range(problem.closure_rows.start, problem.closure_rows.stop)
    for k in rows:
        _add_scale_factors(problem, k, graph, values)
    for c in range(problem.clusters):
        values.insert(SCALE_KEYS_FROM + c, np.ones(1))
        graph.add(_scale_prior(SCALE_KEYS_FROM + c, _prior_sigma()))
    graph.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3(poses[0])))
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams())
    optimiser.optimize()
    return float(optimiser.error())


def _prior_sigma() -> float:
    return config_of(Formulation.SMOOTHED).scale_prior_unknown_sigma_ratio


def _edge_factor(edges: Edges, k: int) -> gtsam.CustomFactor:
    """Our residual of one edge as a Python factor, its own scale an explicit variable (equations in `edges`)."""
    R_hat_inverse, L, d = matrices(edges.q_hat[k : k + 1])[0].T, edges.sqrt_information[k], edges.d[k]
    rotation_hat_inverse = gtsam.Rot3(R_hat_inverse)
    i, j, has_scale = int(edges.i[k]), int(edges.j[k]), bool(edges.sigma[k] > 0)
    keys = [i, j, _own_key(k)] if has_scale else [i, j]
    eye = np.eye(3)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Float] | None) -> Float:
        T_ij = values.atPose3(i).between(values.atPose3(j))
        p = T_ij.translation()
        rotation_error = rotation_hat_inverse.compose(T_ij.rotation())
        q: Any = rotation_error.toQuaternion()
        sign = 1.0 if q.w() >= 0 else -1.0
        v = sign * np.array([q.x(), q.y(), q.z()])
        scale = values.atVector(keys[2])[0] if has_scale else 1.0
        e = np.concatenate([2.0 * v, R_hat_inverse @ p]) - scale * d
        if H is not None:
            R_error = rotation_error.matrix()
            J_r = sign * q.w() * eye + hat(v)
            J_i, J_j = np.zeros((6, 6)), np.zeros((6, 6))
            J_i[:3, :3] = -J_r @ R_error.T @ R_hat_inverse
            J_i[3:, :3] = R_hat_inverse @ hat(p)
            J_i[3:, 3:] = -R_hat_inverse
            J_j[:3, :3], J_j[3:, 3:] = J_r, R_error
            H[0], H[1] = L @ J_i, L @ J_j
            if has_scale:
                H[2] = -(L @ d)[:, None]
        return np.asarray(L @ e)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, error)


def _own_key(k: int) -> int:
    return 2 * SCALE_KEYS_FROM + k


def _add_scale_factors(problem: Problem, k: int, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    """A closure's own scale, tied to its cluster's scale or to one."""
    edges = problem.edges
    values.insert(_own_key(k), np.ones(1))
    sigma, cluster = float(edges.sigma[k]), int(edges.cluster[k])
    if cluster < 0:
        graph.add(_scale_prior(_own_key(k), sigma))
        return

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Float] | None) -> Float:
        if H is not None:
            H[0], H[1] = np.full((1, 1), 1.0 / sigma), np.full((1, 1), -1.0 / sigma)
        own, common = values.atVector(_own_key(k)), values.atVector(SCALE_KEYS_FROM + cluster)
        return np.asarray((own - common) / sigma)

    keys = [_own_key(k), SCALE_KEYS_FROM + cluster]
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), keys, error))


def _scale_prior(key: int, sigma: float) -> gtsam.CustomFactor:
    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Float] | None) -> Float:
        if H is not None:
            H[0] = np.full((1, 1), 1.0 / sigma)
        return np.asarray((values.atVector(key) - 1.0) / sigma)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [key], error)
