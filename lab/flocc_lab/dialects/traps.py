"""Draws inputs of the kinds in which values were read wrongly without a word, and sees that they no longer are.

Each kind was found by people who tried to break the readers: half of one robot beside half of another, transforms of
robots whose frames have the same names, goals beside odometry, cameras beyond the first of a chain, matrices column by
column, several models of one reconstruction, an applied scale, the last frame of a video, options that a source does
not use, a time shift, a phone's folders, and those of `named_traps`, `unread_traps` and `twice_traps`. Everything else
of an input is drawn.

    python -m flocc_lab.dialects.traps --count 200 --seed 1
"""

import argparse
import json
import logging
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flocc_agent.geometry import inverse, pose, pose_from_tq, q_wxyz_from_R, so3_exp
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_agent.runtime.trajectory_text import read_trajectory
from flocc_lab.dialects.bags import IMAGES, MOUNT, STEP_NS, ZERO_NS, BagScript
from flocc_lab.dialects.folder_writers import HEIGHT, OPENGL, WIDTH, picture
from flocc_lab.dialects.named_traps import NAMED_TRAPS
from flocc_lab.dialects.trap_parts import (
    CAMERA,
    Float,
    Rng,
    Trap,
    TrapVerdict,
    drawn_bag,
    moving,
    unlike,
    written,
    written_bag,
)
from flocc_lab.dialects.twice_traps import TWICE_TRAPS
from flocc_lab.dialects.unread_traps import UNREAD_TRAPS
from flocc_launch.datasets.commands import COUNTS_FOR, convert
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.intrinsics import read_lens
from flocc_protocol.errors import FloccError

NAMES = (("r1", "r2"), ("alpha", "bravo"), ("robot_1", "robot_2"), ("tb3_0", "tb3_1"), ("uav1", "ugv1"))


def _first_x_m(path: Path) -> float:
    """Where a recording begins; NaN where it was written and cannot be opened, which is no refusal."""
    try:
        return float(Recording.open(path).frames[0].T_odom_body[0, 3])
    except FloccError:
        return float("nan")


def halves(rng: Rng, folder: Path) -> Trap:
    """A whole robot beside half of another, or two halves that are nobody's."""
    first, second = NAMES[rng.integers(len(NAMES))][:: 1 if rng.integers(2) else -1]
    script = drawn_bag(rng, str(rng.choice(["Odometry", "TransformStamped"])), mounted=False)
    both_halves = bool(rng.integers(2))
    _half(script, first, 5.0, images=True, poses=not both_halves)
    _half(script, second, 50.0, images=not both_halves and bool(rng.integers(2)), poses=True)
    if both_halves:
        path = written_bag(script, folder, rng)
        return Trap(lambda: f"paired: x is {_first_x_m(convert(path, folder / 'out'))}", must_be_refused=True)
    path = written_bag(script, folder, rng)

    def look() -> str | None:
        convert(path, folder / "out")
        found = sorted(file.parent for file in (folder / "out").rglob("images.txt"))
        wanted = {5.0, 50.0}
        off = [f"{out.name}: x is {x}" for out in found if (x := _first_x_m(out)) not in wanted]
        mixed = [out for out in found if out.name == first and _first_x_m(out) != 5.0]
        return "; ".join(off) or (f"{mixed[0].name} has the other's odometry" if mixed else None)

    return Trap(look)


def _half(script: BagScript, name: str, x_m: float, images: bool, poses: bool) -> None:
    for k in range(IMAGES):
        bag_ns = ZERO_NS + k * STEP_NS
        if images:
            script.camera(bag_ns, bag_ns, f"/{name}/camera", f"{name}/base_link", k)
        if poses:
            script.pose(bag_ns + 1000, bag_ns, f"/{name}/", f"{name}/base_link", x_m + 0.2 * k)


