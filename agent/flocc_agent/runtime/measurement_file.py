"""`measurements.jsonl` beside a recording: what its robot measured besides odometry and images, docs/measurements.md.

Rules: a line is a JSON object with `stamp_s`, `kind` and the kind's fields. What was seen belongs to the frame of its
stamp, which becomes a keyframe. Positions (`fix`, `gnss`) come often: each keyframe between two of them gets one that
is interpolated. A line that cannot be used is named, and nothing is played.
"""

import json
import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.geodesy import Place, direction_of, up_at
from flocc_agent.core.measurement_text import measurement_of
from flocc_agent.core.measurements import (
    BadMeasurement,
    Fix,
    GeodeticFix,
    Measurement,
    MetricClosure,
    OdometryCovariance,
    StartPose,
)
from flocc_agent.runtime.text_tables import RecordingError
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

NAME = "measurements.jsonl"
APART_MAX_S = 0.05
"""A measurement belongs to a frame that is this close."""
GAP_MAX_S = 2.0
"""Positions farther apart in time are not interpolated."""
LINES_MAX = 1_000_000
STAMP_MAX_S = 1e12
"""A stamp beyond this is none that a keyframe could have."""

_NOBODY = KeyframeId(LogId("nobody"), 0)


@dataclass(frozen=True, slots=True, eq=False)
class Stamped:
    """One measurement of a file.

    Attributes:
        stamp_s: When, on the clock of the images.
        measurement: It; a closure with an earlier frame has no keyframe yet.
        match_stamp_s: Of the other frame of such a closure.
    """

    stamp_s: float
    measurement: Measurement
    match_stamp_s: float | None = None

    def made(self, keyframe_at: Callable[[float], KeyframeId]) -> Measurement:
        """The measurement, given the own keyframe of a stamp."""
        if self.match_stamp_s is None or not isinstance(self.measurement, MetricClosure):
            return self.measurement
        return replace(self.measurement, match=keyframe_at(self.match_stamp_s))


@dataclass(frozen=True, slots=True, eq=False)
class RecordedMeasurements:
    """All measurements of a recording, by the stamps of its frames.

    Attributes:
        seen: What was seen at a frame.
        kept: Stamps of the frames that become keyframes.
        positions: Positions in order of time, of each kind.
    """

    seen: Mapping[float, tuple[Stamped, ...]]
    kept: frozenset[float]
    positions: tuple[tuple[Stamped, ...], ...] = ()

    def keeps(self, stamp_s: float) -> bool:
        """Whether a frame becomes a keyframe for what was seen there."""
        return stamp_s in self.kept

    def at(self, stamp_s: float) -> tuple[Stamped, ...]:
        """What belongs to a frame that is a keyframe."""
        fixes = [position_at(positions, stamp_s) for positions in self.positions]
        return (*self.seen.get(stamp_s, ()), *(fix for fix in fixes if fix is not None))

    def with_steps(self, steps: Mapping[float, OdometryCovariance]) -> "RecordedMeasurements":
        """The same with how exact odometry is up to these frames, where the recording does not say so itself."""
        seen = dict(self.seen)
        for stamp_s, step in steps.items():
            if not any(isinstance(each.measurement, OdometryCovariance) for each in seen.get(stamp_s, ())):
                seen[stamp_s] = (*seen.get(stamp_s, ()), Stamped(stamp_s, step))
        return replace(self, seen=seen, kept=self.kept | steps.keys())


NOTHING = RecordedMeasurements({}, frozenset())


def read_measurements(path: Path, frames_s: Sequence[float]) -> RecordedMeasurements:
    """Read a recording's measurements; none where there is no such file.

    Args:
        path: `measurements.jsonl`.
        frames_s: Stamps of the recording's frames, in order.

    Raises:
        RecordingError: A line is no measurement, or belongs to no frame; file and line are named.
    """
    if not path.exists():
        return NOTHING
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    if len(lines) > LINES_MAX:
        raise RecordingError(f"{path}: has more than {LINES_MAX} lines")
    stamped = [(n, _read_line(line, f"{path}:{n}")) for n, line in enumerate(lines, start=1) if line.strip()]
    return _placed(stamped, path, frames_s)


def rows_of(rows: Sequence[Mapping[str, Any]], frames_s: Sequence[float], where: str) -> RecordedMeasurements:
    """The same of rows that no file holds.

    Raises:
        RecordingError: As for a file.
    """
    return _placed([(n, _stamped(dict(row), f"{where}:{n}")) for n, row in enumerate(rows, 1)], Path(where), frames_s)


def position_at(positions: Sequence[Stamped], stamp_s: float) -> Stamped | None:
    """A position at a stamp: the one there, or between two that are close enough in time."""
    after = bisect_left(positions, stamp_s, key=lambda position: position.stamp_s)
    near = [p for p in positions[max(after - 1, 0) : after + 1] if abs(p.stamp_s - stamp_s) <= 1e-3]
    if near:
        return near[0]
    if not 0 < after < len(positions):
        return None
    a, b = positions[after - 1], positions[after]
    if b.stamp_s - a.stamp_s > GAP_MAX_S:
        return None
    share = (stamp_s - a.stamp_s) / (b.stamp_s - a.stamp_s)
    return Stamped(stamp_s, _between(a.measurement, b.measurement, share))


