"""Forms that are maps: which cameras a document holds, each as one flat map that `fields` understands."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flocc_agent.geometry import inverse
from flocc_launch.datasets.calibrations.fields import BODY_CAMERA, CAMERA_BODY, pose_of
from flocc_launch.datasets.calibrations.taken_keys import Keys, flat_numbers, plain

Map = dict[str, Any]
Cameras = dict[str, Map]


@dataclass(frozen=True, slots=True)
class Form:
    """A form of calibration that is a map.

    Attributes:
        name: As a person would call it.
        fits: Whether a document is of it.
        cameras: Its cameras by name.
    """

    name: str
    fits: Callable[[Map], bool]
    cameras: Callable[[Map], Cameras]


def form_of(document: Map) -> Form:
    """The form of a document; the plain one where no other fits."""
    return next(form for form in FORMS if form.fits(document))


def _has(*names: str) -> Callable[[Map], bool]:
    return lambda document: all(name in document for name in names)


def _kalibr(document: Map) -> Cameras:
    rest = {key: value for key, value in document.items() if not _is_camera(key, value)}
    cameras = {key: _tidied({**rest, **value}) for key, value in document.items() if _is_camera(key, value)}
    _mount_along_chain(cameras)
    return cameras


def _mount_along_chain(cameras: Cameras) -> None:
    """Gives a camera that is placed only in the one before it (`T_cn_cnm1`) that one's mounting, carried on."""
    by_number = {int(re.sub(r"\D", "", key)): camera for key, camera in cameras.items()}
    for number in sorted(by_number):
        camera, before = by_number[number], by_number.get(number - 1, {})
        if "T_cn_cnm1" not in camera or any(name in camera for name in (*BODY_CAMERA, *CAMERA_BODY)):
            continue
        for name in (*BODY_CAMERA, *CAMERA_BODY):
            if name in before:
                T_now_before = pose_of(camera.pop("T_cn_cnm1"), "T_cn_cnm1")
                T_before = pose_of(before[name], name)
                T_now = T_now_before @ T_before if name in CAMERA_BODY else T_before @ inverse(T_now_before)
                camera[name] = T_now.tolist()
                break


def _is_camera(key: str, value: Any) -> bool:
    return re.fullmatch(r"(cam|camera)_?\d+", key.lower()) is not None and isinstance(value, dict)


OKVIS_PICTURES = ("gray", "rgb", "gray+depth", "rgb+depth")
"""What OKVIS 2 calls `camera_type`: of the pictures, not of the lens."""


def _listed_cameras(document: Map) -> Cameras:
    """SVO and maplab (a map `camera` beside `T_B_C`), OKVIS (all in one map)."""
    found: Cameras = {}
    rest = {key: value for key, value in document.items() if key not in ("cameras", "label", "id")}
    for number, entry in enumerate(document["cameras"]):
        if not isinstance(entry, dict):
            raise ValueError(f"its camera {number} is no map")
        inner = entry.get("camera", {})
        camera = {**rest, **{key: value for key, value in entry.items() if key != "camera"}, **inner}
        if isinstance(distortion := camera.get("distortion"), dict) and "type" in distortion:
            extra = set(distortion) - {"type", "parameters"}
            if extra:
                raise ValueError(f"the key {f'distortion.{min(extra)}'!r} is not understood")
            camera["distortion"] = distortion.get("parameters") or []
            camera["distortion_model"] = distortion["type"]
        camera.pop("id", None)
        if camera.get("camera_type") in OKVIS_PICTURES:
            del camera["camera_type"]
        found[str(camera.pop("label", f"cam{number}"))] = camera
    return found


