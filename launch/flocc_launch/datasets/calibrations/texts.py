"""Forms that are lines of text: COLMAP, KITTI, DSO, ROS's INI, bare numbers. Each gives maps for `fields`."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flocc_launch.datasets.calibrations.maps import Cameras, Map

_COLMAP = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
}
_DSO = {
    "pinhole": ("none", 0),
    "fov": ("fov", 1),
    "atan": ("fov", 1),
    "radtan": ("opencv", 4),
    "equidistant": ("equidistant", 4),
    "kannalabrandt": ("equidistant", 4),
}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


@dataclass(frozen=True, slots=True)
class TextForm:
    """A form of calibration that is lines.

    Attributes:
        name: As a person would call it.
        fits: Whether a text is of it.
        cameras: Its cameras by name.
    """

    name: str
    fits: Callable[[str], bool]
    cameras: Callable[[str], Cameras]


def text_form(text: str) -> TextForm | None:
    """The form of a text, or None where it is none of these."""
    return next((form for form in TEXT_FORMS if form.fits(text)), None)


def _lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]


def _matches(pattern: str, every: bool = False) -> Callable[[str], bool]:
    def fits(text: str) -> bool:
        found = [re.match(pattern, line) is not None for line in _lines(text)]
        return bool(found) and (all(found) if every else found[0])

    return fits


def _colmap(text: str) -> Cameras:
    cameras: Cameras = {}
    for line in _lines(text):
        identifier, model, *numbers = line.split()
        if model not in _COLMAP:
            raise ValueError(f"the camera model is {model!r}; flocc reads {', '.join(_COLMAP)} of COLMAP")
        odd = next((word for word in numbers if not re.fullmatch(_NUMBER, word)), None)
        if odd is not None or len(numbers) < 2:
            raise ValueError(f"camera {identifier} has {odd or 'no size'} where a number must be")
        width, height, *parameters = (float(number) for number in numbers)
        names = _COLMAP[model]
        if len(parameters) != len(names):
            raise ValueError(f"camera {identifier} has {len(parameters)} parameters, but {model} has {len(names)}")
        camera: Map = {"width": width, "height": height, **dict(zip(names, parameters, strict=True))}
        cameras[identifier] = camera | _colmap_distortion(model, camera)
    return _one_of_equal(cameras)


def _colmap_distortion(model: str, camera: Map) -> Map:
    if model.endswith("FISHEYE"):
        return {"distortion_model": "equidistant", **{f"k{k}": camera.get(f"k{k}", 0.0) for k in (1, 2, 3, 4)}}
    if model == "FOV":
        return {"distortion_model": "fov"}
    if model == "FULL_OPENCV":
        return {"distortion_model": "rational_polynomial", "distortion": _full(camera)}
    return {"distortion_model": "opencv"} if "k1" in camera else {}


def _full(camera: Map) -> list[float]:
    return [camera[key] for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]


def _one_of_equal(cameras: Cameras) -> Cameras:
    """One camera where all are the same, as after a reconstruction with a camera per image of one device."""
    first = next(iter(cameras.items()))
    return dict([first]) if all(camera == first[1] for camera in cameras.values()) else cameras


def _kitti(text: str) -> Cameras:
    """KITTI: P0 to P3 (odometry), P_rect_00 to P_rect_03 with S_rect and K, D, S of the unrectified images (raw)."""
    rows = dict(line.split(":", 1) for line in _lines(text) if ":" in line)
    numbers = {key.strip(): [float(word) for word in row.split()] for key, row in rows.items() if _are_numbers(row)}
    cameras: Cameras = {}
    for key, P in numbers.items():
        found = re.fullmatch(r"P(?:_rect_0?)?(\d)", key)
        if found is None:
            continue
        if len(P) != 12:
            raise ValueError(f"the row {key} must have 12 numbers, not {len(P)}")
        camera: Map = {"fx": P[0], "fy": P[5], "cx": P[2], "cy": P[6], "T_body_camera": _offset(P)}
        size = numbers.get(f"S_rect_0{found[1]}")
        if size is not None:
            camera["resolution"] = size
        cameras[f"P{found[1]}"] = camera
        if (K := numbers.get(f"K_0{found[1]}")) is not None:
            raw = {"K": K, "distortion": numbers.get(f"D_0{found[1]}", []), "resolution": numbers.get(f"S_0{found[1]}")}
            R, t = numbers.get(f"R_0{found[1]}"), numbers.get(f"T_0{found[1]}")
            cameras[f"K{found[1]}"] = raw if R is None or t is None else {**raw, "T_body_camera": _in_camera_0(R, t)}
    if not cameras:
        raise ValueError("has no row P0 to P3, nor P_rect_00 to P_rect_03")
    return cameras


def _in_camera_0(R: list[float], t: list[float]) -> list[list[float]]:
    """Pose of an unrectified camera in camera 0, of `p_i = R p_0 + t`."""
    if (len(R), len(t)) != (9, 3):
        raise ValueError(f"rows R_ and T_ must have 9 and 3 numbers, not {len(R)} and {len(t)}")
    back = np.array(R).reshape(3, 3).T
    return [[*map(float, row), float(-row @ np.array(t))] for row in back] + [[0.0, 0.0, 0.0, 1.0]]


def _are_numbers(row: str) -> bool:
    return all(re.fullmatch(_NUMBER, word) for word in row.split())


def _offset(P: list[float]) -> list[list[float]]:
    """Pose of a rectified camera in camera 0, of the fourth column of its projection."""
    z = P[11]
    if P[0] <= 0 or P[5] <= 0:
        raise ValueError("a projection has no focal length")
    x, y = (P[3] - P[2] * z) / P[0], (P[7] - P[6] * z) / P[5]
    return [[1.0, 0.0, 0.0, -x], [0.0, 1.0, 0.0, -y], [0.0, 0.0, 1.0, -z], [0.0, 0.0, 0.0, 1.0]]


def _dso(text: str) -> Cameras:
    """DSO, LDSO, LSD-SLAM, TUM monoVO: intrinsics, size, what to crop, output size. Lengths below 1 are of the size."""
    first, second, *_ = _lines(text)
    words = first.split()
    name = plain if (plain := words[0].lower()) in _DSO else None
    numbers = [float(word) for word in (words[1:] if name else words)]
    width, height = (float(word) for word in second.split())
    fx, fy, cx, cy, *rest = numbers
    if name is None:
        name = "radtan" if len(rest) == 4 else "fov" if rest and rest[0] else "pinhole"
    model, count = _DSO[name]
    rest = [] if count == 0 and not any(rest) else rest
    if len(rest) != count:
        raise ValueError(f"the first line names {name} with {len(rest)} coefficients, which has {count}")
    if cx < 1 and cy < 1:
        fx, fy, cx, cy = fx * width, fy * height, cx * width - 0.5, cy * height - 0.5
    return {
        "camera": {
            "fx": fx, "fy": fy, "cx": cx, "cy": cy, "resolution": [width, height], "distortion": rest,
            "distortion_model": model,
        }
    }  # fmt: skip


def _is_dso(text: str) -> bool:
    lines = _lines(text)
    if len(lines) < 3 or not re.fullmatch(r"\d+\s+\d+", lines[1]):
        return False
    name, _, numbers = lines[0].partition(" ")
    rest = numbers if name.lower() in _DSO else lines[0]
    return _are_numbers(rest) and len(rest.split()) in (4, 5, 8)


def _ini(text: str) -> Cameras:
    """The INI form of ROS's camera_calibration_parsers (ost.txt)."""
    camera: Map = {}
    sections = re.split(r"^\s*\[.*\]\s*$", text, flags=re.MULTILINE)
    lines = [line for section in sections for line in _lines(section)]
    names = {"width": "width", "height": "height", "camera matrix": "K", "distortion": "distortion"}
    names |= {"rectification": "rectification_matrix", "projection": "projection_matrix"}
    key = None
    for line in lines:
        if _are_numbers(line):
            if key is None:
                raise ValueError(f"has numbers without a name: {line[:80]!r}")
            camera[key] = [*camera.get(key, []), *(float(word) for word in line.split())]
        elif line not in names:
            raise ValueError(f"the key {line[:80]!r} is not understood")
        else:
            key = names[line]
    return {"camera": {**camera, "distortion_model": "plumb_bob"}}


