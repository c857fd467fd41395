"""The ways that robots of the family drive: walks in a common square, the same way back, parallel lines."""

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import pose, so3_exp
from flocc_lab.graph_family.family_spec import Spec

Float = NDArray[np.float64]

SPACING_M = 1.0
AREA_PER_KEYFRAME_M2 = 5.0
LINES_APART_M = 5.0
ASIDE_M = 1.5
CLIMB_M, TILT_RAD = 0.15, 0.04


def true_poses(rng: np.random.Generator, spec: Spec) -> list[Float]:
    """True poses (N, 4, 4) of every robot; x forward, z up, a metre between keyframes."""
    if spec.parallel:
        return [_line(n, k * LINES_APART_M) for k, n in enumerate(spec.keyframes)]
    side_m = float(np.sqrt(AREA_PER_KEYFRAME_M2 * sum(spec.keyframes)))
    ways: list[Float] = []
    for k, n in enumerate(spec.keyframes):
        back = spec.opposite and k % 2 == 1
        ways.append(_way_back(ways[-1], n) if back else _walk(rng, n, side_m, spec.planar))
    return ways


def _line(keyframes: int, aside_m: float) -> Float:
    T = np.tile(np.eye(4), (keyframes, 1, 1))
    T[:, 0, 3], T[:, 1, 3] = SPACING_M * np.arange(keyframes), aside_m
    return T


def _walk(rng: np.random.Generator, keyframes: int, side_m: float, planar: bool) -> Float:
    """A smooth walk in a square, turned back at its edge; out of the plane it climbs, rolls and pitches."""
    position = np.append(rng.uniform(-side_m / 3, side_m / 3, 2), 0.0)
    heading, turn, tilt = rng.uniform(-np.pi, np.pi), 0.0, np.zeros(2)
    T = np.empty((keyframes, 4, 4))
    for k in range(keyframes):
        turn = 0.9 * turn + rng.normal(0.0, 0.05)
        if np.max(np.abs(position[:2])) > side_m / 2.5:
            turn += 0.2 * float(np.sin(np.arctan2(-position[1], -position[0]) - heading))
        heading += float(np.clip(turn, -0.3, 0.3))
        tilt = 0.0 * tilt if planar else 0.9 * tilt + rng.normal(0.0, TILT_RAD, 2)
        climb_m = 0.0 if planar else rng.normal(0.0, CLIMB_M) - 0.01 * position[2]
        position = position + SPACING_M * np.array([np.cos(heading), np.sin(heading), climb_m])
        T[k] = pose(so3_exp(np.array([0.0, 0.0, heading])) @ so3_exp(np.append(tilt, 0.0)), position)
    return T


def _way_back(T: Float, keyframes: int) -> Float:
    """The end of another robot's way, driven back on the other side of the road, as often as it takes."""
    order = np.concatenate([np.arange(len(T))[::-1], np.arange(len(T))])
    order = np.resize(order, keyframes)
    forward = np.resize(np.repeat([False, True], len(T)), keyframes)
    turned = pose(so3_exp(np.array([0.0, 0.0, np.pi])), np.array([0.0, ASIDE_M, 0.0]))
    beside = pose(np.eye(3), np.array([0.0, -ASIDE_M, 0.0]))
    return np.asarray(T[order] @ np.where(forward[:, None, None], beside, turned))
