"""Robots whose place in the map rests on one place that looks like another one.

Houses repeat. Closures of two places that look alike agree with each other as right ones do, so that no solver tells
them from right ones where nothing else joins the two ways. What tells is a closure beside them that says otherwise: a
keyframe that was registered with two of one robot which odometry puts far apart shows a place that is not the only one
of its kind. And a map that is right puts robots where their pictures agree: where most keyframes that it puts side by
side, looking the same way, were never registered with each other, it may be wrong. Where a robot's used closures are
all of one place, and either holds, nobody knows where it is.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.second_places import BESIDE_RAD, BESIDE_STEPS, DRIFT_RATIO, PLACE_KEYFRAMES, SEEN_TWICE
from flocc_agent.core.spared import STRETCH
from flocc_agent.geometry import pose_from_tq
from flocc_launch.runs.closure_table import Pair
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]

BESIDE_MIN = 10
"""Fewer keyframes side by side say nothing."""
NEIGHBOURS = 2
"""A closure of a keyframe so many before or after counts for one."""
AGREEING_RATIO_MIN = 0.5
"""Of keyframes side by side that have a closure. Right maps of two drawn towns, the demo's and herz_jesu: 0.85 to 1."""
LOOKED_AT_MAX = 500


@dataclass(frozen=True, slots=True)
class AlikePlaces:
    """A robot that hangs on its map by one place, and what shows that this place may not be the only one of its kind.

    Attributes:
        robot: Its name.
        map_frame: Of its map.
        first: Its first keyframe with a used closure.
        last: The last one.
        why: What shows it, as a clause.
    """

    robot: str
    map_frame: str
    first: KeyframeId
    last: KeyframeId
    why: str

    @property
    def headline(self) -> str:
        """What is to be said first of the map."""
        place = f"({self.first} to {self.last})" if self.first != self.last else f"({self.first})"
        return (
            f"{self.robot} hangs on {self.map_frame} by one place only {place}, and places may look alike here: "
            f"{self.why}. Do not believe where {self.robot} is."
        )


ADVICE = "Let it meet the others at other places, where they look different, too."


def alike_places(loaded: LoadedRun) -> list[AlikePlaces]:
    """Every such robot that is in another one's map, by name."""
    found = (_of_robot(loaded, robot) for robot in sorted(loaded.tracks))
    return [alike for alike in found if alike is not None]


def _of_robot(loaded: LoadedRun, robot: str) -> AlikePlaces | None:
    frame = loaded.tracks[robot].map_frame
    others = {name for name, track in loaded.tracks.items() if track.map_frame == frame} - {robot}
    own = [pair for pair in loaded.pairs if pair.accepted and pair.inter_robot and robot in _robots(pair)]
    ties = [_end(pair, robot) for pair in own if pair.used and _robots(pair) - {robot} <= others]
    if frame is None or frame == f"map/{robot}" or not ties or max(ties).index - min(ties).index > PLACE_KEYFRAMES:
        return None
    first, last = min(ties), max(ties)
    of_place = [pair for pair in own if first.index <= _end(pair, robot).index <= last.index or pair.used]
    refused = [pair for pair in own if pair.used is False]
    for one, other in product(of_place, refused):
        for seen, here, there, apart_m in _contradictions(loaded, one, other):
            why = f"{seen} was registered with {here} and with {there}, which odometry puts {apart_m:.0f} m apart"
            return AlikePlaces(robot, frame, first, last, why)
    beside, agreeing = _side_by_side(loaded, robot, others, own)
    if beside < BESIDE_MIN or agreeing >= AGREEING_RATIO_MIN * beside:
        return None
    why = f"of {beside} of its keyframes that the map puts beside others', {beside - agreeing} match none of them"
    return AlikePlaces(robot, frame, first, last, why)


