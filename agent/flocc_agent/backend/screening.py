"""What must not reach the solver: broken odometry, closures that cannot be right, each with its reason."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, PoseGraph, Trajectory
from flocc_agent.geometry import angle_rad, between, inverse
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

TRANSLATION_UNSCALED_MIN = 1e-9
TRANSLATION_MAX_M = 1e6
"""Nothing that a robot registers is a thousand kilometres away; a correction could not even say so."""
SAME_ROTATION_RAD = 0.02
SAME_TRANSLATION_RATIO = 0.05
CONDITION_MAX = 1e14
SYMMETRY_RATIO = 1e-6
RIGID_TOLERANCE = 2e-3


@dataclass(frozen=True, slots=True)
class Screened:
    """What is left of a pose graph, and why the rest went.

    Attributes:
        trajectories: Logs with usable odometry, sorted.
        excluded: Reason per closure index; closures that are not named may be used.
        warnings: One sentence per exclusion that is not a closure's.
    """

    trajectories: dict[LogId, Trajectory]
    excluded: dict[int, str]
    warnings: tuple[str, ...]


def screen(graph: PoseGraph) -> Screened:
    """Keep what can be solved and name what cannot, with its robot or keyframes."""
    trajectories: dict[LogId, Trajectory] = {}
    warnings: list[str] = []
    for log in sorted(graph.trajectories):
        usable, complaint = _usable_trajectory(log, graph.trajectories[log])
        if complaint:
            warnings.append(complaint)
        if usable is not None:
            trajectories[log] = usable
    excluded = closure_complaints(graph.closures, trajectories)
    excluded.update(_duplicates(graph.closures, excluded))
    return Screened(trajectories, excluded, tuple(warnings))


def are_covariances(matrices: Float) -> Bool:
    """Whether each of (N, n, n) matrices is finite, symmetric, positive definite and not hopelessly conditioned."""
    finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], matrices, np.eye(matrices.shape[-1]))
    transposed = np.swapaxes(safe, 1, 2)
    slack = SYMMETRY_RATIO * np.abs(safe).max(axis=(1, 2))
    symmetric = np.abs(safe - transposed).max(axis=(1, 2)) <= slack
    eigenvalues = np.linalg.eigvalsh(0.5 * (safe + transposed))
    low, high = eigenvalues[:, 0], eigenvalues[:, -1]
    return np.asarray(finite & symmetric & (low > 0) & (high < CONDITION_MAX * low))


def is_covariance(matrix: Float, size: int) -> bool:
    """Whether one matrix is a usable covariance of the given size."""
    matrix = np.asarray(matrix, dtype=float)
    return matrix.shape == (size, size) and bool(are_covariances(matrix[None])[0])


def _usable_trajectory(log: LogId, trajectory: Trajectory) -> tuple[Trajectory | None, str]:
    T = np.asarray(trajectory.T_odom_keyframe, dtype=float)
    if len(T) == 0:
        return None, f"robot {log} has no odometry and is left out"
    bad = first_not_rigid(T)
    if bad is not None:
        return None, f"odometry of robot {log} is not a rigid pose at keyframe {bad}; the robot is left out"
    covariances = trajectory.edge_covariances
    if covariances is None:
        return trajectory, ""
    if len(covariances) != len(T) - 1:
        return Trajectory(T), f"robot {log} gives {len(covariances)} odometry covariances for {len(T) - 1} edges"
    covariances = np.asarray(covariances, dtype=float)
    sized = covariances.shape[1:] == (6, 6)
    wrong = np.flatnonzero(~are_covariances(covariances)).tolist() if sized and len(covariances) else []
    if sized and not wrong:
        return trajectory, ""
    return Trajectory(T), (
        f"odometry covariance of robot {log} at edge {wrong[0] if wrong else 0} is not positive definite; "
        "the configured one is used"
    )


def first_not_rigid(T: Float) -> int | None:
    """Index of the first pose of (N, 4, 4) that is not finite and rigid, or None."""
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        return 0
    good = are_rigid(T)
    return None if good.all() else int(np.argmin(good))


def are_rigid(T: Float) -> Bool:
    """Whether each of (N, 4, 4) arrays is a finite rigid pose."""
    finite = np.asarray(np.isfinite(T).all(axis=(1, 2)))
    T = np.where(finite[:, None, None], T, np.eye(4))
    R = T[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        orthonormal = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2)) < RIGID_TOLERANCE
        last_row = np.abs(T[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1) < RIGID_TOLERANCE
        return np.asarray(finite & orthonormal & last_row & (np.linalg.det(R) > 0))


def closure_complaints(closures: Sequence[LoopClosure], trajectories: Mapping[LogId, Trajectory]) -> dict[int, str]:
    """Why closures cannot be used, by index, in one sentence each; those that can are not named."""
    complaints = {k: text for k, c in enumerate(closures) if (text := _plain_complaint(c, trajectories))}
    rest = [k for k in range(len(closures)) if k not in complaints]
    if rest:
        T = np.array([closures[k].T_query_match_unscaled for k in rest], dtype=float)
        rigid, finite = are_rigid(T), np.isfinite(T).all(axis=(1, 2))
        for n in np.flatnonzero(~rigid):
            complaints[rest[n]] = f"the measurement is {'not a rigid pose' if finite[n] else 'not finite'}"
    weighed = [k for k in rest if k not in complaints and closures[k].covariance is not None]
    if weighed:
        good = are_covariances(np.array([closures[k].covariance for k in weighed], dtype=float))
        complaints |= {weighed[n]: "the covariance is not positive definite" for n in np.flatnonzero(~good)}
    return {k: f"closure {closures[k].query} - {closures[k].match}: {complaints[k]}" for k in sorted(complaints)}


def _plain_complaint(closure: LoopClosure, trajectories: Mapping[LogId, Trajectory]) -> str:
    """What is wrong with a closure's fields one by one; empty where nothing is."""
    for keyframe in (closure.query, closure.match):
        complaint = _missing(keyframe, trajectories)
        if complaint:
            return complaint
    if closure.query == closure.match:
        return "joins a keyframe with itself"
    if np.shape(closure.T_query_match_unscaled) != (4, 4):
        return "the measurement is not a rigid pose"
    if not math.isfinite(closure.match_ratio) or closure.match_ratio < 0:
        return f"the match ratio {closure.match_ratio} is not a ratio"
    if closure.covariance is not None and np.shape(closure.covariance) != (6, 6):
        return "the covariance is not positive definite"
    scale = closure.scale_initial
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        return f"the initial scale {scale} is not positive"
    x, y, z = closure.T_query_match_unscaled[:3, 3].tolist()
    length_m = math.hypot(x, y, z) * (1.0 if closure.metric else scale or 1.0)
    if math.isfinite(length_m) and length_m > TRANSLATION_MAX_M:
        return f"the measured length of {length_m:.3g} m is longer than {TRANSLATION_MAX_M:.0g} m"
    if not closure.metric and math.hypot(x, y, z) < TRANSLATION_UNSCALED_MIN:
        return "a translation of zero length has no direction to scale"
    return ""