def _orb(document: Map) -> Cameras:
    """ORB-SLAM 2 and 3: dotted keys; `Camera.` and `Camera1.` are one camera, `Camera2.` and `LEFT.` are others."""
    groups: dict[str, Map] = {}
    rest: Map = {}
    for key, value in document.items():
        group, dot, name = key.partition(".")
        if dot and re.fullmatch(r"Camera\d?|LEFT|RIGHT|IMU", group):
            groups.setdefault(group, {})[name] = value
        elif not re.match(r"(ORBextractor|Viewer|System|LoopClosing|RGBD|File|Optimizer|PointCloud|Stereo)\.", key):
            rest[key] = value
    shared, imu = groups.pop("Camera", {}), groups.pop("IMU", {})
    rest |= {key: value for key, value in imu.items() if plain(key) in ("tbc", "tbc1")}
    first = {**rest, **_merged(shared, groups.pop("Camera1", {}))}
    if plain(str(first.get("type", ""))) == "rectified":
        if any(value for key, value in first.items() if re.fullmatch(r"[kp]\d", key)):
            raise ValueError("Camera.type is Rectified, but there are distortion coefficients: take one of them out")
        first = {key: value for key, value in first.items() if key != "type"}
    if "LEFT" in groups:
        return {"Camera": first, **{name: {**rest, **groups[name]} for name in ("LEFT", "RIGHT") if name in groups}}
    others = {name: {**rest, "type": shared.get("type"), **groups[name]} for name in groups}
    return {"Camera1": first, **others}


def _merged(shared: Map, own: Map) -> Map:
    twice = next((key for key in own if key in shared and shared[key] != own[key]), None)
    if twice is not None:
        raise ValueError(f"the keys 'Camera.{twice}' and 'Camera1.{twice}' say different things")
    return {**shared, **own}


CAMODOCAL = {"pinhole": "radtan", "pinholefull": "rational_polynomial", "mei": "omni", "kannalabrandt": "equidistant"}


def _camodocal(document: Map) -> Cameras:
    """VINS-Mono and VINS-Fusion, by camodocal: parameters in maps of their own, whose names depend on the model."""
    mask = ("fisheye", "fisheye_mask")  # whether, and by what file, VINS puts a round mask on features
    camera = {key: value for key, value in document.items() if not key.endswith("_parameters") and key not in mask}
    model = plain(str(document.get("model_type", "")))
    if model in ("scaramuzza", "ocam"):
        raise ValueError(
            "is of Scaramuzza's OCamCalib model; flocc does not read it: calibrate with Kalibr (omni, ds, equi)"
        )
    parts = {key: value for key, value in document.items() if key.endswith("_parameters")}
    for key, part in parts.items():
        if not isinstance(part, dict):
            raise ValueError(f"{key} must be a map")
        renamed = {f"k{k + 1}": f"k{k}" for k in (1, 2, 3, 4)} if model == "kannalabrandt" else {}
        camera |= {renamed.get(str(name), str(name)): value for name, value in part.items()}
    if model not in CAMODOCAL:
        raise ValueError(
            f"the camera model is {document.get('model_type')!r}; flocc reads {', '.join(CAMODOCAL)} of camodocal"
        )
    kept = {name: value for name, value in camera.items() if name != "model_type"}
    return {"camera": {**kept, "camera_model" if model == "mei" else "distortion_model": CAMODOCAL[model]}}


def _basalt(document: Map) -> Cameras:
    value = document["value0"]
    extrinsics, sizes = value.get("T_imu_cam"), value.get("resolution")
    rest = {key: each for key, each in value.items() if key not in ("T_imu_cam", "intrinsics", "resolution")}
    cameras: Cameras = {}
    for number, entry in enumerate(value["intrinsics"]):
        kind, numbers = plain(str(entry.get("camera_type"))), dict(entry.get("intrinsics", {}))
        numbers.pop("rpmax", None)
        if kind == "fov":
            numbers["omega"] = numbers.pop("w", None)
        if kind == "ucm":
            numbers["beta"] = 1.0  # the unified model is the extended one with this
            entry = {**entry, "camera_type": "eucm"}
        camera: Map = {**rest, **numbers, "camera_model": {"pinhole": "none"}.get(kind, entry.get("camera_type"))}
        for name, listed in (("T_imu_cam", extrinsics), ("resolution", sizes)):
            if listed is not None and len(listed) != len(value["intrinsics"]):
                raise ValueError(f"has {len(value['intrinsics'])} cameras, but {name} has {len(listed)} entries")
            if listed is not None:
                camera[name] = listed[number]
        cameras[f"cam{number}"] = camera
    return cameras


