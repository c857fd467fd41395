"""Intrinsics from the files people have: flocc's TOML, and YAML of EuRoC, Kalibr, ROS camera_info or flat keys.

Of YAML, only what such files use is read: maps by indentation, scalars, and lists in brackets over several lines.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import inverse
from flocc_agent.runtime.recording import read_camera
from flocc_agent.runtime.ros2.pixels import PINHOLE_MODELS
from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory import checked_pose
from flocc_launch.datasets.source import DatasetError, Lens

Float = NDArray[np.float64]

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def read_lens(path: Path) -> Lens:
    """Read a camera file, TOML or YAML.

    Raises:
        DatasetError: Unreadable, of no known form, or of a camera model other than pinhole with radtan distortion.
    """
    if path.suffix == ".toml":
        camera, T_body_camera = read_camera(path)
        return Lens(camera, T_body_camera)
    try:
        values = flat_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    try:
        return _lens(_Leaves(values), path)
    except RecordingError as error:
        raise DatasetError(str(error)) from error
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from error


def flat_yaml(text: str) -> dict[str, str]:
    """Read a YAML file's leaves: `{a: {b: 1}}` gives `a.b`; lists stay text."""
    values: dict[str, str] = {}
    stack: list[tuple[int, str]] = []
    for line in _joined_lists(text):
        found = re.match(r"^(\s*)(?:- )?([\w.]+)\s*:(?:\s+(.*))?$", line)
        if found is None:
            continue
        indent, key, value = len(found[1]), found[2], (found[3] or "").strip()
        while stack and stack[-1][0] >= indent:
            stack.pop()
        if value and not value.startswith("!!"):
            values[".".join([*(name for _, name in stack), key])] = value.strip("'\"")
        else:
            stack.append((indent, key))
    return values


def _joined_lists(text: str) -> list[str]:
    lines: list[str] = []
    for raw in text.splitlines():
        line = raw.split("#", 1)[0].rstrip()
        open_list = bool(lines) and lines[-1].count("[") > lines[-1].count("]")
        if lines and (open_list or line.lstrip().startswith("- [")):
            lines[-1] += " " + line.strip()
        elif line and not line.startswith(("%", "---")):
            lines.append(line)
    return lines


class _Leaves:
    """A YAML file's leaves, found by the end of their names."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def text(self, key: str) -> str | None:
        return next((v for name, v in self._values.items() if name == key or name.endswith("." + key)), None)

    def numbers(self, *keys: str) -> list[float] | None:
        texts = [text for text in map(self.text, keys) if text is not None]
        return [float(number) for number in _NUMBER.findall(texts[0])] if texts else None


def _lens(leaves: _Leaves, path: Path) -> Lens:
    model = leaves.text("distortion_model") or leaves.text("camera_model") or ""
    if model not in PINHOLE_MODELS:
        raise DatasetError(f"{path}: the distortion model is {model!r}; flocc takes pinhole with radtan")
    width, height = _size(leaves)
    fx, fy, cx, cy = _focal(leaves)
    coefficients = leaves.numbers(
        "distortion_coefficients.data", "distortion_coefficients", "distortion_coeffs", "distortion"
    )
    k1, k2, p1, p2, k3 = ([*(coefficients or []), 0.0, 0.0, 0.0, 0.0, 0.0])[:5]
    return Lens(Camera(width, height, fx, fy, cx, cy, (k1, k2, p1, p2)), _mounting(leaves, path), k3)


def _size(leaves: _Leaves) -> tuple[int, int]:
    size = leaves.numbers("resolution")
    width, height = leaves.numbers("image_width", "width"), leaves.numbers("image_height", "height")
    if size is None and width and height:
        size = [*width, *height]
    if size is None or len(size) != 2:
        raise ValueError("the image size is missing (width and height, or resolution)")
    return int(size[0]), int(size[1])


def _focal(leaves: _Leaves) -> tuple[float, float, float, float]:
    listed = leaves.numbers("intrinsics")
    matrix = leaves.numbers("camera_matrix.data")
    single = [leaves.numbers(key) for key in ("fx", "fy", "cx", "cy")]
    if listed is None and matrix is not None and len(matrix) == 9:
        listed = [matrix[0], matrix[4], matrix[2], matrix[5]]
    if listed is None and all(single):
        listed = [value[0] for value in single if value]
    if listed is None or len(listed) != 4:
        raise ValueError("the intrinsics are missing (fx fy cx cy, intrinsics, or camera_matrix)")
    fx, fy, cx, cy = listed
    return fx, fy, cx, cy


def _mounting(leaves: _Leaves, path: Path) -> Float:
    T_body_camera = leaves.numbers("T_BS.data", "T_body_camera", "T_BS")
    T_camera_body = leaves.numbers("T_cam_imu")
    if T_body_camera is not None and len(T_body_camera) == 16:
        return checked_pose(np.array(T_body_camera).reshape(4, 4), f"{path}: T_body_camera")
    if T_camera_body is not None and len(T_camera_body) == 16:
        return inverse(checked_pose(np.array(T_camera_body).reshape(4, 4), f"{path}: T_cam_imu"))
    return np.eye(4)
