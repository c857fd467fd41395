"""First poses of a log whose keyframes were fixed in a world: its odometry bent along its fixes.

A long way drifts so far that, laid as a rigid whole, most right fixes look wrong, and a robust solver that starts there
throws them out. So the way is laid window by window: each window of fixes gives a rigid motion (Umeyama 1991, on the
fixes that agree), and keyframes between two windows a blend of both. On a straight window the fixes leave the turn
about it open; a few points as the window before it would move them hold that.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure, is_landmark
from flocc_agent.geometry import pose, se3_exp, se3_log, umeyama
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]
Int = NDArray[np.int64]

FIXES_MIN = 8
"""With fewer fixes a log stays a rigid whole."""
WINDOW_FIXES = 15
WINDOW_SIGMAS = 10.0
"""A window grows until it is this many standard deviations of a fix long."""
HOLDING_RATIO = 0.2
"""How far from the window's middle the holding points lie, of its length."""
ROUNDS = 4
DISAGREEING_RATIO = 3.0
"""A fix this many times the median distance away is left out of its window."""


def bent_along_fixes(T_map_keyframe: Mapping[LogId, Float], closures: Mapping[int, LoopClosure]) -> dict[LogId, Float]:
    """Bend the first poses (N, 4, 4) of each log along its positions in a world; others stay as they are."""
    bent = dict(T_map_keyframe)
    for log, of_log in _positions(closures).items():
        if log in bent and len(of_log) >= FIXES_MIN:
            bent[log] = _bent(bent[log], of_log, T_map_keyframe)
    return bent


def _positions(closures: Mapping[int, LoopClosure]) -> dict[LogId, list[LoopClosure]]:
    """Closures from landmarks to keyframes, by log."""
    found: dict[LogId, list[LoopClosure]] = {}
    for k in sorted(closures):
        if is_landmark(closures[k].query.log):
            found.setdefault(closures[k].match.log, []).append(closures[k])
    return found


def _bent(T: Float, closures: list[LoopClosure], T_map_keyframe: Mapping[LogId, Float]) -> Float:
    closures = sorted(closures, key=lambda closure: closure.match.index)
    indices = np.array([closure.match.index for closure in closures])
    worlds = np.array([T_map_keyframe[c.query.log][0] @ c.T_query_match_unscaled for c in closures])
    source, target = T[indices][:, :3, 3], worlds[:, :3, 3]
    sigma_m = float(
        np.median([np.sqrt(np.trace(c.covariance[3:, 3:]) / 3.0) for c in closures if c.covariance is not None])
    )
    centres, motions = [], []
    before = np.eye(4)
    for window in _windows(target, sigma_m):
        before = _motion(source[window], target[window], before)
        centres.append(float(indices[window].mean()))
        motions.append(before)
    return np.array([_blended(k, T[k], np.array(centres), motions) for k in range(len(T))])


def _windows(points: Float, sigma_m: float) -> Iterator[slice]:
    """Overlapping windows of fixes, each half a window on."""
    first = 0
    while True:
        end = min(first + WINDOW_FIXES, len(points))
        while end < len(points) and np.ptp(points[first:end], axis=0).max() < WINDOW_SIGMAS * sigma_m:
            end += 1
        if end == len(points):
            yield slice(max(0, min(first, end - FIXES_MIN)), end)
            return
        yield slice(first, end)
        first += (end - first) // 2


def _motion(source: Float, target: Float, before: Float) -> Float:
    """The rigid motion (4, 4) that moves most of a window's points onto their fixes."""
    agreeing = np.ones(len(source), dtype=bool)
    T = before
    for _ in range(ROUNDS):
        middle = source[agreeing].mean(axis=0)
        arm_m = HOLDING_RATIO * max(float(np.ptp(source[agreeing], axis=0).max()), 1e-3)
        arms = arm_m * np.concatenate([np.eye(3), -np.eye(3)])
        held = target[agreeing].mean(axis=0) + arms @ before[:3, :3].T
        _, T = umeyama(np.concatenate([source[agreeing], middle + arms]), np.concatenate([target[agreeing], held]))
        off_m = np.linalg.norm(source @ T[:3, :3].T + T[:3, 3] - target, axis=1)
        agreeing = off_m <= max(DISAGREEING_RATIO * float(np.median(off_m)), 1e-6)
    return T


def _blended(k: int, T: Float, centres: Float, motions: list[Float]) -> Float:
    """Keyframe k moved by the windows before and after it, the nearer one more."""
    after = int(np.searchsorted(centres, k))
    if after in (0, len(centres)):
        return np.asarray(motions[min(after, len(centres) - 1)] @ T)
    share = (k - centres[after - 1]) / (centres[after] - centres[after - 1])
    a, b = motions[after - 1] @ T, motions[after] @ T
    turn = pose(a[:3, :3].T @ b[:3, :3], np.zeros(3))
    R = a[:3, :3] @ se3_exp(share * se3_log(turn))[:3, :3]
    return pose(R, (1.0 - share) * a[:3, 3] + share * b[:3, 3])
