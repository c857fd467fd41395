"""The pose graph of a run as a g2o file: corrected poses, odometry edges, accepted closures.

Vertices are body poses in their map frame, quaternions x y z w. Robot number k, in the order of names, has the
vertices from `k * ROBOT_STRIDE` on; comments name them. A closure whose metric scale nobody knows is left out and
named in a comment.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import BackendConfig
from flocc_agent.core.registration import closure_probability
from flocc_agent.geometry import between, inverse, pose_from_tq
from flocc_agent.runtime.robot_result import ClosureKnown
from flocc_launch.graph_files.g2o import edge_line, vertex_line
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

ROBOT_STRIDE = 1_000_000


def write_pose_graph(path: Path, loaded: LoadedRun) -> None:
    """Write all keyframes that have a pose in a map frame, and the edges between them."""
    vertices = vertices_of(loaded)
    lines = ["# flocc pose graph: VERTEX_SE3:QUAT is T_map_body, EDGE_SE3:QUAT the pose of the second in the first"]
    for k, robot in enumerate(sorted(loaded.results)):
        track = loaded.tracks[robot]
        lines.append(f"# robot {robot}: vertices from {k * ROBOT_STRIDE}, frame {track.map_frame or 'none'}")
        for keyframe, vertex in vertices.items():
            if keyframe.log.robot == robot:
                lines.append(vertex_line(vertex, track.T_map_body[keyframe.index]))
    lines.extend(odometry_lines(loaded, vertices))
    lines.extend(closure_lines(loaded, vertices))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def vertices_of(loaded: LoadedRun) -> dict[KeyframeId, int]:
    """Vertex numbers of the keyframes that have a pose in a map frame; older incarnations have none."""
    vertices = {}
    for k, robot in enumerate(sorted(loaded.results)):
        log = LogId(robot, loaded.results[robot].incarnation)
        for i in np.flatnonzero(loaded.tracks[robot].corrected):
            vertices[KeyframeId(log, int(i))] = k * ROBOT_STRIDE + int(i)
    return vertices


def isotropic(sigma_m: float, sigma_rad: float) -> Float:
    """Information (6, 6), rotation first, of a measurement as sure in every direction."""
    return np.diag([1 / sigma_rad**2] * 3 + [1 / sigma_m**2] * 3)


def odometry_lines(loaded: LoadedRun, vertices: Mapping[KeyframeId, int]) -> Iterator[str]:
    """Edges between consecutive keyframes."""
    sigmas = BackendConfig()
    sigma_m, sigma_rad = sigmas.odometry_translation_sigma_m, sigmas.odometry_rotation_sigma_rad
    for first, vertex in vertices.items():
        second = KeyframeId(first.log, first.index + 1)
        if second in vertices:
            T_odom_body = loaded.tracks[first.log.robot].T_odom_body
            T = between(T_odom_body[first.index], T_odom_body[second.index])
            yield edge_line(vertex, vertices[second], T, isotropic(sigma_m, sigma_rad))


def closure_lines(loaded: LoadedRun, vertices: Mapping[KeyframeId, int]) -> Iterator[str]:
    """Edges of the closures that any robot knows, each pair once, weighted by Eq. (2)."""
    known: dict[tuple[str, str], ClosureKnown] = {}
    for robot in sorted(loaded.results):
        for closure in loaded.results[robot].closures:
            before = known.get((closure.query, closure.match))
            if before is None or before.scale is None:
                known[closure.query, closure.match] = closure
    for key in sorted(known):
        yield closure_line(known[key], loaded, vertices)


def closure_line(closure: ClosureKnown, loaded: LoadedRun, vertices: Mapping[KeyframeId, int]) -> str:
    """The edge of one closure, or a comment that says why there is none."""
    query, match = KeyframeId.parse(closure.query), KeyframeId.parse(closure.match)
    first, second = vertices.get(query), vertices.get(match)
    if first is None or second is None:
        return f"# closure {query} {match}: a keyframe has no pose in a map frame"
    T = metric_body_pose(closure, loaded)
    if T is None:
        return f"# closure {query} {match}: its metric scale is not known"
    sigmas = BackendConfig()
    ratio = 1.0 if closure.match_ratio is None else closure.match_ratio
    information = isotropic(sigmas.closure_translation_sigma_m, sigmas.closure_rotation_sigma_rad)
    return edge_line(first, second, T, closure_probability(ratio, sigmas.steepness) * information)


def metric_body_pose(closure: ClosureKnown, loaded: LoadedRun) -> Float | None:
    """Pose of the match body in the query body, metres, or None where the scale is not known."""
    scale = 1.0 if closure.metric else closure.scale if closure.scale is not None else closure.scale_initial
    if closure.T_query_match_unscaled is None or scale is None:
        return None
    T_camera_camera = pose_from_tq(np.array(closure.T_query_match_unscaled))
    T_camera_camera[:3, 3] *= scale
    T_query_camera, T_match_camera = (extrinsics(loaded, key) for key in (closure.query, closure.match))
    return np.asarray(T_query_camera @ T_camera_camera @ inverse(T_match_camera))


def extrinsics(loaded: LoadedRun, keyframe: str) -> Float:
    """`T_body_camera` of a keyframe's robot; the body is the camera where its result says nothing else."""
    result = loaded.results.get(KeyframeId.parse(keyframe).log.robot)
    known = None if result is None else result.T_body_camera
    return np.eye(4) if known is None else pose_from_tq(np.array(known))