def transforms_by_namespace(rng: Rng, folder: Path) -> Trap:
    """Robots with transforms on topics of their own, whose frames have the same names."""
    names = NAMES[rng.integers(len(NAMES))]
    script = drawn_bag(rng, "Odometry", mounted=True)
    heights_m = np.round(rng.uniform(0.1, 2.0, len(names)), 3).tolist()
    for number, (name, height_m) in enumerate(zip(names, heights_m, strict=True)):
        lens = script.transform(ZERO_NS, ("base_link", "optical"), (0.1, 0.0, height_m), MOUNT[1])
        kind = "tf2_msgs/msg/TFMessage"
        script.add(ZERO_NS, f"/{name}/tf_static", kind, script.make(kind, [lens]))
        for k in range(IMAGES):
            bag_ns = ZERO_NS + k * STEP_NS
            script.camera(bag_ns, bag_ns, f"/{name}/camera", "optical", k)
            script.pose(bag_ns + 1000, bag_ns, f"/{name}/", "base_link", 100.0 * number + 0.2 * k)
    path = written_bag(script, folder, rng)

    def look() -> str | None:
        convert(path, folder / "out")
        for number, (name, height_m) in enumerate(zip(names, heights_m, strict=True)):
            found = Recording.open(folder / "out" / name)
            place = np.array([found.T_body_camera[2, 3], found.frames[0].T_odom_body[0, 3]])
            wrong = unlike(place, np.array([height_m, 100.0 * number]), f"height and x of {name}")
            if wrong:
                return wrong
        return None

    return Trap(look)


def goals(rng: Rng, folder: Path) -> Trap:
    """Poses to which a robot is sent, beside those where it is, or alone."""
    script = drawn_bag(rng, "PoseStamped", mounted=False)
    leaf = str(rng.choice(["goal_pose", "goal", "setpoint_position", "target_pose", "waypoint", "plan", "cmd_pose"]))
    alone = bool(rng.integers(2))
    odometry = BagScript(replace(script.draw, poses="Odometry"))
    for k in range(IMAGES):
        bag_ns = ZERO_NS + k * STEP_NS
        script.camera(bag_ns, bag_ns, "/camera", "base_link", k)
        script.pose(bag_ns, bag_ns, "/goals_of/", "base_link", 900.0 + k)
        if not alone:
            odometry.pose(bag_ns + 1000, bag_ns, "/", "base_link", 7.0 + 0.2 * k)
    script.messages = [
        (bag_ns, topic.replace("/goals_of/odom", f"/{leaf}"), kind, message)
        for bag_ns, topic, kind, message in script.messages
    ] + odometry.messages
    path = written_bag(script, folder, rng)

    def look() -> str | None:
        recording = convert(path, folder / "out")
        return "nothing was refused" if alone else unlike(np.array(_first_x_m(recording)), np.array(7.0), "x")

    return Trap(look, must_be_refused=alone)


def unnamed_body(rng: Rng, folder: Path) -> Trap:
    """Poses that do not say what they move, of a robot with static transforms."""
    script = drawn_bag(rng, str(rng.choice(["PoseStamped", "PoseWithCovarianceStamped"])), mounted=True)
    body = str(rng.choice(["base_link", "base_footprint", "body", "imu", "sensor_mast"]))
    t = tuple(np.round(rng.uniform(-1, 1, 3), 3).tolist())
    lens = script.transform(ZERO_NS, (body, "optical"), t, MOUNT[1])
    script.add(ZERO_NS, "/tf_static", "tf2_msgs/msg/TFMessage", script.make("tf2_msgs/msg/TFMessage", [lens]))
    for k in range(IMAGES):
        bag_ns = ZERO_NS + k * STEP_NS
        script.camera(bag_ns, bag_ns, "/camera", "optical", k)
        script.pose(bag_ns + 1000, bag_ns, "/", "base_link", 0.2 * k)
    path = written_bag(script, folder, rng)

    def look() -> str | None:
        found = Recording.open(convert(path, folder / "out")).T_body_camera
        (qx, qy, qz, qw) = MOUNT[1]
        return unlike(found, pose_from_tq(np.array([*t, qw, qx, qy, qz])), "the mounting")

    return Trap(look, may_be_refused=body in ("imu", "sensor_mast"))


