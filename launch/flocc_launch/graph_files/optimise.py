"""`flocc optimise FILE`: any formulation and solver on a pose graph from a file, and what came out of it.

Every robot starts in its own odometry frame, unless the file's initialisation is asked for. The noise is
the file's own, or SE-Sync's isotropic model, with which `cost` is SE-Sync's objective. Costs in `result.json` are sums
of squared weighted residuals, without the half. The result lies where the file has its fixed or first vertex.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import BackendConfig, Formulation, ScaleInitial, Solver
from flocc_agent.core.pose_graph import (
    ClosureResult,
    ClosureState,
    Component,
    GraphSolution,
    LoopClosure,
    OptimisationFailed,
)
from flocc_agent.geometry import in_units, inverse
from flocc_launch.graph_files import GraphFile, read_graph_file, write_g2o
from flocc_launch.graph_files.graph_file import GraphFileError, ate_m, first_poses_at, unmeasured_steps
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

CONVERGED_RATIO = 1e-9


class NoiseModel(StrEnum):
    """What is made of a file's information matrices."""

    GAUSSIAN = "gaussian"
    ISOTROPIC = "isotropic"


class OptimiseError(FloccError):
    """A pose graph from a file could not be optimised; the message names the file."""


def optimise_file(
    path: Path,
    out: Path,
    *,
    formulation: Formulation | None = None,
    solver: Solver | None = None,
    scale_initial: ScaleInitial | None = None,
    pairwise_consistency: bool = False,
    unit_scale: bool = False,
    drop_labelled_outliers: bool = False,
    from_file_initialisation: bool = False,
    noise: NoiseModel = NoiseModel.GAUSSIAN,
    seed: int = 0,
) -> dict[str, Any]:
    """Optimise the pose graph of a file and write `result.json`, `optimised.g2o` and corrected trajectories.

    Args:
        path: A .g2o file, a folder of one .g2o file per robot, or a .jrl file.
        out: Folder for the results; created where it is missing.
        formulation: Scales of closures; the default is the agent's.
        solver: The default is the agent's.
        scale_initial: Where free scales start; `ground-truth` takes them from the file's own translations.
        pairwise_consistency: Filter closures by pairwise consistency first.
        unit_scale: Reduce translations of inter-robot closures to length one and free their scale.
        drop_labelled_outliers: Leave out closures that the file labels as wrong.
        from_file_initialisation: Start from the file's own initialisation.
        noise: Information matrices as they are, or reduced to SE-Sync's isotropic ones.
        seed: Recorded; nothing in the back end is drawn by chance.

    Returns:
        The object that `result.json` holds.

    Raises:
        GraphFileError: The file cannot be read, or lacks what was asked for.
        OptimiseError: There is no solution, or the folder cannot be written.
    """
    file = read_graph_file(path, isotropic=noise is NoiseModel.ISOTROPIC)
    file = prepared(file, path, unit_scale, drop_labelled_outliers, scale_initial)
    config = file_config(formulation, solver, scale_initial, pairwise_consistency)
    initial = initialisation(file, path) if from_file_initialisation else None
    from flocc_agent.backend.optimiser import optimise

    solution = optimise(file.graph, config, initial)
    if isinstance(solution, OptimisationFailed):
        raise OptimiseError(f"{path}: {solution.reason}")
    if not np.isfinite([c.cost for c in solution.components]).all():
        raise OptimiseError(f"{path}: no finite cost was found: its measurements are out of all proportion")
    result = {
        "file": str(path),
        "seed": seed,
        "noise": noise.value,
        "unit_scale": unit_scale,
        "drop_labelled_outliers": drop_labelled_outliers,
        **report(file, config, solution),
    }
    _write(out, result, in_frame_of(file, solution), file)
    return result


def prepared(
    file: GraphFile, path: Path, unit_scale: bool, drop_labelled_outliers: bool, scale_initial: ScaleInitial | None
) -> GraphFile:
    """Apply the options that change the graph."""
    if drop_labelled_outliers:
        if not file.outliers:
            raise GraphFileError(f"{path}: labels no outliers")
        file = file.without_outliers()
    if not unit_scale:
        return file
    unit = file.with_unit_scale()
    if scale_initial is not ScaleInitial.GROUND_TRUTH:
        return unit
    closures = [
        c if c.metric else replace(c, scale_initial=float(np.linalg.norm(metric.T_query_match_unscaled[:3, 3])) or None)
        for c, metric in zip(unit.graph.closures, file.graph.closures, strict=True)
    ]
    return replace(unit, graph=replace(unit.graph, closures=closures))


def file_config(
    formulation: Formulation | None,
    solver: Solver | None,
    scale_initial: ScaleInitial | None,
    pairwise_consistency: bool = False,
) -> BackendConfig:
    """The agent's configuration with what was asked for; a file's covariances are trusted, Eq. (2) is off."""
    asked = {"formulation": formulation, "solver": solver, "scale_initial": scale_initial}
    return BackendConfig(
        **{key: value for key, value in asked.items() if value is not None},
        pairwise_consistency=pairwise_consistency,
        weight_by_probability=False,
        relative_tolerance=CONVERGED_RATIO,
    )


