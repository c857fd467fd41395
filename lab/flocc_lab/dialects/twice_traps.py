"""Traps in what is said twice, and differently: calibrations, trajectories, headers; and poses that mean "lost".

Two files of one folder may be the same thing with other digits, or another camera, another estimator. Only the first
pair is read; of a header that changes between rows nothing is, and poses at the origin amid others are left out.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from flocc_agent.geometry import inverse, pose, q_wxyz_from_R, so3_exp
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_lab.dialects.folder_writers import HEIGHT, OPENGL, WIDTH, picture
from flocc_lab.dialects.trap_parts import CAMERA, Float, Rng, Trap, moving, unlike, written
from flocc_launch.datasets.commands import convert
from flocc_launch.datasets.detect import read_source

ZERO_S, COUNT = 1_700_000_000, 12
FILES = ("camera.yaml", "calibration.yml", "intrinsics.yaml", "camera_info.yaml")
SAME_ODOMETRY = ("odometry.tum", "odometry.csv", "odom.txt", "vio.csv")
SAME_TRAJECTORY = ("trajectory.txt", "poses.csv", "trajectory.csv", "camera_poses.txt")
SAME_TRUTH = ("groundtruth.txt", "gt.csv", "ground_truth.csv")


def _stamps_s() -> Float:
    return np.round(ZERO_S + 0.1 * np.arange(COUNT), 3)


def _table(path: Path, T: Float, digits: int) -> None:
    """Poses in a table with a header, with so many digits."""
    sign = "," if path.suffix == ".csv" else " "
    lines = [sign.join(["timestamp", "tx", "ty", "tz", "qw", "qx", "qy", "qz"])]
    for stamp_s, each in zip(_stamps_s(), T, strict=True):
        numbers = [*each[:3, 3], *q_wxyz_from_R(each[:3, :3])]
        lines.append(sign.join([f"{stamp_s:.3f}", *(f"{number:.{digits}f}" for number in numbers)]))
    written(path, ("# " if path.suffix != ".csv" else "") + "\n".join(lines) + "\n")


def _images(path: Path) -> None:
    for k, stamp_s in enumerate(_stamps_s()):
        picture(path / "images" / f"{stamp_s:.3f}.png", k)


def two_trajectories(rng: Rng, folder: Path) -> Trap:
    """Two files of odometry, a trajectory or the truth: the same motion in fewer digits or another frame, or not."""
    path, T = folder / "data", moving(rng, COUNT)
    _images(path)
    written(path / "camera.yaml", CAMERA)
    names = [SAME_ODOMETRY, SAME_TRAJECTORY, SAME_TRUTH][rng.integers(3)]
    first, second = (str(name) for name in rng.choice(names, 2, replace=False))
    differs = bool(rng.integers(2))
    other = pose(so3_exp(rng.normal(0, 1, 3)), rng.normal(0, 5, 3)) @ T
    if differs:
        mounting = pose(so3_exp(rng.uniform(0.3, 1, 3)), rng.uniform(0.2, 1, 3))
        other = other @ mounting if rng.integers(2) else moving(rng, COUNT)
    _table(path / first, T, 9)
    _table(path / second, other, 4)

    def look() -> str | None:
        source = read_source(path)
        found = source.odometry or source.truth
        assert found is not None
        relative = inverse(found.T_fixed_body[0]) @ found.T_fixed_body
        return unlike(relative, inverse(T[0]) @ T, "the motion", 2e-3)

    return Trap(look, must_be_refused=differs)


def two_cameras(rng: Rng, folder: Path) -> Trap:
    """Two calibrations in a folder, of a plain one, an ASL sequence or a reconstruction, that agree or do not."""
    path, T = folder / "data", moving(rng, COUNT)
    kind = str(rng.choice(["plain", "euroc", "transforms", "colmap"]))
    changed = str(rng.choice(["nothing", "digits", "fx", "k1", "mounting"]))
    fx = {"fx": 33.0, "digits": 30.004}.get(changed, 30.0)
    mounting = pose(so3_exp(rng.uniform(0.3, 1, 3)), rng.uniform(0.1, 1, 3))
    more = {"k1": "distortion: [-0.2, 0.05, 0, 0]\n", "mounting": f"T_body_camera: {mounting.tolist()}\n"}.get(
        changed, ""
    )
    beside = CAMERA.replace("fx: 30", f"fx: {fx}") + more
    if kind == "plain":
        _images(path)
        first, second = sorted(rng.choice(FILES, 2, replace=False), key=FILES.index)
        written(path / str(first), CAMERA)
        written(path / str(second), beside)
        write_tum(path / "odometry.tum", Trajectory(_stamps_s(), T))
    elif kind == "euroc":
        cam = path / "mav0" / "cam0"
        for k, stamp_s in enumerate(_stamps_s()):
            picture(cam / "data" / f"{round(stamp_s * 1000) * 10**6}.png", k)
        written(cam / "sensor.yaml", CAMERA)
        written(path / str(rng.choice(FILES)), beside)
        write_tum(path / "groundtruth.tum", Trajectory(_stamps_s(), T))
    else:
        _reconstruction(path, T, kind)
        written(path / str(rng.choice(FILES[:3])), beside)
    look = lambda: unlike(np.array(_fx_of(path)), np.array(30.0), "fx", 0.02)  # noqa: E731
    return Trap(look, must_be_refused=changed in ("fx", "k1", "mounting"))


def _fx_of(path: Path) -> float:
    lens = read_source(path).lens
    return float("nan") if lens is None else lens.camera.fx


def _reconstruction(path: Path, T: Float, kind: str) -> None:
    """A model of COLMAP's or nerfstudio's, of pictures that are named by stamps."""
    _images(path)
    names = [f"{stamp_s:.3f}.png" for stamp_s in _stamps_s()]
    if kind == "transforms":
        frames = [
            {"file_path": f"images/{name}", "transform_matrix": (each @ OPENGL).tolist()}
            for name, each in zip(names, T, strict=True)
        ]
        camera = {"w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0}
        written(path / "transforms.json", json.dumps({**camera, "frames": frames}))
        return
    lines = []
    for k, (name, each) in enumerate(zip(names, map(inverse, T), strict=True)):
        numbers = " ".join(map(repr, [*q_wxyz_from_R(each[:3, :3]).tolist(), *each[:3, 3].tolist()]))
        lines.append(f"{k + 1} {numbers} 1 {name}\n\n")
    written(path / "sparse" / "0" / "images.txt", "# Image list\n" + "".join(lines))
    written(path / "sparse" / "0" / "cameras.txt", f"1 PINHOLE {WIDTH} {HEIGHT} 30 30 16 12\n")


def odometry_beside_a_model(rng: Rng, folder: Path) -> Trap:
    """Odometry beside a reconstruction, of which it must not be passed over."""
    path, T = folder / "data", moving(rng, COUNT)
    _reconstruction(path, T, str(rng.choice(["transforms", "colmap"])))
    moved = moving(rng, COUNT)
    write_tum(path / f"{rng.choice(['odometry', 'odom', 'vio'])}.tum", Trajectory(_stamps_s(), moved))

    def look() -> str | None:
        found = read_trajectory(convert(path, folder / "out") / "odometry.tum")[0].T_fixed_body
        return unlike(found, inverse(moved[0]) @ moved, "odometry")

    return Trap(look)


def second_header(rng: Rng, folder: Path) -> Trap:
    """Tables one behind the other, whose second header names the columns in the same or in another order."""
    T, same = moving(rng, COUNT), bool(rng.integers(2))
    sign = str(rng.choice(["", "# "]))
    cut = int(rng.integers(4, COUNT - 4))
    lines = []
    for k, each in enumerate(T):
        xyz, (w, x, y, z) = each[:3, 3].tolist(), q_wxyz_from_R(each[:3, :3]).tolist()
        is_first = k < cut or same
        if k in (0, cut):
            lines.append(f"{sign}timestamp,x,y,z," + ("qw,qx,qy,qz" if is_first else "qx,qy,qz,qw"))
        numbers = [*xyz, *((w, x, y, z) if is_first else (x, y, z, w))]
        lines.append(",".join([f"{ZERO_S + 0.1 * k:.1f}", *(f"{number:.9f}" for number in numbers)]))
    path = written(folder / "odom.csv", "\n".join(lines) + "\n")
    look = lambda: unlike(read_trajectory(path)[0].T_fixed_body, T, "the poses")  # noqa: E731
    return Trap(look, must_be_refused=not same)


def lost_at_the_origin(rng: Rng, folder: Path) -> Trap:
    """Poses that programs write where they are lost; a robot that stands at its origin at first is none of them."""
    count = 40
    T = inverse(moving(rng, count)[0]) @ moving(rng, count) if rng.integers(2) else moving(rng, count)
    T[:, :3, 3] += 3.0 * np.arange(count)[:, None] / count
    stands = int(rng.integers(0, 3))
    first, length = int(rng.integers(8, count - 6)), int(rng.integers(1, 5))
    lost = np.zeros(count, dtype=bool)
    lost[first : first + length] = True
    T[:stands] = np.eye(4)
    T[lost] = np.eye(4)
    stamps_s = np.round(ZERO_S + 0.1 * np.arange(count), 3)
    write_tum(folder / "odometry.tum", Trajectory(stamps_s, T))

    def look() -> str | None:
        found, notes = read_trajectory(folder / "odometry.tum")
        if not any(f"{length} of {count} poses are exactly at the origin" in note for note in notes):
            return f"{length} lost poses were not told"
        return unlike(found.T_fixed_body, T[~lost], "the poses")

    return Trap(look)


TWICE_TRAPS: dict[str, Callable[[Rng, Path], Trap]] = {
    "two trajectories": two_trajectories,
    "two cameras": two_cameras,
    "odometry beside a model": odometry_beside_a_model,
    "a second header": second_header,
    "lost poses at the origin": lost_at_the_origin,
}