def chain(rng: Rng, folder: Path) -> Trap:
    """A camera beyond the first of Kalibr's chain, placed in the IMU or only in the one before it; a time shift."""
    count = int(rng.integers(2, 5))
    T_cams_imu = [pose(so3_exp(rng.uniform(-2, 2, 3)), np.round(rng.uniform(-0.5, 0.5, 3), 4)) for _ in range(count)]
    alone = bool(rng.integers(2))
    shifts_s = np.round(rng.uniform(-0.1, 0.1, count), 5).tolist()
    text = ""
    for k, T in enumerate(T_cams_imu):
        text += f"cam{k}:\n"
        if k == 0 or not alone:
            text += f"  T_cam_imu: {T.tolist()}\n"
        if k > 0:
            text += f"  T_cn_cnm1: {(T @ inverse(T_cams_imu[k - 1])).tolist()}\n"
        text += (
            f"  camera_model: pinhole\n  intrinsics: [{300 + k}.0, 300.0, 160.0, 120.0]\n  resolution: [320, 240]\n"
            f"  distortion_model: radtan\n  distortion_coeffs: [0.0{k + 1}, 0.0, 0.0, 0.0]\n"
            f"  timeshift_cam_imu: {shifts_s[k]}\n"
        )
    path = written(folder / "camchain-imucam.yaml", text)
    wanted = int(rng.integers(0, count))

    def look() -> str | None:
        lens = read_lens(path.with_name(f"{path.name}#cam{wanted}"))
        numbers = np.array([lens.camera.fx, lens.camera.distortion[0], lens.time_shift_s])
        told = np.array([300.0 + wanted, 0.01 * (wanted + 1), shifts_s[wanted]])
        return unlike(numbers, told, "focal length, k1 and shift") or unlike(
            lens.T_body_camera, inverse(T_cams_imu[wanted]), "the mounting"
        )

    return Trap(look)


def matrices(rng: Rng, folder: Path) -> Trap:
    """Poses as matrices of 12 or 16 numbers, by rows or by columns, with a stamp or without."""
    poses = moving(rng, int(rng.integers(8, 40)))
    by_columns, stamped = bool(rng.integers(2)), bool(rng.integers(2))
    count = 16 if by_columns else int(rng.choice([12, 16]))
    stamps_s = np.round(1_700_000_000 + 0.1 * np.arange(len(poses)), 3)
    rows = []
    for stamp_s, T in zip(stamps_s, poses, strict=True):
        numbers = (T.T if by_columns else T).ravel()[:count]
        rows.append(" ".join([*([f"{stamp_s:.3f}"] if stamped else []), *map(repr, numbers.tolist())]))
    path = written(folder / str(rng.choice(["poses.txt", "trajectory.txt", "odometry.csv"])), "\n".join(rows) + "\n")
    look = lambda: unlike(read_trajectory(path, None, stamps_s.tolist())[0].T_fixed_body, poses, "the poses")  # noqa: E731
    return Trap(look, must_be_refused=by_columns)


def models(rng: Rng, folder: Path) -> Trap:
    """COLMAP's several models of one set of images, of which the largest is meant."""
    sizes = rng.permutation([int(rng.integers(2, 4)), int(rng.integers(5, 9))]).tolist()
    count = sum(sizes)
    poses = moving(rng, count)
    for k in range(count):
        picture(folder / "data" / "images" / f"{k:04d}.jpg", k)
    first = 0
    for number, size in enumerate(sizes):
        lines = []
        for k in range(first, first + size):
            T = inverse(poses[k])
            numbers = " ".join(map(repr, [*q_wxyz_from_R(T[:3, :3]).tolist(), *T[:3, 3].tolist()]))
            lines.append(f"{k + 1} {numbers} 1 {k:04d}.jpg\n\n")
        model = folder / "data" / "sparse" / str(number)
        written(model / "images.txt", "# Image list\n" + "".join(lines))
        written(model / "cameras.txt", f"1 PINHOLE {WIDTH} {HEIGHT} 3{number} 30 16 12\n")
        first += size
    largest = int(np.argmax(sizes))
    begin = sum(sizes[:largest])

    def look() -> str | None:
        source = read_source(folder / "data")
        assert source.truth is not None
        assert source.lens is not None
        return unlike(np.array(source.lens.camera.fx), np.array(30.0 + largest), "fx") or unlike(
            source.truth.T_fixed_body, poses[begin : begin + sizes[largest]], "the poses"
        )

    return Trap(look)