def _missing(keyframe: KeyframeId, trajectories: Mapping[LogId, Trajectory]) -> str:
    trajectory = trajectories.get(keyframe.log)
    if trajectory is None:
        return f"robot {keyframe.log} has no odometry"
    if keyframe.index >= len(trajectory):
        return f"keyframe {keyframe} is not there, robot {keyframe.log} has {len(trajectory)}"
    return ""


def _duplicates(closures: Sequence[LoopClosure], excluded: Mapping[int, str]) -> dict[int, str]:
    """Exclude all but the best closure of each pair: the highest match ratio, then the first.

    Metric closures with a covariance of their own are measurements in their own right: every one counts.
    """
    best: dict[tuple[KeyframeId, KeyframeId], int] = {}
    reasons: dict[int, str] = {}
    for k, closure in enumerate(closures):
        if k in excluded or (closure.metric and closure.covariance is not None):
            continue
        low, high = sorted((closure.query, closure.match))
        other = best.setdefault((low, high), k)
        if other == k:
            continue
        keep, drop = (k, other) if closure.match_ratio > closures[other].match_ratio else (other, k)
        best[low, high] = keep
        verb = "repeats" if _agree(closures[keep], closures[drop]) else "contradicts"
        reasons[drop] = (
            f"closure {closures[drop].query} - {closures[drop].match}: {verb} another closure of the same keyframes"
        )
    return reasons


def _agree(a: LoopClosure, b: LoopClosure) -> bool:
    T_a, T_b = a.T_query_match_unscaled, b.T_query_match_unscaled
    if a.query != b.query:
        T_b = inverse(T_b)
    if angle_rad(between(T_a, T_b)[:3, :3]) > SAME_ROTATION_RAD:
        return False
    u, v = T_a[:3, 3], T_b[:3, 3]
    if not (a.metric and b.metric):
        u, v = u / max(float(np.linalg.norm(u)), 1e-12), v / max(float(np.linalg.norm(v)), 1e-12)
    return float(np.linalg.norm(u - v)) <= SAME_TRANSLATION_RATIO * max(float(np.linalg.norm(u)), 1e-3)