SCENE = (
    "frames", "scale", "offset", "aabb", "aabb_scale", "applied_scale", "applied_transform", "orientation_override",
    "integer_depth_scale", "depth_unit_scale_factor", "ply_file_path", "from_na", "render_aabb", "up", "sharpness",
)  # fmt: skip
"""What transforms.json says of the scene, not of the camera."""
NERF_MODELS = {"opencv": "opencv", "opencvfisheye": "equidistant", "pinhole": "none", "simplepinhole": "none"}


def _nerfstudio(document: Map) -> Cameras:
    """Nerfstudio and instant-ngp: one camera for all frames, or one in each, which must be the same."""
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_model", "camera_angle_x")
    frames = [frame for frame in document["frames"] if isinstance(frame, dict)]
    own = [{name: frame[name] for name in names if name in frame} for frame in frames]
    if any(each != own[0] for each in own[1:]):
        raise ValueError("has frames of different cameras; flocc takes one camera per robot")
    camera = {key: value for key, value in document.items() if key not in SCENE} | (own[0] if own else {})
    fisheye = camera.pop("is_fisheye", None)
    given = camera.pop("camera_model", None)
    model = plain(str(given or ("OPENCV_FISHEYE" if fisheye else "OPENCV")))
    if model not in NERF_MODELS:
        raise ValueError(f"the camera model is {given!r}; flocc reads OPENCV, OPENCV_FISHEYE and PINHOLE of nerfstudio")
    if model != "opencv" or any(key in camera for key in ("k1", "k2", "p1")):
        camera["distortion_model"] = NERF_MODELS[model]
    return {"camera": _with_angles(camera)}


ANGLE_RATIO_MAX = 0.02
"""By how much a focal length and a field of view may differ, which tools round."""


def _with_angles(camera: Map) -> Map:
    """Focal lengths and principal point of files that have only fields of view."""
    angles = {axis: camera.pop(f"camera_angle_{axis}", None) for axis in "xy"}
    sides = {"x": camera.get("w"), "y": camera.get("h")}
    for axis, side in sides.items():
        angle = angles[axis]
        if angle is None or side is None:
            continue
        told = float(side) / 2 / float(np.tan(float(angle) / 2))
        length = float(camera.setdefault(f"fl_{axis}", told))
        if abs(told - length) > ANGLE_RATIO_MAX * length:
            raise ValueError(f"fl_{axis} is {length:g}, but camera_angle_{axis} and the size say {told:.1f}")
    if angles["x"] is not None and "fl_x" not in camera:
        raise ValueError("has a field of view (camera_angle_x) but no w and h: add them")
    for axis, side in sides.items():
        if f"c{axis}" not in camera and side is not None:
            camera[f"c{axis}"] = float(side) / 2
    return {**camera, "fl_y": camera.get("fl_y", camera.get("fl_x"))}


def _vikit(document: Map) -> Cameras:
    """Rpg's vikit (SVO 1, FAST-LIVO): keys that begin with cam_; ATAN has lengths in units of the size."""
    camera = {key.removeprefix("cam_"): value for key, value in document.items() if key != "scale"}
    kind = plain(str(camera.pop("model", "")))
    models = {"pinhole": "opencv", "atan": "fov", "equidistantcamera": "equidistant", "equidistant": "equidistant"}
    if kind not in models:
        raise ValueError(
            f"the camera model is {document.get('cam_model')!r}; flocc reads Pinhole, ATAN and Equidistant of vikit"
        )
    coefficients = [camera.pop(f"d{k}") for k in range(8) if f"d{k}" in camera]
    if kind == "atan":
        width, height = float(camera["width"]), float(camera["height"])
        camera |= {"fx": camera["fx"] * width, "fy": camera["fy"] * height}
        camera |= {"cx": camera["cx"] * width - 0.5, "cy": camera["cy"] * height - 0.5}
        coefficients = coefficients[:1]
    return {"camera": {**camera, "distortion": coefficients, "distortion_model": models[kind]}}