def _between(a: Measurement, b: Measurement, share: float) -> Measurement:
    """A position on the straight line between two, as uncertain as they are."""
    if isinstance(a, Fix) and isinstance(b, Fix):
        covariance = (1 - share) * np.asarray(a.covariance_m2) + share * np.asarray(b.covariance_m2)
        return Fix((1 - share) * np.asarray(a.position_m) + share * np.asarray(b.position_m), covariance)
    assert isinstance(a, GeodeticFix)
    assert isinstance(b, GeodeticFix)
    covariance = (1 - share) * np.asarray(a.covariance_m2) + share * np.asarray(b.covariance_m2)
    latitude_deg, longitude_deg = direction_of((1 - share) * _up(a) + share * _up(b))
    altitude_m = (1 - share) * a.altitude_m + share * b.altitude_m
    return GeodeticFix(latitude_deg, longitude_deg, altitude_m, covariance)


def _up(fix: GeodeticFix) -> Float:
    return up_at(Place(fix.latitude_deg, fix.longitude_deg, fix.altitude_m))


def _read_line(line: str, where: str) -> Stamped:
    try:
        row = json.loads(line)
    except RecursionError as error:
        raise RecordingError(f"{where}: is nested too deeply") from error
    except ValueError as error:
        raise RecordingError(f"{where}: is cut off or not JSON: {error}") from error
    if not isinstance(row, dict):
        raise RecordingError(f"{where}: must be an object with stamp_s and kind")
    return _stamped(row, where)


def _stamped(row: dict[str, Any], where: str) -> Stamped:
    kind, stamp_s, match_s = row.pop("kind", None), row.pop("stamp_s", None), row.pop("match_stamp_s", None)
    for name, value in (("stamp_s", stamp_s), ("match_stamp_s", match_s)):
        if value is None and name == "match_stamp_s":
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= STAMP_MAX_S:
            raise RecordingError(f"{where}: {name} must be a number of seconds, not {value!r}")
    if not isinstance(kind, str):
        raise RecordingError(f"{where}: kind must be the name of a kind, not {kind!r}")
    if kind == MetricClosure.kind and match_s is not None:
        if "match" in row:
            raise RecordingError(f"{where}: closure has match or match_stamp_s, not both")
        row["match"] = str(_NOBODY)
    elif match_s is not None:
        raise RecordingError(f"{where}: {kind} has no match_stamp_s")
    try:
        return Stamped(float(stamp_s), measurement_of(kind, row), None if match_s is None else float(match_s))
    except BadMeasurement as error:
        raise RecordingError(f"{where}: {error}") from error


def _placed(stamped: Sequence[tuple[int, Stamped]], path: Path, frames_s: Sequence[float]) -> RecordedMeasurements:
    """Put what was seen to its frames, and positions in order."""
    positions: dict[type[Measurement], list[Stamped]] = {}
    seen: dict[float, list[Stamped]] = {}
    kept: set[float] = set()
    for number, one in stamped:
        if isinstance(one.measurement, GeodeticFix) or _is_position(one.measurement):
            positions.setdefault(type(one.measurement), []).append(one)
            continue
        frame_s = _frame_at(one.stamp_s, frames_s, f"{path}:{number}")
        kept.add(frame_s)
        if isinstance(one.measurement, StartPose) and frame_s != frames_s[0]:
            raise RecordingError(f"{path}:{number}: start is of the first frame, at {frames_s[0]} s")
        if one.match_stamp_s is not None:
            match_s = _frame_at(one.match_stamp_s, frames_s, f"{path}:{number}")
            if match_s >= frame_s:
                raise RecordingError(f"{path}:{number}: match_stamp_s must be of an earlier frame")
            kept.add(match_s)
            one = replace(one, match_stamp_s=match_s)
        seen.setdefault(frame_s, []).append(one)
    ordered = tuple(tuple(sorted(found, key=lambda p: p.stamp_s)) for found in positions.values())
    return RecordedMeasurements({s: tuple(found) for s, found in seen.items()}, frozenset(kept), ordered)


def _is_position(measurement: Measurement) -> bool:
    return isinstance(measurement, Fix) and measurement.R_world_body is None


def _frame_at(stamp_s: float, frames_s: Sequence[float], where: str) -> float:
    at = bisect_left(frames_s, stamp_s)
    near = min(frames_s[max(at - 1, 0) : at + 1], key=lambda frame_s: abs(frame_s - stamp_s), default=math.inf)
    if abs(near - stamp_s) > APART_MAX_S:
        raise RecordingError(f"{where}: no frame lies within {APART_MAX_S:g} s of {stamp_s} s")
    return near
