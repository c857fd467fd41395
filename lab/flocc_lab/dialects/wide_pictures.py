"""Data sets as a wide lens would have taken them: pinhole images remapped at the same angular resolution.

What a data set's own camera sees is seen whole by the wide one; around it the wide images are black. So a run on what
flocc makes of them can be held against one on the original: both see the same part of the scene. The control is EUCM
with alpha 0, which is a pinhole: its pictures go the same way twice through interpolation, and no lens bends anything.

    python -m flocc_lab.dialects.wide_pictures SOURCE OUT --kind equidistant
"""

import argparse
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.runtime.trajectory import write_tum
from flocc_lab.dialects.calibration_form import Rig
from flocc_lab.dialects.calibration_writers import kalibr
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.pixels import agents_camera, read_bytes
from flocc_launch.datasets.source import DatasetError

Float = NDArray[np.float64]
MARGIN = 1.06
"""The wide image is so much larger than what it must hold, for the corners of the remapped one."""
CONTROL_SHIFT_PX = 0.25
"""Keeps the control's pixels off those of the original and of what is made of it: between equal grids nothing is
interpolated. A quarter of a pixel dulls as the mean over all shifts does."""


def wide_model(camera: Camera, kind: LensKind) -> CameraModel:
    """A wide lens of a camera's angular resolution in the middle that sees all that the camera sees.

    Raises:
        ValueError: Neither Kannala-Brandt nor double sphere nor the control is wanted.
    """
    shape: tuple[float, ...]
    distortion: tuple[float, ...]
    shift = 0.0
    if kind is LensKind.EQUIDISTANT:
        shape, distortion, stretch = (), (0.02, -0.01, 0.003, -0.0005), 1.0
    elif kind is LensKind.DOUBLE_SPHERE:
        shape, distortion, stretch = (-0.2, 0.59), (), 0.8
    elif kind is LensKind.EUCM:
        shape, distortion, stretch, shift = (0.0, 1.0), (), 1.0, CONTROL_SHIFT_PX
    else:
        raise ValueError(f"{kind} is not one of those that are measured")
    f = camera.fx * stretch
    model = CameraModel(4096, 4096, f, f, 2048.0, 2048.0, distortion, kind, shape)
    corner = np.array([[-(camera.cx + 0.5) / camera.fx, -(camera.cy + 0.5) / camera.fy, 1.0]])
    edges = np.array([[corner[0, 0], 0.0, 1.0], [0.0, corner[0, 1], 1.0], corner[0]])
    pixels, _ = model.project(edges)
    half = MARGIN * np.abs(pixels - 2048.0).max(axis=0)
    width, height = (2 * math.ceil(side) for side in half)
    return CameraModel(width, height, f, f, (width - 1) / 2 + shift, (height - 1) / 2 + shift, distortion, kind, shape)


def rays_of(model: CameraModel) -> Float:
    """Direction of each pixel (height, width, 3) of a model that is the same all around its axis."""
    theta = np.linspace(0.0, math.radians(89.0), 20_000)
    pixels, _ = model.project(np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1))
    radius = pixels[:, 0] - model.cx
    x, y = np.meshgrid(np.arange(model.width) - model.cx, np.arange(model.height) - model.cy)
    angle, around = np.interp(np.hypot(x, y), radius, theta), np.arctan2(y, x)
    rays = [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]
    return np.stack(rays, axis=-1)


def enlarged(camera: Camera, finer: int) -> Camera:
    """The camera of pictures with so many times the pixels a side; pixel (0, 0) is the centre of the first one."""
    at = (finer - 1) / 2
    return replace(
        camera,
        width=finer * camera.width,
        height=finer * camera.height,
        fx=finer * camera.fx,
        fy=finer * camera.fy,
        cx=finer * camera.cx + at,
        cy=finer * camera.cy + at,
    )


def write_enlarged(source_path: Path, out: Path, finer: int) -> Path:
    """Write one robot's data set with so many times the pixels a side, which hold nothing that was not there."""
    return _write(source_path, out, finer, None)


def write_wide(source_path: Path, out: Path, kind: LensKind, finer: int = 1) -> Path:
    """Write one robot's data set as a wide lens would have taken it, with a camchain of Kalibr.

    Args:
        source_path: The data set.
        out: A folder that is made anew.
        kind: Of the lens.
        finer: So many times the pixels a side, so that interpolation between them dulls nothing.
    """
    return _write(source_path, out, finer, kind)


def _write(source_path: Path, out: Path, finer: int, kind: LensKind | None) -> Path:
    import cv2

    source = read_source(source_path)
    if source.lens is None:
        raise DatasetError(f"{source_path}: has no intrinsics")
    own = agents_camera(source.lens)
    camera = enlarged(own, finer)
    model = CameraModel.of_camera(camera) if kind is None else wide_model(camera, kind)
    x, y = np.meshgrid(*(np.arange(side, dtype=float) for side in (camera.width, camera.height)))
    if kind is not None:
        rays = rays_of(model)
        x = rays[..., 0] / rays[..., 2] * camera.fx + camera.cx
        y = rays[..., 1] / rays[..., 2] * camera.fy + camera.cy
    at_x, at_y = (((each - (finer - 1) / 2) / finer).astype(np.float32) for each in (x, y))
    shutil.rmtree(out, ignore_errors=True)
    (out / "images").mkdir(parents=True)
    for stamp_s, file in source.images:
        pixels = cv2.imdecode(np.frombuffer(read_bytes(file), np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        border = cv2.BORDER_CONSTANT if kind is not None else cv2.BORDER_REPLICATE
        wide = cv2.remap(pixels, at_x, at_y, cv2.INTER_CUBIC, borderMode=border)
        cv2.imwrite(str(out / "images" / f"{stamp_s:.6f}.jpg"), wide, [cv2.IMWRITE_JPEG_QUALITY, 97])
    (out / "camera.yaml").write_text(kalibr(Rig(model, source.lens.T_body_camera)), encoding="utf-8")
    for name, trajectory in (("odometry", source.odometry), ("groundtruth", source.truth)):
        if trajectory is not None:
            write_tum(out / f"{name}.tum", trajectory)
    return out


def main() -> None:
    """Write a data set and say which field of view its own camera has."""
    parser = argparse.ArgumentParser(description="A data set as a wide lens would have taken it.")
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kind", type=LensKind, default=LensKind.EQUIDISTANT)
    parser.add_argument("--finer", type=int, default=1, help="so many times the pixels a side")
    options = parser.parse_args()
    write_wide(options.source, options.out, options.kind, options.finer)
    lens = read_source(options.source).lens
    assert lens is not None
    view_deg = 2 * math.degrees(math.atan(lens.camera.width / 2 / lens.camera.fx))
    sys.stdout.write(f"{options.out}: its part of the scene fills {view_deg:.1f} degrees\n")


if __name__ == "__main__":
    main()
