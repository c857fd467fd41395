"""Traps in what things are called: a frame, a file or a folder says one thing, and what stands in it another.

A link's frame that images are said to be of, a list whose stamps are not those in the names, a folder whose name begins
like that of a published camera; and a file of protobuf or JSON that ends before its recorder ended it.
"""

import base64
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from flocc_agent.geometry import inverse, pose, q_wxyz_from_R, so3_exp
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_lab.dialects.bags import IMAGES, STEP_NS, ZERO_NS
from flocc_lab.dialects.folder_writers import picture
from flocc_lab.dialects.trap_parts import CAMERA, Rng, Trap, drawn_bag, moving, unlike, written, written_bag
from flocc_launch.datasets.commands import convert, info
from flocc_launch.datasets.detect import read_source


def links_frame(rng: Rng, folder: Path) -> Trap:
    """Images of a frame that is a link's, x forward and z up, or that is called so and is a camera's, z forward."""
    script = drawn_bag(rng, "Odometry", mounted=True)
    frame = str(rng.choice(["camera_link", "front_camera_link", "cam_link", "Camera_Link_1"]))
    is_link = bool(rng.integers(2))
    T_body_camera = pose(so3_exp(np.array([0.0, 0.0, rng.uniform(-3, 3)])), np.round(rng.uniform(-1, 1, 3), 3))
    if is_link:
        T_body_camera = T_body_camera @ pose(so3_exp(np.array([0.0, rng.uniform(-0.7, 0.7), 0.0])), np.zeros(3))
    else:
        T_body_camera[:3, :3] = T_body_camera[:3, :3] @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    w, x, y, z = q_wxyz_from_R(T_body_camera[:3, :3]).tolist()
    edge = script.transform(ZERO_NS, ("base_link", frame), tuple(T_body_camera[:3, 3].tolist()), (x, y, z, w))
    script.add(ZERO_NS, "/tf_static", "tf2_msgs/msg/TFMessage", script.make("tf2_msgs/msg/TFMessage", [edge]))
    for k in range(IMAGES):
        bag_ns = ZERO_NS + k * STEP_NS
        script.camera(bag_ns, bag_ns, "/camera", frame, k)
        script.pose(bag_ns + 1000, bag_ns, "/", "base_link", 0.2 * k)
    path = written_bag(script, folder, rng)

    def look() -> str | None:
        return unlike(Recording.open(convert(path, folder / "out")).T_body_camera, T_body_camera, "the mounting")

    return Trap(look, must_be_refused=is_link)


def listed_stamps(rng: Rng, folder: Path) -> Trap:
    """A sequence of ASL's form whose list has other stamps than the names of its images: when they were taken."""
    cam = folder / "data" / "mav0" / "cam0"
    stamps_ns = (1_403_636_579 * 10**9 + np.cumsum(rng.integers(40, 60, 8)) * 10**6).tolist()
    named_ns = [stamp_ns + int(rng.integers(5, 900)) * 10**6 for stamp_ns in stamps_ns]
    names = [f"{k:06d}.png" for k in range(8)] if rng.integers(2) else [f"{ns}.png" for ns in sorted(named_ns)]
    for k, name in enumerate(names):
        picture(cam / "data" / name, k)
    rows = [f"{stamp_ns},{name}" for stamp_ns, name in zip(stamps_ns, names, strict=True)]
    written(cam / "data.csv", "\n".join(["#timestamp [ns],filename", *rows]) + "\n")
    written(folder / "data" / "camera.yaml", CAMERA)
    dense_s = np.arange(stamps_ns[0] * 1e-9 - 1, stamps_ns[-1] * 1e-9 + 3, 0.05)
    write_tum(folder / "data" / "groundtruth.tum", Trajectory(dense_s, moving(rng, len(dense_s))))
    wanted = np.array(stamps_ns) * 1e-9
    look = lambda: unlike(np.array([s for s, _ in read_source(folder / "data").images]), wanted, "the stamps", 2e-6)  # noqa: E731
    return Trap(look)


