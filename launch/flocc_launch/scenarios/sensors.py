"""Simulated sensors: what robots would measure on their true ways, as rows of `measurements.jsonl`."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.geodesy import Place, T_earth_enu, place_of
from flocc_agent.geometry import inverse, pose, se3_exp, tq_from_pose
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.scenarios.scenario import SensorsScenario

Float = NDArray[np.float64]
Row = dict[str, Any]

WRONG_M = (2.0, 6.0)
"""How far a wrong sighting is off."""


def sense(sensors: SensorsScenario, truths: Mapping[str, Trajectory]) -> dict[str, list[Row]]:
    """What each robot measures, in order of time.

    Args:
        sensors: What they carry.
        truths: `T_world_body` at each robot's frames, all of one clock.
    """
    rows: dict[str, list[Row]] = {}
    for number, (name, truth) in enumerate(sorted(truths.items())):
        rng = np.random.default_rng([sensors.seed, number])
        found = [*_own(sensors, name, truth, rng), *_tags(sensors, truth, rng), *_robots(sensors, name, truths, rng)]
        rows[name] = sorted(found, key=lambda row: float(row["stamp_s"]))
    return rows


def _own(sensors: SensorsScenario, name: str, truth: Trajectory, rng: np.random.Generator) -> Iterator[Row]:
    """Start, positions, odometry and closures of one robot with itself."""
    stamps_s, poses = truth.stamps_s, truth.T_fixed_body
    if name in sensors.start_robots:
        T = poses[0] @ se3_exp(_noise(sensors, rng))
        yield _row(stamps_s[0], "start", T_world_body=_tq(T), covariance=_variances(sensors))
    variances = [sensors.position_sigma_m**2] * 3
    for stamp_s, T in zip(stamps_s, poses, strict=True):
        position = T[:3, 3] + sensors.position_sigma_m * rng.normal(size=3)
        if name in sensors.fix_robots:
            yield _row(stamp_s, "fix", position_m=position.tolist(), covariance_m2=variances)
        if name in sensors.gnss_robots:
            latitude, longitude, altitude = place_at(Place(*sensors.gnss_origin), position)
            place = {"latitude_deg": latitude, "longitude_deg": longitude, "altitude_m": altitude}
            yield _row(stamp_s, "gnss", **place, covariance_m2=variances)
    for k in _every(stamps_s, sensors.odometry_every_s):
        if k > 0:
            yield _row(stamps_s[k], "odometry", covariance=_variances(sensors))
    for before, k in pairwise(_every(stamps_s, sensors.closure_every_s)):
        T = inverse(poses[k]) @ poses[before] @ se3_exp(_noise(sensors, rng))
        closure = {"match_stamp_s": float(stamps_s[before]), "T_query_match": _tq(T)}
        yield _row(stamps_s[k], "closure", **closure, covariance=_variances(sensors))


def _tags(sensors: SensorsScenario, truth: Trajectory, rng: np.random.Generator) -> Iterator[Row]:
    """Tags in range; a wrong sighting is of somewhere metres away."""
    for tag, place_m in sorted(sensors.tags.items()):
        T_world_tag = pose(np.eye(3), np.array(place_m))
        away_m = np.linalg.norm(truth.T_fixed_body[:, :3, 3] - T_world_tag[:3, 3], axis=1)
        for k in _every(truth.stamps_s, sensors.sighting_every_s, away_m <= sensors.tag_range_m):
            T = inverse(truth.T_fixed_body[k]) @ T_world_tag @ se3_exp(_noise(sensors, rng))
            if rng.random() < sensors.tag_wrong_ratio:
                T[:2, 3] += rng.uniform(*WRONG_M) * _direction(rng)
            yield _row(truth.stamps_s[k], "tag", tag=tag, T_body_tag=_tq(T), covariance=_variances(sensors))


def _robots(
    sensors: SensorsScenario, name: str, truths: Mapping[str, Trajectory], rng: np.random.Generator
) -> Iterator[Row]:
    """Other robots in range, with their pose or by bearing and range."""
    truth = truths[name]
    for other in sorted(set(truths) - {name}):
        there = [truths[other].at(float(stamp_s)) for stamp_s in truth.stamps_s]
        away_m = np.array(
            [
                np.inf if T is None else np.linalg.norm(T[:3, 3] - own[:3, 3])
                for T, own in zip(there, truth.T_fixed_body, strict=True)
            ]
        )
        for range_m, row_of in ((sensors.robot_range_m, _sighting), (sensors.bearing_range_m, _bearing)):
            near = away_m <= (range_m or 0.0)
            for k in _every(truth.stamps_s, sensors.sighting_every_s, near & (away_m > 0.1)):
                seen = there[k]
                assert seen is not None
                T = inverse(truth.T_fixed_body[k]) @ seen @ se3_exp(_noise(sensors, rng))
                yield row_of(float(truth.stamps_s[k]), other, T, sensors)


def _sighting(stamp_s: float, robot: str, T: Float, sensors: SensorsScenario) -> Row:
    return _row(stamp_s, "robot", robot=robot, T_body_robot=_tq(T), covariance=_variances(sensors))


def _bearing(stamp_s: float, robot: str, T: Float, sensors: SensorsScenario) -> Row:
    range_m = float(np.linalg.norm(T[:3, 3]))
    sigmas = {"bearing_sigma_rad": sensors.translation_sigma_m / range_m, "range_sigma_m": sensors.translation_sigma_m}
    return _row(stamp_s, "bearing", robot=robot, bearing=(T[:3, 3] / range_m).tolist(), range_m=range_m, **sigmas)


def place_at(origin: Place, enu_m: Float) -> Place:
    """The place of a point (3,) given east, north and up of an origin."""
    T_earth_origin = T_earth_enu(origin)
    return place_of(T_earth_origin[:3, :3] @ enu_m + T_earth_origin[:3, 3])


def _every(stamps_s: Float, pause_s: float | None, where: NDArray[np.bool_] | None = None) -> list[int]:
    """Frames at least so far apart in time, of those where something is so; none without a pause."""
    chosen: list[int] = []
    for k in range(len(stamps_s)) if pause_s is not None else ():
        if (where is None or where[k]) and (not chosen or stamps_s[k] - stamps_s[chosen[-1]] >= pause_s):
            chosen.append(k)
    return chosen


def _noise(sensors: SensorsScenario, rng: np.random.Generator) -> Float:
    return np.asarray(rng.normal(size=6) * np.sqrt(_variances(sensors)))


def _variances(sensors: SensorsScenario) -> list[float]:
    return [sensors.rotation_sigma_rad**2] * 3 + [sensors.translation_sigma_m**2] * 3


def _direction(rng: np.random.Generator) -> Float:
    angle_rad = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle_rad), np.sin(angle_rad)])


def _tq(T: Float) -> list[float]:
    return [float(value) for value in tq_from_pose(T)]


def _row(stamp_s: float, kind: str, **fields: Any) -> Row:
    return {"stamp_s": float(stamp_s), "kind": kind, **fields}