def _record3d(document: Map) -> Cameras:
    """Record3D's metadata: one matrix by columns; the small changes of focus in each frame are not used."""
    told = ("poses", "initPose", "perFrameIntrinsicCoeffs", "frameTimestamps", "dw", "dh", "cameraType")
    return {"camera": {key: value for key, value in document.items() if key not in told}}


def _opensfm(document: Map) -> Cameras:
    """OpenSfM and ODM: lengths in units of the larger side, the principal point from the middle."""
    cameras: Cameras = {}
    for name, given in document.items():
        keys = Keys(given)
        kind = plain(keys.text("projection_type") or "")
        if kind not in ("perspective", "brown", "fisheyeopencv", "simpleradial", "radial"):
            raise ValueError(
                f"the projection type is {given.get('projection_type')!r}; "
                "flocc reads perspective, brown and fisheye_opencv of OpenSfM"
            )
        width, height = keys.number("width"), keys.number("height")
        if width is None or height is None:
            raise ValueError("the image size is missing (width and height)")
        side, focal = max(width, height), keys.number("focal")
        fx, fy = keys.number("focal_x") or focal, keys.number("focal_y") or focal
        if fx is None or fy is None:
            raise ValueError("the intrinsics are missing (focal, or focal_x and focal_y)")
        cx, cy = keys.number("c_x") or 0.0, keys.number("c_y") or 0.0
        camera: Map = {key: given[key] for key in keys.left()}
        camera |= {"width": width, "height": height, "fx": fx * side, "fy": fy * side}
        camera |= {"cx": width / 2 - 0.5 + cx * side, "cy": height / 2 - 0.5 + cy * side}
        cameras[name] = {**camera, "distortion_model": "equidistant" if kind == "fisheyeopencv" else "opencv"}
    return cameras


def _gyroflow(document: Map) -> Cameras:
    """Gyroflow's lens profile: beside the lens, it names products."""
    size, lens = document["calib_dimension"], document["fisheye_params"]
    stretches = [document.get(f"input_{axis}_stretch") or 1.0 for axis in ("horizontal", "vertical")]
    if any(float(stretch) != 1.0 for stretch in stretches):
        raise ValueError(f"is of pictures that are stretched by {stretches[0]} and {stretches[1]} first: stretch yours")
    told = ("camera_brand", "camera_model", "lens_model", "camera_setting", "calib_dimension", "fisheye_params")
    rest = {key: value for key, value in document.items() if key not in told}
    return {"camera": {"distortion_model": "equidistant", **rest, **lens, "width": size["w"], "height": size["h"]}}


def _depthai(document: Map) -> Cameras:
    cameras: Cameras = {}
    rest = {key: value for key, value in document.items() if key not in ("cameraData", "imuExtrinsics")}
    told = ("cameraType", "distortionCoeff", "extrinsics", "specHfovDeg", "lensPosition")
    for socket, given in document["cameraData"]:
        models = {0: None, 1: "equidistant"}
        kind = given.get("cameraType", 0)
        if kind not in models:
            raise ValueError(f"the camera type is {kind}; flocc reads 0 (perspective) and 1 (fisheye) of DepthAI")
        camera: Map = {key: value for key, value in given.items() if key not in told}
        camera |= {"distortion": given.get("distortionCoeff"), "distortion_model": models[kind]}
        camera["intrinsic_matrix"] = camera.pop("intrinsicMatrix", None)
        cameras[f"CAM{socket}"] = {**rest, **camera}
    return cameras


