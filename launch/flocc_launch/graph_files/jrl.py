"""JRL files (JSON Robot Log, the format of COSMO-Bench): multi-robot pose graphs with ground truth and labels."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import PoseGraph
from flocc_agent.geometry import R_from_q_wxyz, pose
from flocc_launch.graph_files.graph_file import (
    INDEX_BITS,
    GraphFile,
    GraphFileError,
    Measurement,
    distinct,
    log_of,
    pose_graph,
)
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

BETWEEN = "BetweenFactorPose3"


def read_jrl(path: Path) -> GraphFile:
    """Read a .jrl file; priors are left out, because every robot starts in its own odometry frame.

    Raises:
        GraphFileError: The file is missing or damaged, or its measurements are not of SE(3).
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise GraphFileError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except json.JSONDecodeError as error:
        raise GraphFileError(f"{path}: is not JSON: {error}") from error
    except RecursionError as error:
        raise GraphFileError(f"{path}: is nested too deeply") from error
    try:
        return _graph_file(data, path)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise GraphFileError(f"{path}: is not a JRL file of SE(3) measurements: {error!r}") from error


def _graph_file(data: Mapping[str, Any], path: Path) -> GraphFile:
    measurements: list[Measurement] = []
    wrong: set[bytes] = set()
    for robot, entries in data["measurements"].items():
        labelled = {(int(e), int(m)) for e, m in data.get("outlier_factors", {}).get(robot, ())}
        for e, entry in enumerate(entries):
            for n, item in enumerate(entry["measurements"]):
                if item["type"] != BETWEEN:
                    continue
                m = _measurement(item)
                measurements.append(m)
                if (e, n) in labelled:
                    wrong.add(m.T_first_second.tobytes())
    if not measurements:
        raise GraphFileError(f"{path}: has no measurements of type {BETWEEN}")
    graph = pose_graph(distinct(measurements, add_up=False), str(path))
    outliers = frozenset(k for k, c in enumerate(graph.closures) if c.T_query_match_unscaled.tobytes() in wrong)
    T_truth = _values(data.get("groundtruth", {}), graph)
    truth = {log: T[:, :3, 3] for log, T in T_truth.items()}
    initial = _values(data.get("initialization", {}), graph)
    return GraphFile(graph, truth, initial, outliers, T_truth, _stamps(data["measurements"], graph))


def _stamps(measurements: Mapping[str, Any], graph: PoseGraph) -> dict[LogId, Float]:
    """Times of each robot's keyframes, seconds from the first: of the first entry that has each as its newest."""
    stamps: dict[LogId, list[int]] = {}
    for robot, entries in measurements.items():
        number = _number(robot)
        seen: dict[int, int] = {}
        for entry in entries:
            keys = [
                int(item[name]) for item in entry["measurements"] for name in ("key", "key1", "key2") if name in item
            ]
            own = [key for key in keys if key >> INDEX_BITS == number]
            if own and "stamp" in entry:
                seen.setdefault(max(own), int(entry["stamp"]))
        log = log_of(number << INDEX_BITS)
        if seen and len(seen) == len(graph.trajectories.get(log, ())):
            stamps[log] = [seen[key] for key in sorted(seen)]
    first = min((own[0] for own in stamps.values()), default=0)
    return {log: np.array([(stamp - first) * 1e-9 for stamp in own]) for log, own in stamps.items()}


def _measurement(item: Mapping[str, Any]) -> Measurement:
    """One between factor: quaternion w x y z, covariance row-major with rotation first."""
    covariance = np.array(item["covariance"], dtype=float).reshape(6, 6)
    return Measurement(int(item["key1"]), int(item["key2"]), _pose(item["measurement"]), covariance)


def _pose(value: Mapping[str, Any]) -> Float:
    return pose(R_from_q_wxyz(np.array(value["rotation"], dtype=float)), np.array(value["translation"], dtype=float))


def _values(by_robot: Mapping[str, Any], graph: PoseGraph) -> dict[LogId, Float]:
    """Poses of each robot's own keys; a robot also lists poses of others, which are left out."""
    out: dict[LogId, Float] = {}
    for robot, values in by_robot.items():
        # The format's page describes a mapping, COSMO-Bench's files hold lists of values with their keys.
        pairs = values.items() if isinstance(values, Mapping) else [(value["key"], value) for value in values]
        own = {int(key): value for key, value in pairs if int(key) >> INDEX_BITS == _number(robot)}
        log = log_of(_number(robot) << INDEX_BITS)
        if own and len(own) == len(graph.trajectories.get(log, ())):
            out[log] = np.array([_pose(own[key]) for key in sorted(own)])
    return out


def _number(robot: str) -> int:
    return int(robot) if robot.isdigit() and len(robot) > 1 else ord(robot)