def _side_by_side(loaded: LoadedRun, robot: str, others: Collection[str], own: Sequence[Pair]) -> tuple[int, int]:
    """Keyframes of a robot that the map puts beside one of another, looking the same way; and those with a closure."""
    T_map_camera = {name: _cameras(loaded, name) for name in (robot, *others)}
    track = loaded.tracks[robot]
    step_m = track.path_length_m() / max(len(track) - 1, 1)
    closed = [(_end(pair, robot).index, _end(pair, (_robots(pair) - {robot}).pop())) for pair in own]
    beside = agreeing = 0
    for index in range(0, len(track), 1 + len(track) // LOOKED_AT_MAX):
        near = {name: _near(T_map_camera[robot][index], T_map_camera[name], step_m) for name in others}
        if any(len(indices) for indices in near.values()):
            beside += 1
            agreeing += any(
                abs(at - index) <= NEIGHBOURS
                and far.log.robot in near
                and bool(np.any(np.abs(near[far.log.robot] - far.index) <= NEIGHBOURS))
                for at, far in closed
            )
    return beside, agreeing


def _cameras(loaded: LoadedRun, robot: str) -> Float:
    """`T_map_camera` (N, 4, 4) of a robot's keyframes; NaN where there is none."""
    result = loaded.results.get(robot)
    T_body_camera = None if result is None else result.T_body_camera
    T_map_body = loaded.tracks[robot].T_map_body
    return T_map_body if T_body_camera is None else T_map_body @ pose_from_tq(np.array(T_body_camera))


def _near(T_map_camera: Float, others: Float, step_m: float) -> NDArray[np.intp]:
    """Which cameras (N, 4, 4) are beside one (4, 4) and look the same way."""
    apart_m = np.linalg.norm(others[:, :3, 3] - T_map_camera[:3, 3], axis=1)
    cosines = others[:, :3, 2] @ T_map_camera[:3, 2]
    return np.flatnonzero((apart_m <= BESIDE_STEPS * step_m) & (cosines >= np.cos(BESIDE_RAD)))


def _contradictions(
    loaded: LoadedRun, one: Pair, other: Pair
) -> Iterator[tuple[KeyframeId, KeyframeId, KeyframeId, float]]:
    """Two closures of the same robots that see one place at one end and, by odometry, two at the other."""
    if _robots(one) != _robots(other):
        return
    for robot in sorted(_robots(one)):
        near, also = _end(one, robot), _end(other, robot)
        (far_robot,) = _robots(one) - {robot}
        here, there = _end(one, far_robot), _end(other, far_robot)
        reach_m = _length_m(loaded, one), _length_m(loaded, other)
        if abs(near.index - also.index) > STRETCH or reach_m[0] is None or reach_m[1] is None:
            continue
        apart_m, way_m = _apart_and_way_m(loaded, here, there)
        allowed_m = reach_m[0] + reach_m[1] + _apart_and_way_m(loaded, near, also)[1]
        if apart_m > SEEN_TWICE * allowed_m + DRIFT_RATIO * way_m:
            yield near, here, there, apart_m


def _apart_and_way_m(loaded: LoadedRun, one: KeyframeId, other: KeyframeId) -> tuple[float, float]:
    """How far apart odometry puts two keyframes of a robot, and how long its way between them is."""
    first, last = sorted((one.index, other.index))
    positions_m = loaded.tracks[one.log.robot].T_odom_body[first : last + 1, :3, 3]
    if not len(positions_m):
        return 0.0, 0.0
    way_m = float(np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum())
    return float(np.linalg.norm(positions_m[-1] - positions_m[0])), way_m


def _length_m(loaded: LoadedRun, pair: Pair) -> float | None:
    """How far apart a closure's cameras are by its first scale; None where it has none."""
    ends = {str(pair.query), str(pair.match)}
    for result in loaded.results.values():
        for closure in result.closures:
            if {closure.query, closure.match} == ends and closure.T_query_match_unscaled is not None:
                t = np.array(closure.T_query_match_unscaled[:3])
                return None if closure.scale_initial is None else closure.scale_initial * float(np.linalg.norm(t))
    return None


def _robots(pair: Pair) -> set[str]:
    return {pair.query.log.robot, pair.match.log.robot}


def _end(pair: Pair, robot: str) -> KeyframeId:
    return pair.query if pair.query.log.robot == robot else pair.match