def _stereo(document: Map) -> Cameras:
    """OpenCV's stereo samples: M1 (or K1) D1 of the left camera, M2 D2 of the right one, and what lies between them.

    Raises:
        ValueError: K1 has four coefficients, which OpenCV's fisheye sample writes in the same way.
    """
    between = ("M1", "K1", "D1", "M2", "K2", "D2", "R", "T", "E", "F", "R1", "R2", "P1", "P2", "Q")
    rest = {key: value for key, value in document.items() if key not in between}
    M = "M" if "M1" in document else "K"
    if M == "K" and "distortion_model" not in rest and len(flat_numbers(document["D1"], "D1")) == 4:
        raise ValueError("nothing says whether the four numbers of D1 are of a fisheye: add distortion_model")
    sides = {"left": "1", "right": "2"}
    return {
        side: {**rest, "camera_matrix": document[f"{M}{n}"], "distortion": document[f"D{n}"]}
        for side, n in sides.items()
        if f"{M}{n}" in document and f"D{n}" in document
    }


FOCAL = {plain(name) for name in (
    "fx", "fl_x", "fu", "Camera.fx", "cam_fx", "focal_length", "focalLengthX", "camera_matrix", "K", "intrinsic_matrix",
    "cam_K", "camera_intrinsics", "camera_intrinsic",
)}  # fmt: skip
"""Plain names of keys by which a map is one of a camera."""


def _is_of_camera(values: Map) -> bool:
    if any(plain(key) in FOCAL for key in values):
        return True
    listed = values.get("intrinsics", values.get("calibration"))
    return isinstance(listed, list) or (isinstance(listed, dict) and "data" in listed)


def _holds_camera(value: Any) -> bool:
    return isinstance(value, dict) and (_is_of_camera(value) or any(map(_holds_camera, value.values())))


OF_OTHERS = ("type", "model", "name", "id", "label")
"""Keys that, above a camera's map, are of what it stands in."""


def _nested(document: Map, path: tuple[str, ...] = (), above: Map | None = None) -> Cameras:
    """Maps of cameras inside of others, each with all that stands above and beside it: nothing is lost unsaid."""
    own = {key: value for key, value in document.items() if not _holds_camera(value) and plain(key) not in OF_OTHERS}
    around = {**(above or {}), **own}
    found: Cameras = {}
    for key, value in document.items():
        if not _holds_camera(value):
            continue
        if _is_of_camera(value):
            twice = next((name for name in value if name in around and around[name] != value[name]), None)
            if twice is not None:
                raise ValueError(f"the keys {twice!r} and '{key}.{twice}' say different things")
            found[".".join((*path, key))] = {**around, **value}
        else:
            found |= _nested(value, (*path, key), around)
    return found


def _plain(document: Map) -> Cameras:
    """All in one map: EuRoC, Kimera, ROS, OpenCV, RTAB-Map, MASt3R-SLAM, flocc's own, and whoever is like them."""
    if _is_of_camera(document):
        return {"camera": _tidied(document)}
    inner = _nested(document)
    return {name: _tidied(camera) for name, camera in inner.items()} if inner else {"camera": _tidied(document)}


def _tidied(document: Map) -> Map:
    """What single tools write in a way of their own."""
    if "cam_fx" in document and "cam_model" in document:
        return _vikit(document)["camera"]
    camera = dict(document)
    if camera.pop("distorted", True) is False and any(camera.get(key) for key in ("k1", "k2", "p1", "p2", "k3")):
        raise ValueError("says distorted: false, but has distortion coefficients")
    if isinstance(camera.get("scale"), int | float) and set(map(plain, camera)) <= {
        "w",
        "h",
        "fx",
        "fy",
        "cx",
        "cy",
        "scale",
    }:
        camera["depth_scale"] = camera.pop("scale")  # Replica's renderings
    if isinstance(listed := camera.get("calibration"), list):
        del camera["calibration"]
        numbers = flat_numbers(listed, "calibration")
        camera |= {"intrinsics": numbers[:4], "distortion": numbers[4:]} if "intrinsics" not in camera else {}
    if isinstance(fisheye := camera.get("fisheye_model"), int | bool):
        del camera["fisheye_model"]
        camera |= {"distortion_model": "fisheye"} if fisheye else {}
    if plain(str(camera.get("distortion_model"))) in ("fisheye", "equidistant"):
        camera = _without_tangential(camera)
    flags = camera.get("flags")
    if isinstance(flags, str) and "fisheye" in flags.lower() and "distortion_model" not in camera:
        camera["distortion_model"] = "fisheye"
    return camera