def _numbers(text: str) -> Cameras:
    """DROID-SLAM's one line (fx fy cx cy and distortion), or a 3x3 or 4x4 matrix (7-Scenes, ScanNet, Stray Scanner)."""
    rows = [[float(word) for word in re.split(r"[\s,;]+", line.strip(",; "))] for line in _lines(text)]
    if len(rows) == 1 and len(rows[0]) in (4, 8, 9, 12):
        camera: dict[str, Any] = {"intrinsics": rows[0][:4]}
        return {"camera": camera | ({"distortion": rows[0][4:]} if len(rows[0]) > 4 else {})}
    if len(rows) > 1 and all(len(row) == 12 for row in rows):
        return _kitti("".join(f"P{k}: {' '.join(map(str, row))}\n" for k, row in enumerate(rows)))
    if len({len(row) for row in rows}) == 1 and (len(rows), len(rows[0])) in ((3, 3), (3, 4), (4, 4)):
        if len(rows[0]) == 4 and any(row[3] for row in rows[:3]):  # a projection, whose camera sits beside the body
            return _kitti(f"P0: {' '.join(str(number) for row in rows[:3] for number in row)}\n")
        return {"camera": {"K": [number for row in rows for number in row]}}
    raise ValueError(
        f"has {len(rows)} rows of numbers; flocc knows one row of fx fy cx cy and distortion, or a 3x3 or 4x4 matrix"
    )


ZED_SIZES = {"2K": [2208, 1242], "FHD": [1920, 1080], "FHD1200": [1920, 1200], "HD": [1280, 720], "SVGA": [960, 600],
             "VGA": [672, 376]}  # fmt: skip


ZED_OTHERS = ("STEREO", "MISC")
"""Sections of ZED's files that are not of one camera."""


