"""`flocc map export`: a map as files that other programs read."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import LoopClosure
from flocc_agent.geometry import inverse, pose7, pose_from_tq
from flocc_agent.runtime.map_folder import BadMap, MapFolder
from flocc_launch.graph_files.g2o import write_g2o
from flocc_launch.maps.gathering import opened_record
from flocc_protocol.ids import LogId
from flocc_protocol.records import KeyframeRecord

Float = NDArray[np.float64]

COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (181, 80, 143), (201, 138, 0), (58, 155, 217), (107, 95, 199))
VERTEX = np.dtype([("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
PLY_HEADER = """ply
format binary_little_endian 1.0
comment camera positions of a flocc map, normals along the optical axes, a colour for each log
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
        (out / "cameras.ply").write_bytes(_ply(poses))
    except OSError as error:
        raise BadMap(f"{out}: cannot be written: {error.strerror or error}") from error
    return [*written, out / "map.g2o", out / "cameras.ply"]


def stamps_s(opened: MapFolder, log: LogId) -> list[float]:
    """Stamp of each keyframe of a log; the place of one that cannot be read is taken by the next."""
    found: list[float] = []
    for data in opened.records[log]:
        record = opened_record(data)[0]
        if isinstance(record, KeyframeRecord):
            found += [record.stamp_s] * (record.index + 1 - len(found))
    return found


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


def _ply(poses: dict[LogId, Float]) -> bytes:
    vertices = np.zeros(sum(map(len, poses.values())), dtype=VERTEX)
    first = 0
    for number, T in enumerate(poses.values()):
        rows = vertices[first : first + len(T)]
        rows["p"], rows["n"], rows["c"] = T[:, :3, 3], T[:, :3, 2], COLOURS[number % len(COLOURS)]
        first += len(T)
    return PLY_HEADER.format(count=len(vertices)).encode() + vertices.tobytes()