def folder_name(rng: Rng, folder: Path) -> Trap:
    """A folder of TUM's form whose name is that of a published camera, or only begins like it."""
    number = int(rng.choice([1, 2, 3, 11, 23, 30]))
    path = folder / f"rgbd_dataset_freiburg{number}_{rng.choice(['xyz', 'desk', '2'])}"
    stamps_s = np.round(1_305_031_102 + 0.1 * np.arange(6), 3)
    for stamp_s in stamps_s:
        (path / "rgb").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path / "rgb" / f"{stamp_s:.6f}.png"), np.full((480, 640), 90, np.uint8))
    written(path / "rgb.txt", "".join(f"{s:.6f} rgb/{s:.6f}.png\n" for s in stamps_s))
    write_tum(path / "groundtruth.txt", Trajectory(stamps_s, moving(rng, 6)))

    def look() -> str | None:
        lens = read_source(path).lens
        focal_px = {1: 517.3, 2: 520.9, 3: 535.4}.get(number)
        found = None if lens is None else lens.camera.fx
        return None if found == focal_px else f"fx is {found}, not {focal_px}"

    return Trap(look)


def cut_off(rng: Rng, folder: Path) -> Trap:
    """An MCAP of JSON that is whole, or ends within its data or its index."""
    from mcap.writer import Writer

    path, count = folder / "run.mcap", 20
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=3000)
        writer.start()
        channels = {
            topic: writer.register_channel(topic, "json", writer.register_schema(schema, "jsonschema", b"{}"))
            for topic, schema in (
                ("/cam", "CompressedImage"),
                ("/calib", "CameraCalibration"),
                ("/pose", "PoseInFrame"),
            )
            for schema in (f"foxglove.{schema}",)
        }
        K = [30.0, 0, 16, 0, 30, 12, 0, 0, 1]
        still = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
        for k in range(count):
            ns = ZERO_NS + k * STEP_NS
            head = {"timestamp": {"sec": ns // 10**9, "nsec": ns % 10**9}, "frame_id": "base_link"}
            pixels = cv2.imencode(".png", rng.integers(0, 255, (24, 32), np.uint8))[1].tobytes()
            still["position"]["x"] = 0.2 * k
            for topic, told in (
                ("/pose", {"pose": still, "frame_id": "odom"}),
                ("/calib", {"width": 32, "height": 24, "K": K, "D": [], "distortion_model": ""}),
                ("/cam", {"data": base64.b64encode(pixels).decode(), "format": "png"}),
            ):
                writer.add_message(channels[topic], ns, json.dumps({**head, **told}).encode(), ns)
        writer.finish()  # type: ignore[no-untyped-call]
    whole = path.read_bytes()
    share = float(rng.choice([0.5, 0.7, 0.9, 0.99, 1.0]))
    path.write_bytes(whole[: round(share * len(whole))])

    def look() -> str | None:
        found = [info(path).images, len(Recording.open(convert(path, folder / "out")).frames)]
        return None if found == [count, count] else f"{found} images, not {count}"

    return Trap(look, must_be_refused=share < 1.0)


def two_chains(rng: Rng, folder: Path) -> Trap:
    """Two results of Kalibr: of cameras alone, and of cameras and IMU, which says where the camera sits."""
    path, stem = folder / "data", str(rng.choice(["", "run-", "2023-11-14-", "x_"]))
    T = pose(so3_exp(rng.uniform(-2, 2, 3)), np.round(rng.uniform(-0.5, 0.5, 3), 4))
    camera = (
        "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n"
        "  intrinsics: [30, 30, 16, 12]\n  resolution: [32, 24]\n"
    )
    stamps_s = np.round(1_700_000_000 + 0.1 * np.arange(6), 3)
    for k, stamp_s in enumerate(stamps_s):
        picture(path / "images" / f"{stamp_s:.3f}.png", k)
    write_tum(path / "odometry.tum", Trajectory(stamps_s, moving(rng, 6)))
    name = str(
        rng.choice([f"{stem}camchain-imucam.yaml", f"camchain-imucam{'-' if stem else ''}{stem.strip('-_')}.yaml"])
    )
    written(path / f"{stem}camchain.yaml", camera)
    written(path / name, f"{camera}  T_cam_imu: {inverse(T).tolist()}\n")

    def look() -> str | None:
        lens = read_source(path).lens
        return "no camera" if lens is None else unlike(lens.T_body_camera, T, "the mounting")

    return Trap(look)


NAMED_TRAPS: dict[str, Callable[[Rng, Path], Trap]] = {
    "a link's frame": links_frame,
    "a list beside names": listed_stamps,
    "a folder's name": folder_name,
    "a file cut off": cut_off,
    "two chains": two_chains,
}