def _zed(text: str) -> Cameras:
    """SNxxxx.conf of ZED cameras: sections LEFT_CAM_HD and so on; distortion stands there or in LEFT_DISTO."""
    sections: dict[str, Map] = {}
    for name, body in re.findall(r"^\[(\w+)\]\s*$(.*?)(?=^\[|\Z)", text, re.MULTILINE | re.DOTALL):
        values = dict(line.split("=", 1) for line in _lines(body) if "=" in line)
        sections[name] = {key.strip(): float(value) for key, value in values.items() if name not in ZED_OTHERS}
    cameras: Cameras = {}
    for name, values in sections.items():
        side, is_camera, size = name.partition("_CAM_")
        if is_camera and size in ZED_SIZES:
            lens = sections.get(f"{side}_DISTO", {})
            twice = next((key for key in lens if values.get(key, lens[key]) != lens[key]), None)
            if twice is not None:
                raise ValueError(f"the sections {name} and {side}_DISTO give {twice} twice, and differ")
            cameras[name] = {"resolution": ZED_SIZES[size], **lens, **values}
        elif not is_camera and not name.endswith("_DISTO") and name not in ZED_OTHERS:
            raise ValueError(f"the section {name!r} is not understood and may be about the camera")
    return cameras


def _scanned(text: str) -> Cameras:
    """ScanNet's scene....txt and BundleFusion's _info.txt: the colour camera of `name = numbers`."""
    rows = {key.strip(): row.strip() for key, row in (line.split("=", 1) for line in _lines(text) if "=" in line)}

    def numbers(*names: str) -> list[float]:
        found = next((rows[name] for name in names if name in rows), None)
        if found is None or not _are_numbers(found):
            raise ValueError(f"has no {names[0]} with numbers")
        return [float(word) for word in found.split()]

    size = [*numbers("colorWidth", "m_colorWidth"), *numbers("colorHeight", "m_colorHeight")]
    if "m_calibrationColorIntrinsic" in rows:
        return {"camera": {"K": numbers("m_calibrationColorIntrinsic"), "resolution": size}}
    names = ("fx_color", "fy_color", "mx_color", "my_color")
    return {"camera": {"intrinsics": [number for name in names for number in numbers(name)], "resolution": size}}


TEXT_FORMS: tuple[TextForm, ...] = (
    TextForm("COLMAP cameras.txt", _matches(r"\d+\s+[A-Z][A-Z_]+\s+\d+\s+\d+\s"), _colmap),
    TextForm(
        "KITTI calibration", lambda text: re.search(r"^(P\d|P_rect_\d+):", text, re.MULTILINE) is not None, _kitti
    ),
    TextForm("ZED conf", lambda text: re.search(r"^\[LEFT_CAM_\w+\]", text, re.MULTILINE) is not None, _zed),
    TextForm(
        "ScanNet and BundleFusion",
        lambda text: re.search(r"^(m_calibrationColorIntrinsic|fx_color)\s*=", text, re.MULTILINE) is not None,
        _scanned,
    ),
    TextForm("ROS camera_calibration_parsers INI", _matches(r"\[image\]"), _ini),
    TextForm("DSO camera.txt", _is_dso, _dso),
    TextForm("numbers", _matches(rf"{_NUMBER}([\s,;]+{_NUMBER})*[\s,;]*$", every=True), _numbers),
)

REFUSED_TEXTS: tuple[tuple[re.Pattern[str], str], ...] = (
    (
        re.compile(r"Calibration results\s*\n=+"),
        "is Kalibr's report; give the camchain YAML that Kalibr writes beside it",
    ),
    (
        re.compile(r"#polynomial coefficients for the DIRECT mapping"),
        "is of Scaramuzza's OCamCalib model; calibrate with Kalibr",
    ),
    (
        re.compile(r"'?lensmodel'?\s*:", re.IGNORECASE),
        "is mrcal's .cameramodel; convert it with mrcal-convert-lensmodel and write YAML",
    ),
    (
        re.compile(r"Intrinsic of \"|Inverse Brown Conrady"),
        "is what rs-enumerate-devices prints; write Fx Fy PPX PPY as YAML",
    ),
    (re.compile(r"\A\s*NVM_V"), "is VisualSFM's NVM; export COLMAP's text form"),
    (re.compile(r"\A\s*# Bundle file"), "is a Bundler file; export COLMAP's text form"),
    (re.compile(r"\A\s*<launch"), "is a ROS launch file; give the calibration that it names"),
    (re.compile(r"\A\s*Pix4D"), "is of Pix4D, in millimetres of the sensor; export OpenCV's or COLMAP's form"),
    (re.compile(r"^cam0\s*=\s*\[", re.MULTILINE), "is Middlebury's calib.txt of a stereo pair; write cam0 as YAML"),
    (re.compile(r"\A\s*\[CAMERA_PARAMS\]"), "is MRPT's INI; write its resolution, fx, fy, cx, cy and dist as YAML"),
    (re.compile(r'\A\s*\[\s*\{\s*"version"'), "is an EDEX of cuVSLAM; write its camera as YAML"),
    (re.compile(r"\A# Image list"), "is COLMAP's images.txt; give cameras.txt"),
)
