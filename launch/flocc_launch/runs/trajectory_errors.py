"""Trajectory errors: ATE and RPE of one robot and of all robots together.

Poses are body poses, (N, 4, 4), metres. Ground truth is brought to the keyframes' stamps first; keyframes
without ground truth do not count. The tests hold these few lines against evo to 1e-9.
"""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import which

import numpy as np
from numpy.typing import NDArray

from flocc_agent.extras import to_install
from flocc_agent.geometry import between, inverse, so3_log, umeyama
from flocc_agent.runtime.trajectory import Trajectory
from flocc_protocol.errors import FloccError

Float = NDArray[np.float64]


class EvaluationError(FloccError):
    """What was asked cannot be evaluated; one sentence says why."""


@dataclass(frozen=True, slots=True)
class RelativePoseError:
    """RMSE of the relative motion over `delta` keyframes."""

    translation_rmse_m: float
    rotation_rmse_deg: float


def associate(stamps_s: Float, truth: Trajectory) -> tuple[NDArray[np.bool_], Float]:
    """Bring ground truth to the keyframes' stamps, interpolated where no sample is at a stamp.

    Args:
        stamps_s: (N,) of the keyframes.
        truth: `T_world_body`.

    Returns:
        Which keyframes have ground truth, (N,), and the true poses of those, (K, 4, 4).
    """
    found = [truth.at(float(stamp_s)) for stamp_s in stamps_s]
    known = np.array([T is not None for T in found], dtype=bool)
    return known, np.array([T for T in found if T is not None]).reshape(-1, 4, 4)


def rmse_m(errors_m: Float) -> float:
    """Root mean square of (N, 3) position errors."""
    return float(np.sqrt((errors_m**2).sum(axis=1).mean()))


def alignment(estimates: Sequence[Float], truths: Sequence[Float]) -> Float:
    """One `T_world_map` (4, 4) that moves all robots' estimates together onto ground truth (Umeyama)."""
    source = np.concatenate([T[:, :3, 3] for T in estimates])
    target = np.concatenate([T[:, :3, 3] for T in truths])
    return umeyama(source, target)[1]


def ate_m(estimates: Sequence[Float], truths: Sequence[Float]) -> float | None:
    """Translation RMSE over all keyframes of all robots after one SE(3) alignment for all of them together.

    Args:
        estimates: Per robot (N_r, 4, 4), all in one map frame.
        truths: Per robot (N_r, 4, 4), in one world frame.

    Returns:
        Metres, or None where there is no keyframe with ground truth.
    """
    if not sum(len(truth) for truth in truths):
        return None
    T_world_map = alignment(estimates, truths)
    return unaligned_ate_m([T_world_map @ T for T in estimates], truths)


def unaligned_ate_m(estimates: Sequence[Float], truths: Sequence[Float]) -> float | None:
    """Translation RMSE over all keyframes of all robots, as they stand."""
    if not sum(len(truth) for truth in truths):
        return None
    pairs = zip(estimates, truths, strict=True)
    return rmse_m(np.concatenate([estimate[:, :3, 3] - truth[:, :3, 3] for estimate, truth in pairs]))


def placed_at_true_start(T_odom_body: Float, T_world_body: Float) -> Float:
    """Odometry (N, 4, 4) in the world frame, put so that its first pose is the true one.

    `T_world_odom = T_world_body[0] @ inverse(T_odom_body[0])`.
    """
    if not len(T_odom_body):
        return T_odom_body
    return np.asarray(T_world_body[0] @ inverse(T_odom_body[0]) @ T_odom_body)


def relative_pose_error(estimate: Float, truth: Float, delta: int = 1) -> RelativePoseError | None:
    """RPE over pairs of keyframes `delta` apart, one after the other.

    Args:
        estimate: (N, 4, 4), any frame.
        truth: (N, 4, 4), any frame.
        delta: Keyframes between the two ends of a pair.

    Returns:
        RMSE of translation and rotation, or None where there is no such pair.
    """
    ends = np.arange(0, len(truth), delta)
    if len(ends) < 2:
        return None
    moved = between(estimate[ends[:-1]], estimate[ends[1:]])
    true_moved = between(truth[ends[:-1]], truth[ends[1:]])
    errors = between(true_moved, moved)
    angles_rad = np.array([np.linalg.norm(so3_log(T[:3, :3])) for T in errors])
    rotation_rmse_rad = float(np.sqrt((angles_rad**2).mean()))
    return RelativePoseError(rmse_m(errors[:, :3, 3]), float(np.rad2deg(rotation_rmse_rad)))


def evo_program() -> str:
    """Where `evo_ape` is: beside this Python, activated or not, or on the path.

    Raises:
        EvaluationError: evo is not installed.
    """
    beside = Path(sys.executable).parent
    program = which("evo_ape", path=str(beside)) or which("evo_ape")
    if program is None:
        raise EvaluationError(f"--evo needs evo: {to_install('eval')}")
    return program


def evo_ape(truth_tum: Path, estimate_tum: Path, program: str) -> str:
    """Run evo's own `evo_ape tum --align` on two files of a run folder and return what it prints.

    Raises:
        EvaluationError: It refused the files.
    """
    command = [program, "tum", str(truth_tum), str(estimate_tum), "--align"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    if ran.returncode != 0:
        reason = (ran.stderr or ran.stdout).strip().splitlines() or ["no reason given"]
        raise EvaluationError(f"evo_ape refused {estimate_tum}: {reason[-1]}")
    return ran.stdout
