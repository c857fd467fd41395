"""Measurements of a robot that all disagree with the map, each for itself an outlier: what they have in common.

Whoever writes a quaternion in another order, or a pose the wrong way round, does so in every line. So where next to
nothing of what a robot measured of one kind is used, one sentence stands for all of it, and says what about it is right
nevertheless.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.measurements import WHOLE_POSES
from flocc_agent.core.pose_graph import ClosureState, Component, FactorResult
from flocc_agent.geometry import between
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

MISREAD_MIN = 3
"""Fewer may all be wrong by themselves."""
MISREAD_RATIO = 0.8
NEAR_RATIO, NEAR_M = 0.15, 0.3
"""A position is right within this part of its distance, and so much besides."""
TURNED_RAD = 0.3
"""Rotations that are off by more are not noise."""
NO_MORE = "agree with the rest of the map"
"""Which every such sentence has."""


def misread(results: Sequence[FactorResult], components: Sequence[Component]) -> dict[int, str]:
    """One sentence for each robot and kind of which next to nothing is used, by the number of each such result."""
    by_kind: dict[tuple[LogId, str], list[int]] = defaultdict(list)
    for k, result in enumerate(results):
        if result.factor.kind in WHOLE_POSES and result.factor.has_rotation:
            by_kind[result.factor.at.log, result.factor.kind].append(k)
    component_of = {log: component for component in components for log in component.logs}
    told: dict[int, str] = {}
    for (log, kind), every in sorted(by_kind.items()):
        refused = [k for k in every if results[k].state is not ClosureState.USED]
        if len(refused) >= max(MISREAD_MIN, MISREAD_RATIO * len(every)):
            what, field = WHOLE_POSES[kind]
            count = f"none of the {len(every)}" if len(refused) == len(every) else f"only {len(every) - len(refused)}"
            of_all = "" if len(refused) == len(every) else f" of the {len(every)}"
            common = _in_common([results[k] for k in refused], component_of, field)
            told |= dict.fromkeys(refused, f"{count}{of_all} {what} at {log} {NO_MORE}{common}")
    return told


def _in_common(refused: Sequence[FactorResult], component_of: Mapping[LogId, Component], field: str) -> str:
    """What is right about measurements that are refused, and what that hints at."""
    written = f"{field} is to be written x y z, then the quaternion w x y z, and not inverted"
    pairs = [(r.factor.T_query_match, T) for r in refused if (T := _solved(r, component_of)) is not None]
    if len(pairs) < MISREAD_MIN:
        return f": {written}"
    said, solved = (np.array(T) for T in zip(*pairs, strict=True))
    t_said, t_solved = said[:, :3, 3], solved[:, :3, 3]
    far_m, solved_m = np.linalg.norm(t_said, axis=1), np.linalg.norm(t_solved, axis=1)
    may_m = NEAR_RATIO * solved_m + NEAR_M
    cosine = 0.5 * (np.einsum("kij,kij->k", said[:, :3, :3], solved[:, :3, :3]) - 1.0)
    turned_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    if _mostly(np.linalg.norm(t_said - t_solved, axis=1) <= may_m) and float(np.median(turned_rad)) > TURNED_RAD:
        return f", though positions are right: look at the order of {field}'s quaternion (w x y z), and at its axes"
    if _mostly(np.abs(far_m - solved_m) <= may_m):
        return f", though distances are right: {field} may be inverted, or in the camera's axes instead of the body's"
    ratio = float(np.median(far_m / np.maximum(solved_m, NEAR_M)))
    if _mostly(np.linalg.norm(t_said - ratio * t_solved, axis=1) <= ratio * may_m):
        return f", and all have them {ratio:.2f} times as far: a size or a unit may be wrong"
    return f": {written}"


def _solved(result: FactorResult, component_of: Mapping[LogId, Component]) -> Float | None:
    """What the solution has in place of a measurement, where it knows both ends."""
    query, match = result.factor.query, result.factor.match
    component = component_of.get(query.log)
    if component is None or match.log not in component.logs:
        return None
    T = component.T_map_keyframe
    return np.asarray(between(T[query.log][query.index], T[match.log][match.index]))


def _mostly(holds: NDArray[np.bool_]) -> bool:
    return bool(np.mean(holds) >= MISREAD_RATIO)