def applied_scale(rng: Rng, folder: Path) -> Trap:
    """Nerfstudio's poses, which were scaled before they were written."""
    poses = moving(rng, 6)
    scale = float(np.round(rng.uniform(0.05, 4.0), 4))
    frames = []
    for k, T in enumerate(poses):
        picture(folder / "data" / "images" / f"frame_{k:05d}.png", k)
        scaled = np.array(T)
        scaled[:3, 3] *= scale
        frames.append({"file_path": f"images/frame_{k:05d}.png", "transform_matrix": (scaled @ OPENGL).tolist()})
    camera = {"w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0, "applied_scale": scale}
    written(folder / "data" / "transforms.json", json.dumps({**camera, "frames": frames}))

    def look() -> str | None:
        truth = read_source(folder / "data").truth
        assert truth is not None
        return unlike(truth.T_fixed_body, poses, "the poses")

    return Trap(look)


def _phone(rng: Rng, path: Path, stamped: bool) -> tuple[Float, Float]:
    """A folder of pictures that are named by stamps or only counted; stamps and poses of its odometry."""
    where = str(rng.choice(["images", "DCIM/Camera", "DCIM/100ANDRO", "photos", "Frames", "RGB", "."]))
    stamps_s = np.round(1_700_000_000 + 0.2 * np.arange(8) + rng.uniform(0, 0.05, 8), 3)
    for k, stamp_s in enumerate(stamps_s):
        picture(path / where / (f"{stamp_s:.3f}.png" if stamped else f"IMG_{k:04d}.png"), k)
    written(path / "camera.yaml", CAMERA)
    dense_s = np.linspace(1_699_999_999.5, 1_700_000_003.45, 80)
    poses = np.tile(np.eye(4), (len(dense_s), 1, 1))
    poses[:, 0, 3] = dense_s - dense_s[0]
    write_tum(path / "odometry.tum", Trajectory(dense_s, poses))
    return stamps_s, dense_s


def times(rng: Rng, folder: Path) -> Trap:
    """Counted pictures with a file of their stamps, in a phone's or any folder."""
    path = folder / "data"
    stamps_s, _ = _phone(rng, path, stamped=False)
    form = int(rng.integers(4))
    rows = {
        0: [f"{s:.3f}" for s in stamps_s],
        1: [str(round(s * 1000) * 10**6) for s in stamps_s],
        2: [f"{s:.3f} IMG_{k:04d}.png" for k, s in enumerate(stamps_s)],
        3: [f"IMG_{k:04d}.png,{s:.3f},0.01" for k, s in enumerate(stamps_s)],
    }[form]
    short = bool(rng.integers(4) == 0)
    written(path / str(rng.choice(["times.txt", "timestamps.txt"])), "\n".join(rows[: len(rows) - short]) + "\n")
    look = lambda: unlike(np.array([s for s, _ in read_source(path).images]), stamps_s, "the stamps", 2e-6)  # noqa: E731
    return Trap(look, must_be_refused=short)


def shifted(rng: Rng, folder: Path) -> Trap:
    """A calibration that says how far the camera's clock is off, beside poses of the body's clock or of its own."""
    path = folder / "data"
    stamps_s, _ = _phone(rng, path, stamped=True)
    shift_s = float(np.round(rng.uniform(-0.3, 0.3), 4))
    written(
        path / "camera.yaml",
        f"cam0:\n  camera_model: pinhole\n  intrinsics: [30, 30, 16, 12]\n  resolution: [{WIDTH}, {HEIGHT}]\n"
        f"  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n  timeshift_cam_imu: {shift_s}\n",
    )
    of_camera = bool(rng.integers(2))
    if of_camera:
        write_tum(path / "odometry.tum", Trajectory(stamps_s, moving(rng, len(stamps_s))))
    wanted = stamps_s if of_camera else stamps_s + shift_s
    look = lambda: unlike(np.array([s for s, _ in read_source(path).images]), wanted, "the stamps", 2e-6)  # noqa: E731
    return Trap(look)


def unused_option(rng: Rng, folder: Path) -> Trap:
    """An option that says nothing of such a source."""
    path = folder / "data"
    _phone(rng, path, stamped=True)
    values: dict[str, Any] = {
        "--format": {"format_name": "plain"},
        "--image-topic": {"image_topic": "/camera"},
        "--odometry-topic": {"odometry_topic": "/odom"},
        "--truth": {"truth": path / "odometry.tum"},
        "--every": {"every": int(rng.integers(2, 9))},
        "--jpeg": {"jpeg": True},
        "--time-offset": {"time_offset_s": float(rng.uniform(-0.1, 0.1))},
    }
    option = str(rng.choice(sorted(values)))
    look = lambda: None if convert(path, folder / "out", **values[option]).is_dir() else "nothing"  # noqa: E731
    return Trap(look, must_be_refused="folder" not in COUNTS_FOR[option])


def video(rng: Rng, folder: Path) -> Trap:
    """A video whose odometry ends with its last frame, or before it."""
    rate_hz, count = float(rng.choice([5.0, 10.0, 15.0])), int(rng.integers(12, 30))
    path = folder / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, (64, 48))
    for k in range(count):
        writer.write(np.full((48, 64, 3), 8 * k, np.uint8))
    writer.release()
    written(folder / "camera.yaml", "width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 32\ncy: 24\n")
    posed = count - int(rng.integers(0, 4))
    poses = np.tile(np.eye(4), (posed, 1, 1))
    poses[:, 0, 3] = np.arange(posed)
    write_tum(folder / "walk.tum", Trajectory(np.arange(posed) / rate_hz, poses))

    def look() -> str | None:
        frames = Recording.open(convert(path, folder / "out")).frames
        found = np.array([frame.T_odom_body[0, 3] for frame in frames])
        return unlike(found, np.arange(float(posed)), "x of the frames", 0.05)

    return Trap(look)