def _without_tangential(camera: Map) -> Map:
    """A fisheye's k1 k2 0 0 k3 k4, as RTAB-Map writes it, as k1 k2 k3 k4."""
    name = "distortion_coefficients"
    given = flat_numbers(camera[name], name) if name in camera else []
    is_padded = len(given) == 6 and not any(given[2:4])
    return {**camera, name: [*given[:2], *given[4:]]} if is_padded else camera


FORMS: tuple[Form, ...] = (
    Form("Basalt", lambda d: isinstance(d.get("value0"), dict) and "intrinsics" in d["value0"], _basalt),
    Form("nerfstudio transforms.json", lambda d: isinstance(d.get("frames"), list), _nerfstudio),
    Form("vikit (SVO 1, FAST-LIVO)", _has("cam_fx", "cam_model"), _vikit),
    Form("Record3D", _has("K", "poses"), _record3d),
    Form("DepthAI", lambda d: isinstance(d.get("cameraData"), list), _depthai),
    Form("Gyroflow", _has("fisheye_params", "calib_dimension"), _gyroflow),
    Form("SVO, maplab or OKVIS", lambda d: isinstance(d.get("cameras"), list), _listed_cameras),
    Form("Kalibr camchain", lambda d: any(_is_camera(key, value) for key, value in d.items()), _kalibr),
    Form("camodocal (VINS)", lambda d: "model_type" in d or "projection_parameters" in d, _camodocal),
    Form("ORB-SLAM settings", lambda d: any(re.match(r"(Camera\d?|LEFT)\.", key) for key in d), _orb),
    Form("OpenCV stereo", lambda d: "D1" in d and ("M1" in d or "K1" in d), _stereo),
    Form(
        "OpenSfM",
        lambda d: bool(d) and all(isinstance(value, dict) and "projection_type" in value for value in d.values()),
        _opensfm,
    ),
    Form("one map", lambda _: True, _plain),
)

REFUSED_MAPS: tuple[tuple[str, Callable[[Mapping[str, Any]], bool], str], ...] = (
    ("a Meshroom or OpenMVG scene", lambda d: "views" in d and "intrinsics" in d, "export COLMAP's text form from it"),
    ("VINS' settings that do not know where the camera sits (estimate_extrinsic: 2)",
     lambda d: d.get("estimate_extrinsic") == 2,
     "write body_T_cam0 of what VINS found and 0 for it, or take the key out where the camera is the body"),
    ("a Kalibr target", lambda d: "target_type" in d, "give the camchain file that Kalibr writes"),
    ("Kalibr's IMU file", lambda d: "accelerometer_noise_density" in d and "fx" not in d and "intrinsics" not in d,
     "give the camchain file that Kalibr writes"),
    ("Azure Kinect's calibration", lambda d: "CalibrationInformation" in d,
     "its numbers are of a part of the sensor; write those of k4a's colour mode as YAML"),
    ("calib.io's calibration", lambda d: isinstance(d.get("Calibration"), dict) and "cameras" in d["Calibration"],
     "export OpenCV's form from it"),
    ("Project Aria's calibration", lambda d: "CameraCalibrations" in d,
     "rectify the images, and write that camera as YAML"),
    ("EasyMocap's intri.yml", lambda d: "names" in d and any(re.match(r"K_\w", key) for key in d),
     "write K and dist of one camera as YAML"),
    ("a COCO or other annotation", lambda d: "annotations" in d and "images" in d, "give a calibration"),
)  # fmt: skip
