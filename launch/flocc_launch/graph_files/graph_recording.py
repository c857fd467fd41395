"""A pose graph from a file as recordings that agents play: recorded odometry, and closures to be looked up.

Every keyframe becomes a frame whose picture holds its name; closures become the file that `recorded` perception reads.
So the whole runtime runs on a benchmark that has no images.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flocc_agent.core.pose_graph import LoopClosure
from flocc_agent.geometry import tq_from_pose, upper_triangle
from flocc_agent.perception.recorded import FORMAT, name_image
from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.writer import RecordingWriter
from flocc_launch.graph_files.graph_file import GraphFile, GraphFileError

REGISTRATIONS = "registrations.json"
OWN_GAP_KEYFRAMES = 2
SCENARIO = """name = "graph"
rate = {rate}

{robots}
[keyframes]
distance_m = 0.01

[perception]
method = "recorded"

[perception.recorded]
file = "{registrations}"
scale = "{scale}"

[core.place_recognition]
similarity_threshold = 0.01
best_matches = 16
own_gap_keyframes = {gap}

[backend]
formulation = "{formulation}"
weight_by_probability = false
odometry_rotation_sigma_rad = {rotation_rad}
odometry_translation_sigma_m = {translation_m}
"""
STEP_S = 1.0
"""Time between keyframes where the file has no times."""


@dataclass(frozen=True, slots=True)
class GraphRecordings:
    """Where a graph's recordings are.

    Attributes:
        robots: Folder of each robot's recording.
        registrations: The file for `perception.recorded.file`.
    """

    robots: dict[str, Path]
    registrations: Path


def write_recordings(file: GraphFile, out: Path, source: str) -> GraphRecordings:
    """Write a recording per robot and the file of registrations; what is there already is taken up.

    Args:
        file: The graph; agents look for closures within a robot where `own_gap_keyframes` says so.
        out: Folder; made where it is missing.
        source: What the recordings are of, one line.

    Raises:
        GraphFileError: The file has no whole ground truth of some robot, or times that do not increase.
    """
    _require_playable(file, source)
    robots = {
        log.robot: _write_robot(file, log.robot, out / log.robot, source) for log in sorted(file.graph.trajectories)
    }
    names = [f"{log.robot}/{k}" for log, t in sorted(file.graph.trajectories.items()) for k in range(len(t))]
    registrations = out / REGISTRATIONS
    entries = {"format": FORMAT, "keyframes": names, "pairs": [_entry(c) for c in _once(file.graph.closures)]}
    registrations.write_text(json.dumps(entries), encoding="utf-8")
    return GraphRecordings(robots, registrations)


def _require_playable(file: GraphFile, source: str) -> None:
    for log in sorted(file.graph.trajectories):
        if log not in file.T_truth:
            raise GraphFileError(f"{source}: has no ground truth of robot {log}")
        if log in file.stamps_s and np.any(np.diff(file.stamps_s[log]) <= 0):
            raise GraphFileError(f"{source}: the times of robot {log} do not increase")


def odometry_sigmas(file: GraphFile) -> tuple[float, float]:
    """The file's odometry noise as a configuration has it, rad and metres: medians of the isotropic deviations."""
    covariances = [t.edge_covariances for t in file.graph.trajectories.values() if t.edge_covariances is not None]
    S = np.concatenate(covariances)
    rotation = np.sqrt(np.trace(S[:, :3, :3], axis1=1, axis2=2) / 3.0)
    translation = np.sqrt(np.trace(S[:, 3:, 3:], axis1=1, axis2=2) / 3.0)
    return float(np.median(rotation)), float(np.median(translation))


def write_scenario(file: GraphFile, out: Path, rate: float, keeps_scale: bool) -> Path:
    """Write `scenario.toml` beside the recordings, for `flocc launch` and `flocc simulate`."""
    rotation_rad, translation_m = odometry_sigmas(file)
    robots = [f'[robots.{log.robot}]\nrecording = "{log.robot}"\n' for log in sorted(file.graph.trajectories)]
    text = SCENARIO.format(
        rate=rate,
        robots="\n".join(robots),
        registrations=REGISTRATIONS,
        scale="kept" if keeps_scale else "removed",
        formulation="base" if keeps_scale else "independent",
        gap=OWN_GAP_KEYFRAMES,
        rotation_rad=rotation_rad,
        translation_m=translation_m,
    )
    path = out / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return path


def _write_robot(file: GraphFile, robot: str, path: Path, source: str) -> Path:
    import cv2

    log = next(log for log in file.graph.trajectories if log.robot == robot)
    T_odom = np.asarray(file.graph.trajectories[log].T_odom_keyframe)
    stamps_s = file.stamps_s.get(log, np.arange(len(T_odom), dtype=float) * STEP_S)
    with RecordingWriter(path, source) as writer:
        for k in range(writer.count, len(T_odom)):
            image = name_image(f"{robot}/{k}")
            _, png = cv2.imencode(".png", image.pixels[:, :, ::-1])
            writer.add(float(stamps_s[k]), png.tobytes(), ".png")
            if k == 0:
                writer.write_camera(image.camera, np.eye(4))
                writer.write_trajectories(Trajectory(stamps_s, T_odom), Trajectory(stamps_s, file.T_truth[log]))
    return path


def _once(closures: Sequence[LoopClosure]) -> list[LoopClosure]:
    """Of several closures of one pair the first: a pair is registered once."""
    found: dict[frozenset[object], LoopClosure] = {}
    for closure in closures:
        found.setdefault(frozenset((closure.query, closure.match)), closure)
    return list(found.values())


def _entry(closure: LoopClosure) -> dict[str, object]:
    covariance = closure.covariance
    return {
        "query": f"{closure.query.log.robot}/{closure.query.index}",
        "match": f"{closure.match.log.robot}/{closure.match.index}",
        "T_query_match": [float(v) for v in tq_from_pose(closure.T_query_match_unscaled)],
        "covariance": None if covariance is None else upper_triangle(covariance).numpy().tolist(),
    }