TRAPS: dict[str, Callable[[Rng, Path], Trap]] = {
    "halves of two robots": halves,
    "transforms by namespace": transforms_by_namespace,
    "goals": goals,
    "poses of a body without a name": unnamed_body,
    "a camera of a chain": chain,
    "matrices by rows and columns": matrices,
    "several models": models,
    "an applied scale": applied_scale,
    "times of counted pictures": times,
    "a time shift": shifted,
    "an option without use": unused_option,
    "the end of a video": video,
    **NAMED_TRAPS,
    **UNREAD_TRAPS,
    **TWICE_TRAPS,
}


def judged(kind: str, rng: Rng, folder: Path) -> TrapVerdict:
    """Draw one input of a kind, read it, and say what came of it."""
    trap = TRAPS[kind](rng, folder)
    try:
        wrong = trap.look()
    except FloccError as error:
        return TrapVerdict(kind, None, str(error), trap.may_be_refused, trap.must_be_refused)
    return TrapVerdict(kind, wrong, None, trap.may_be_refused, trap.must_be_refused)


def main() -> None:
    """Print how many of each kind were right, refused and wrong; exit code 1 where one is not as it must be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=120, help="in all, every kind in turn")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="*", default=list(TRAPS))
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    counts: Counter[tuple[str, str]] = Counter()
    bad = []
    for number in range(given.count):
        kind, seed = given.kinds[number % len(given.kinds)], given.seed + number
        with tempfile.TemporaryDirectory(prefix="flocc-traps-") as folder:
            verdict = judged(kind, np.random.default_rng(seed), Path(folder))
        outcome = "refused" if verdict.refusal else "right" if verdict.good else "WRONG"
        counts[kind, outcome if verdict.good else f"{outcome}, wrongly"] += 1
        if not verdict.good:
            bad.append(f"{kind}, seed {seed}: {verdict.wrong or verdict.refusal or 'was not refused'}")
    table = {kind: {o: n for (k, o), n in sorted(counts.items()) if k == kind} for kind in given.kinds}
    sys.stdout.write(json.dumps({"inputs": given.count, "bad": len(bad), **table, "which": bad[:20]}, indent=1) + "\n")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