def initialisation(file: GraphFile, path: Path) -> GraphSolution:
    """The file's own initial poses, as an earlier solution in the anchor's frame.

    Raises:
        GraphFileError: The file has none for some robot.
    """
    logs = tuple(sorted(file.graph.trajectories))
    missing = [log for log in logs if log not in file.T_initial]
    if missing:
        raise GraphFileError(f"{path}: has no initialisation of robot {missing[0]}")
    T_map_file = file.graph.trajectories[logs[0]].T_odom_keyframe[0] @ inverse(file.T_initial[logs[0]][0])
    poses = {log: T_map_file @ file.T_initial[log] for log in logs}
    return GraphSolution((Component(logs, poses, {}, {}),), ())


def report(file: GraphFile, config: BackendConfig, solution: GraphSolution) -> dict[str, Any]:
    """Everything of the result that does not depend on how it was asked for."""
    return {
        "formulation": config.formulation.value,
        "solver": config.solver.value,
        "cost_initial": 2.0 * sum(c.cost_initial for c in solution.components),
        "cost": 2.0 * sum(c.cost for c in solution.components),
        "ate_m": ate_m(positions(solution), file.truth_m),
        "ate_odometry_m": odometry_ate_m(file),
        "iterations": solution.iterations,
        "solve_s": solution.solve_s,
        "timings_s": dict(solution.timings_s),
        "components": [{"map_frame": c.map_frame, "logs": [str(log) for log in c.logs]} for c in solution.components],
        "covariance_factors": {
            str(log): [round(factor, 3) for factor in factors]
            for c in solution.components
            for log, factors in sorted(c.covariance_factors.items())
        },
        "closures": len(solution.closures),
        "closures_used": sum(c.state is ClosureState.USED for c in solution.closures),
        "closures_rejected": _named(solution, ClosureState.REJECTED),
        "closures_excluded": _named(solution, ClosureState.EXCLUDED),
        "warnings": [*_unread(file), *solution.warnings],
        **label_counts(file, solution),
    }


def _unread(file: GraphFile) -> list[str]:
    lines = [f"{count} lines of kind {kind} are left out" for kind, count in sorted(file.left_out.items())]
    lines += file.notes
    unmeasured = {log: unmeasured_steps(t) for log, t in sorted(file.graph.trajectories.items())}
    return lines + [
        f"{count} steps of robot {log} are not measured: they start along other measurements, and hold nothing"
        for log, count in unmeasured.items()
        if count
    ]


def label_counts(file: GraphFile, solution: GraphSolution) -> dict[str, int | None]:
    """How the solver's choice compares with the file's labels; null where it has none."""
    if not file.outliers:
        return {"labelled_outliers": None, "outliers_used": None, "inliers_rejected": None}
    states = [closure.state for closure in solution.closures]
    return {
        "labelled_outliers": len(file.outliers),
        "outliers_used": sum(states[k] is ClosureState.USED for k in file.outliers),
        "inliers_rejected": sum(s is not ClosureState.USED for k, s in enumerate(states) if k not in file.outliers),
    }


def positions(solution: GraphSolution) -> dict[LogId, Float]:
    """Corrected positions (N, 3) of every log."""
    return {log: T[:, :3, 3] for c in solution.components for log, T in c.T_map_keyframe.items()}


def odometry_ate_m(file: GraphFile) -> float | None:
    """Joint ATE of odometry alone, each robot placed at its first pose; null where the file does not tell it."""
    trajectories = file.graph.trajectories
    if not file.truth_m or set(file.T_initial) != set(trajectories):
        return None
    placed = {log: first_poses_at(t.T_odom_keyframe, file.T_initial[log][0]) for log, t in trajectories.items()}
    return ate_m({log: T[:, :3, 3] for log, T in placed.items()}, file.truth_m)


def in_frame_of(file: GraphFile, solution: GraphSolution) -> GraphSolution:
    """The solution moved so that each component's fixed keyframe, else its first, is where the file has its vertex."""
    return replace(solution, components=tuple(_in_frame_of(file, component) for component in solution.components))


def _in_frame_of(file: GraphFile, component: Component) -> Component:
    held = [k for k in file.fixed if k.log in component.logs]
    at = held[0] if held else KeyframeId(component.anchor, 0)
    if at.log not in file.T_initial:
        return component
    T_file_map = file.T_initial[at.log][at.index] @ inverse(component.T_map_keyframe[at.log][at.index])
    return replace(component, T_map_keyframe={log: T_file_map @ T for log, T in component.T_map_keyframe.items()})


def _named(solution: GraphSolution, state: ClosureState) -> list[dict[str, str]]:
    return [_name(closure) for closure in solution.closures if closure.state is state]


def _name(closure: ClosureResult) -> dict[str, str]:
    return {"query": str(closure.query), "match": str(closure.match), "reason": closure.reason}


def _write(out: Path, result: Mapping[str, Any], solution: GraphSolution, file: GraphFile) -> None:
    poses = {log: T for c in solution.components for log, T in c.T_map_keyframe.items()}
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OptimiseError(f"{out}: cannot be written: {error.strerror or error}") from error
    used = [
        _scaled(c, r.scale)
        for c, r in zip(file.graph.closures, solution.closures, strict=True)
        if r.state is ClosureState.USED
    ]
    write_g2o(out / "optimised.g2o", poses, used, file.vertices)


def _scaled(closure: LoopClosure, scale: float | None) -> LoopClosure:
    """A closure with its estimated scale put into its translation and covariance."""
    T, metres = np.array(closure.T_query_match_unscaled), scale or 1.0
    T[:3, 3] *= metres
    covariance = None if closure.covariance is None else in_units(closure.covariance, 1.0 / metres)
    return replace(closure, T_query_match_unscaled=T, covariance=covariance, metric=True)
