"""`flocc map export`: a map as files that other programs read."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure
from flocc_agent.geometry import inverse, pose7, pose_from_tq
from flocc_agent.runtime.map_folder import BadMap, MapFolder
from flocc_launch.graph_files.g2o import write_g2o
from flocc_launch.maps.gathering import stamps_s
from flocc_launch.maps.map_merging import perception_of
from flocc_launch.maps.map_points import Progress, points_of, recordings_of
from flocc_protocol.ids import LogId

Float = NDArray[np.float64]

COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (181, 80, 143), (201, 138, 0), (58, 155, 217), (107, 95, 199))
VERTEX = np.dtype([("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
PLY_HEADER = """ply
format binary_little_endian 1.0
comment {comment}
element vertex {count}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
end_header
"""
CAMERAS = "camera positions of a flocc map, normals along the optical axes, a colour for each log"
POINTS = "points that two keyframes of a closure of a flocc map see, without normals"


def export_map(opened: MapFolder, out: Path) -> list[Path]:
    """Write a trajectory (TUM) per log, the pose graph (g2o) and the camera poses (PLY).

    Trajectories are of the body where it is known how the camera sits on it, else of the camera.

    Raises:
        FloccError: The map is damaged, `out` is its own folder, or a file cannot be written.
    """
    if out.resolve() == opened.path.resolve():
        raise BadMap(f"{out}: is the map itself; its files go to another folder (--out)")
    try:
        out.mkdir(parents=True, exist_ok=True)
        poses = opened.poses()
        written = [_write_tum(out / f"{log}.tum", opened, log, T) for log, T in poses.items()]
        write_g2o(out / "map.g2o", poses, _closures(opened, poses))
        (out / "cameras.ply").write_bytes(_cameras(poses))
    except OSError as error:
        raise BadMap(f"{out}: cannot be written: {error.strerror or error}") from error
    return [*written, out / "map.g2o", out / "cameras.ply"]


def export_points(
    opened: MapFolder, out: Path, recordings: Sequence[Path], progress: Progress
) -> tuple[Path, int, int] | None:
    """Write a sparse cloud (PLY) beside them; its path, its points and the closures that gave them.

    None where the front end that made the map cannot tell what it matched.

    Raises:
        FloccError: The map is damaged or does not say what made it, or the file cannot be written.
    """
    poses = opened.poses()
    colour_of = {log: COLOURS[number % len(COLOURS)] for number, log in enumerate(poses)}
    points = points_of(opened, perception_of(opened), recordings_of(opened, recordings), colour_of, progress)
    if points is None:
        return None
    vertices = np.zeros(len(points.at_m), dtype=VERTEX)
    vertices["p"], vertices["c"] = points.at_m, points.colours
    try:
        (out / "points.ply").write_bytes(_ply(vertices, POINTS))
    except OSError as error:
        raise BadMap(f"{out}: cannot be written: {error.strerror or error}") from error
    return out / "points.ply", len(vertices), points.closures


def _write_tum(path: Path, opened: MapFolder, log: LogId, T_map_camera: Float) -> Path:
    mounted = next(entry.T_body_camera for entry in opened.manifest.logs if entry.id == log)
    T = T_map_camera if mounted is None else T_map_camera @ inverse(pose_from_tq(np.array(mounted)))
    lines = []
    for stamp_s, pose in zip(stamps_s(opened, log), T, strict=False):
        x, y, z, w, i, j, k = pose7(pose)
        lines.append(f"{stamp_s:.9f} {x:.6f} {y:.6f} {z:.6f} {i:.9f} {j:.9f} {k:.9f} {w:.9f}\n")
    path.write_text("".join(lines), encoding="utf-8")
    return path


def _closures(opened: MapFolder, poses: dict[LogId, Float]) -> list[LoopClosure]:
    """The used closures, as the relative poses that the solution has."""
    return [
        LoopClosure(q, m, inverse(poses[q.log][q.index]) @ poses[m.log][m.index], metric=True)
        for q, m in opened.used_closures()
    ]


def _cameras(poses: dict[LogId, Float]) -> bytes:
    vertices = np.zeros(sum(map(len, poses.values())), dtype=VERTEX)
    first = 0
    for number, T in enumerate(poses.values()):
        rows = vertices[first : first + len(T)]
        rows["p"], rows["n"], rows["c"] = T[:, :3, 3], T[:, :3, 2], COLOURS[number % len(COLOURS)]
        first += len(T)
    return _ply(vertices, CAMERAS)


def _ply(vertices: NDArray[np.void], comment: str) -> bytes:
    return PLY_HEADER.format(count=len(vertices), comment=comment).encode() + vertices.tobytes()
