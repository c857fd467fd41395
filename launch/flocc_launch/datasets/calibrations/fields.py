"""One camera's map as a lens, whatever its keys are called. Every key is used or named; what may matter is refused.

A value that is not understood never becomes zero or the identity.
"""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, pose_from_tq
from flocc_agent.lenses import CameraModel, LensKind
from flocc_agent.lenses.lens_names import NONE, RATIONAL, READ, ZEROED, kind_of, plain_name, with_distortion
from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory import checked_pose
from flocc_launch.datasets.calibrations.document import TwiceError
from flocc_launch.datasets.calibrations.taken_keys import Keys, flat_numbers, plain
from flocc_launch.datasets.source import Lens

Float = NDArray[np.float64]
Focal = tuple[float, float, float, float]
Size = tuple[int, int]

SIDE_MAX = 1 << 20
CAMERA_MODEL = (
    "camera_model",
    "model_type",
    "camera_type",
    "Camera.type",
    "type",
    "model",
    "projection_type",
    "cam_model",
)
DISTORTION_MODEL = ("distortion_model", "distortion_type", "dist_model")
COEFFICIENTS = (
    "distortion_coefficients", "distortion_coeffs", "distortion", "dist_coeffs", "dist_coef", "distCoef",
    "camera_dist_coeffs", "coeffs", "DistCoeff",
    "distortion_coeff", "distortion_params", "distortionCoeff", "D",
)  # fmt: skip
MATRIX = (
    "camera_matrix",
    "CameraMat",
    "camera_intrinsic",
    "cam_matrix",
    "K",
    "camera_intrinsics",
    "intrinsic_matrix",
    "cam_K",
)
BODY_CAMERA = (
    "T_BS", "T_body_camera", "T_body_cam", "T_BC", "T_B_C", "T_SC", "T_imu_cam", "T_imu_camera", "T_IC", "T_b_c1",
    "Tbc", "body_T_cam", "body_T_cam0", "imu_T_cam", "local_transform",
)  # fmt: skip
CAMERA_BODY = (
    "T_cam_imu",
    "T_camera_imu",
    "T_CB",
    "T_C_B",
    "T_cam_body",
    "T_camera_body",
    "T_CI",
    "T_CS",
    "imuToCamera",
)
SHAPES = {
    LensKind.FOV: (("omega",),),
    LensKind.OMNIDIRECTIONAL: (("xi",),),
    LensKind.DOUBLE_SPHERE: (("xi",), ("alpha",)),
    LensKind.EUCM: (("alpha",), ("beta",)),
}
RADIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
COUNTS = (0, 4, 5, 8, 12)
_MATTERS = re.compile(
    r"dist|^k\d|^d\d*$|^p\d|^q[wxyz]?$|coef|intrin|model|^t[a-z]{2,3}\d?$|^t[a-z]*(cam|imu|body|sensor)|extrin|^r\d*$|^xi|alpha|"
    r"^beta|mirror|fisheye|rotat|translat|skew|gamma|offset|crop|roi|binning|focal|lens|fov|poly|tau|^s\d$|omega|transform|"
    r"prism|mount|^rpy|^ypr|^xyz|^pos$|^roll|^pitch|^yaw|euler|orient|position|quat|^tilt|^pan$|ext[rt]$|^rc[li]$|^pc[li]$|pose|zoom|scale|resiz|^f$|^fl|^f[xyuv]|^c[xyuv]$|matrix|tocam|camto|principal|center|centre|affine|shear"
)
"""Plain names of keys that say something about a camera; one that is not understood is refused."""
PLACED = re.compile(r"xyz|rpy|ypr|translation|rotation|position|orientation|quaternion|euler(angles)?")
"""Plain names in a map that says where something sits, as URDF's `origin: {xyz: 0.1 0 0.3, rpy: 0 0 0}`."""
POSE_NUMBERS = (3, 6, 7, 9, 12, 16)
BOUNDS = 6
"""Numbers of a box: in settings beside the camera, as many are more often that than a position and angles."""
HARMLESS_UNITS = ("", "m", "meter", "meters", "metre", "metres", "px", "pixel", "pixels")
HARMLESS = re.compile(
    r"^(lidar.*|camera(1|2)?(fps|rgb|bf|newwidth|newheight|id|name|label)|imu.*|acc.*|gyr.*|orbextractor.*|viewer.*|stereo.*|"
    r"loopclosing.*|system.*|rgbd.*|tn?cncnm1|timeshift.*|rectificationmatrix|projectionmatrix|p|r|header|seq|stamp|"
    r"averageviewdistance|avgreprojectionerror|reprojectionerror.*|rms.*|boardwidth|boardheight|squaresize|depthmapfactor|"
    r"depthscale|depthfactor|thdepth|thfarpoints|aabbscale|applied(transform|scale)|perviewreprojectionerrors|imagepoints|"
    r"extrinsicparameters|gridpoints|flagvalue|flags|fixprincipalpoint|ttracking|tlr|left.*|right.*|camera2.*|tcncnm1|"
    r"perviewerrors|stddevintrinsics|stddevextrinsics|intrinsicsstd|camoverlaps|rotationrate|t\d\d|posestd|calibaccel.*|"
    r"calibgyro.*|fisheyemodelname|vignette.*|estimateextrinsic|centerdepth|.*depth.*scale|.*scale.*depth|rollingshutter.*|(camera1)?overlapping.*|camtimeoffset.*|camtimeoffsetns|mocaptoimuoffsetns|view.*|responsefile|gravity|gnorm|mindist(ance)?|maxcnt|fthreshold|posegraphsavepath|visualizecamerasize)$"
)
"""Plain names of keys that look as if they mattered and do not: of other sensors or rectified images."""


def lens_of_keys(keys: Keys, size: Size | None) -> Lens:
    """The lens that a camera's map describes.

    Args:
        keys: The map; maps inside of it have been taken out.
        size: Of the images, for files that do not say it.

    Raises:
        ValueError: Something is missing, contradicts itself, or may matter and is not understood.
    """
    model = _model(keys, size)
    T_body_camera = _mounting(keys)
    shift_s = keys.number("timeshift_cam_imu") or 0.0
    if not np.isfinite(shift_s):
        raise ValueError(f"timeshift_cam_imu must be a number of seconds, not {shift_s}")
    _refuse_parts(keys)
    left = keys.left()
    apart = [key for key in left if plain(key) in ("t", "tvec")] if any(plain(key) == "r" for key in left) else []
    strange = [key for key in (*apart, *left) if key in apart or _matters(key, keys.value(key))]
    if strange:
        raise ValueError(
            f"the key {strange[0]!r} is not understood and may be about the camera; take it out if it is not"
        )
    notes = (f"not used: {', '.join(left)}",) if left else ()
    return Lens(model, T_body_camera, notes=notes, time_shift_s=shift_s)


def _matters(key: str, value: Any) -> bool:
    """Whether a key that nobody took may change what the camera is."""
    name = plain(key)
    if isinstance(value, str) and kind_of(value) not in (None, LensKind.PINHOLE):
        return True
    if re.search(r"pixel(aspect|ratio)", name):
        return value not in (1, "1", "1.0")
    if isinstance(value, str) and re.search(r"units?$", name):
        return plain(value) not in HARMLESS_UNITS
    if isinstance(value, str) and not re.search(r"model|type|distort|lens|fisheye", name):
        return False
    if _says_nothing(value):
        return False
    if re.search(r"cam", name) and re.search(r"imu|body|base", name) and _could_be_a_pose(value):
        return True
    if HARMLESS.match(name):
        return False
    return bool(_MATTERS.search(name)) or _could_be_a_pose(value)


def _could_be_a_pose(value: Any) -> bool:
    """Whether a value is as many numbers as a position or a rotation or both, names their axes, or holds such a one."""
    if isinstance(value, dict):
        named = {"x", "y", "z"} <= set(value) or {"roll", "pitch", "yaw"} <= set(value)
        placed = any(PLACED.fullmatch(plain(key)) and not _says_nothing(each) for key, each in value.items())
        return (
            named
            or placed
            or any(
                _count(each) != BOUNDS and _could_be_a_pose(each) and not _says_nothing(each) for each in value.values()
            )
        )
    return _count(value) in POSE_NUMBERS


def _count(value: Any) -> int:
    """How many numbers a list holds; 0 of anything else."""
    try:
        return len(flat_numbers(value, "value")) if isinstance(value, list) else 0
    except ValueError:
        return 0


def _says_nothing(value: Any) -> bool:
    """Whether a value is zero, empty, or an identity matrix."""
    if value in (0, False, "", "none", [], {}):
        return True
    try:
        numbers = np.array(flat_numbers(value, "value"))
    except ValueError:
        return False
    side = round(len(numbers) ** 0.5)
    is_identity = side * side == len(numbers) and np.array_equal(numbers.reshape(side, side), np.eye(side))
    return is_identity or not numbers.any()


def _model(keys: Keys, size: Size | None) -> CameraModel:
    camera, distortion = keys.text(*CAMERA_MODEL), keys.text(*DISTORTION_MODEL)
    kind = _agreed_kind(camera, distortion)
    own_size = _size(keys)
    focal, shape = _focal_and_shape(keys, kind)
    image_size = own_size or size
    if image_size is None:
        raise ValueError("the image size is missing (width and height, or resolution)")
    if own_size is None:
        _see_that_it_fits(focal, image_size)
    coefficients = _coefficients(keys, kind, distortion or camera)
    if kind in (LensKind.OMNIDIRECTIONAL, LensKind.DOUBLE_SPHERE, LensKind.EUCM):
        given = tuple(coefficients or ())
        kept = given if any(given) else ()
        return CameraModel(*image_size, *focal, kept, kind, shape)
    if kind is LensKind.FOV:
        if coefficients and shape:
            raise ValueError("a fov model has one coefficient, but there are two places that give it")
        return with_distortion("fov", coefficients or shape, image_size, focal)
    if coefficients is None and (distortion or camera) and _wants_coefficients(distortion, camera):
        raise ValueError(f"names the model {distortion or camera!r} but has no distortion coefficients")
    return with_distortion(_distortion_name(kind, camera, distortion), coefficients or [], image_size, focal)


def _distortion_name(kind: LensKind | None, camera: str | None, distortion: str | None) -> str | None:
    if kind is LensKind.EQUIDISTANT:
        return "equidistant"
    if distortion is not None:
        return distortion if plain_name(distortion) not in NONE or plain_name(distortion) else None
    return camera if camera is not None and plain_name(camera) in RATIONAL | ZEROED else None


def _wants_coefficients(distortion: str | None, camera: str | None) -> bool:
    named = distortion if distortion is not None else camera if kind_of(camera or "") is LensKind.EQUIDISTANT else ""
    return plain_name(named or "") not in NONE | {"pinhole"}


def _agreed_kind(camera: str | None, distortion: str | None) -> LensKind | None:
    """The family that the names of the camera and of the distortion agree on; None where neither is named.

    Raises:
        ValueError: A name is not known, or they contradict each other.
    """
    of_camera, of_distortion = (None if name is None else kind_of(name) for name in (camera, distortion))
    for what, name, kind in (("camera", camera, of_camera), ("distortion", distortion, of_distortion)):
        if name is not None and kind is None:
            raise ValueError(f"the {what} model is {name!r}; flocc reads {READ}")
    if of_camera in (None, LensKind.PINHOLE):
        return of_distortion or of_camera
    bare = distortion is None or plain_name(distortion) in NONE
    radtan = of_distortion is LensKind.PINHOLE and of_camera is LensKind.OMNIDIRECTIONAL
    if bare or radtan or of_distortion is of_camera:
        return of_camera
    raise ValueError(
        f"names the camera model {camera!r} and the distortion model {distortion!r}, which do not go together"
    )


def _size(keys: Keys) -> Size | None:
    listed = keys.numbers("resolution", "image_dimension", "image_size", "dimensions", "img_size", "sensor_resolution")
    width = keys.number("image_width", "width", "Camera.width", "w", "img_width", "cols")
    height = keys.number("image_height", "height", "Camera.height", "h", "img_height", "rows")
    if listed is not None and len(listed) != 2:
        raise ValueError(f"the resolution must be width and height, not {listed}")
    if (width is None) != (height is None):
        raise ValueError("the image size has only one of width and height")
    said = [pair for pair in (listed, None if width is None or height is None else [width, height]) if pair is not None]
    if not said:
        return None
    if said[0] != said[-1]:
        raise TwiceError(f"gives two image sizes, {said[0]} and {said[-1]}")
    wide, high = said[0]
    if not (0 < wide <= SIDE_MAX and 0 < high <= SIDE_MAX):
        raise ValueError(f"an image cannot have {wide:g}x{high:g} pixels")
    if wide != int(wide) or high != int(high):
        raise ValueError(f"the image size {wide:g}x{high:g} is not whole")
    return int(wide), int(high)


def _see_that_it_fits(focal: Focal, size: Size) -> None:
    """See that intrinsics without a size can be those of the images.

    Raises:
        ValueError: The principal point is far from the middle of the images.
    """
    _, _, cx, cy = focal
    if not (0.3 < cx / size[0] < 0.7 and 0.3 < cy / size[1] < 0.7):
        raise ValueError(
            f"the image size is missing, and the principal point ({cx:g}, {cy:g}) is not near the middle of the images "
            f"of {size[0]}x{size[1]}: add width and height"
        )


def _focal_and_shape(keys: Keys, kind: LensKind | None) -> tuple[Focal, tuple[float, ...]]:
    """Focal lengths, principal point, and the shape of a wide lens, from every place that gives them."""
    listed, shape = _listed(keys, kind)
    scalars = _scalars(keys)
    found = [focal for focal in (listed, _matrix(keys), _two_lists(keys), scalars) if focal is not None]
    if not found:
        raise ValueError("the intrinsics are missing (fx fy cx cy, intrinsics, or camera_matrix)")
    if any(not np.allclose(focal, found[0], rtol=1e-6) for focal in found[1:]):
        raise TwiceError(f"gives the intrinsics twice, and they differ: {found[0]} and {found[-1]}")
    return found[0], _shape(keys, kind, shape)


def _shape(keys: Keys, kind: LensKind | None, listed: tuple[float, ...]) -> tuple[float, ...]:
    """Shape parameters of a wide lens, as they stood before the intrinsics or as keys of their own."""
    names = () if kind is None else SHAPES.get(kind, ())
    given = [keys.number(*name) for name in names]
    own = tuple(value for value in given if value is not None)
    if own and listed and own != listed:
        raise TwiceError(f"gives the shape of its model twice, and they differ: {listed} and {own}")
    if len(own or listed) != len(names) and (own or kind is not LensKind.FOV):
        raise ValueError(f"the model {kind} needs {' and '.join(name[0] for name in names)}")
    return own or listed


def _listed(keys: Keys, kind: LensKind | None) -> tuple[Focal | None, tuple[float, ...]]:
    """Intrinsics as one list: fx fy cx cy, with the shape of a wide lens in front of them, as Kalibr has it."""
    if isinstance(given := keys.take("intrinsics", "intrinsic"), dict) and "data" not in given:
        raise ValueError("the intrinsics are a map inside of a map that flocc does not know")
    numbers = keys.numbers("intrinsics", "intrinsic")
    if numbers is None:
        return None, ()
    if len(numbers) == 9:
        return _of_matrix(numbers, "intrinsics"), ()
    extra = 0 if kind is None or kind is LensKind.FOV else len(SHAPES.get(kind, ()))
    if len(numbers) != 4 + extra:
        shape = " ".join(name[0] for name in SHAPES.get(kind, ())) if kind and extra else ""
        raise ValueError(
            f"intrinsics of the model {kind or 'pinhole'} are {4 + extra} numbers "
            f"({f'{shape} fx fy cx cy'.strip()}), not {len(numbers)}"
        )
    fx, fy, cx, cy = numbers[extra:]
    return (fx, fy, cx, cy), tuple(numbers[:extra])


def _matrix(keys: Keys) -> Focal | None:
    numbers = keys.numbers(*MATRIX)
    return None if numbers is None else _of_matrix(numbers, "the camera matrix")


def _of_matrix(K: list[float], name: str) -> Focal:
    """Focal lengths and principal point of a 3x3 (3x4, 4x4) matrix, by rows or, as Apple and Open3D have it, columns.

    Raises:
        ValueError: It is of another size or form, or has skew.
    """
    if len(K) not in (9, 12, 16):
        raise ValueError(f"{name} must have 3x3 numbers, not {len(K)}")
    M = np.array(K).reshape((3, 3) if len(K) == 9 else (-1, 4))[:3, :3]
    M = M.T if not M[:2, 2].any() and M[2, :2].any() else M
    if not np.allclose(M[2], (0, 0, 1)) or M[1, 0] != 0:
        raise ValueError(f"{name} is none: {M.tolist()}")
    if abs(M[0, 1]) > 1e-6 * abs(M[0, 0]):
        raise ValueError(f"{name} has a skew of {M[0, 1]:g}, which flocc does not take")
    return float(M[0, 0]), float(M[1, 1]), float(M[0, 2]), float(M[1, 2])


def _two_lists(keys: Keys) -> Focal | None:
    focal = keys.take("focal_length", "focal_lengths")
    centre = keys.numbers("principal_point")
    if focal is None and centre is None:
        return None
    lengths = (
        [float(focal)] * 2 if isinstance(focal, int | float) else flat_numbers(focal, "focal_length") if focal else []
    )
    if len(lengths) == 1:
        lengths *= 2
    if centre is None or len(lengths) != 2 or len(centre) != 2:
        raise ValueError("focal_length and principal_point must each have two numbers")
    return lengths[0], lengths[1], centre[0], centre[1]


def _scalars(keys: Keys) -> Focal | None:
    """Fx fy cx cy as keys of their own; one focal length may stand for both."""
    names = {
        "fx": ("fx", "Camera.fx", "fl_x", "focal_x", "fu", "mu", "gamma1", "focalLengthX"),
        "fy": ("fy", "Camera.fy", "fl_y", "focal_y", "fv", "mv", "gamma2", "focalLengthY"),
        "cx": ("cx", "Camera.cx", "u0", "cu", "ppx", "principalPointX"),
        "cy": ("cy", "Camera.cy", "v0", "cv", "ppy", "principalPointY"),
    }
    single = keys.number("f", "focal") if not any(name in keys for name in names["fx"]) else None
    values = {key: keys.number(*spellings) for key, spellings in names.items()}
    if single is not None:
        values |= {"fx": single, "fy": single}
    if not any(value is not None for value in values.values()):
        return None
    missing = [key for key, value in values.items() if value is None]
    if missing:
        raise ValueError(f"of the intrinsics, {', '.join(missing)} is missing")
    fx, fy, cx, cy = (value for value in values.values() if value is not None)
    return fx, fy, cx, cy


def _coefficients(keys: Keys, kind: LensKind | None, name: str | None) -> list[float] | None:
    """Distortion coefficients in the order of their model: as a list, or as keys k1, k2, p1 and so on."""
    given = keys.take(*COEFFICIENTS)
    listed = None if given is None else [] if given == "none" else flat_numbers(given, "distortion")
    if name is None and isinstance(given, list) and [len(row) for row in given if isinstance(row, list)] == [1] * 4:
        raise ValueError(
            "four coefficients in a column are what OpenCV's fisheye calibration gives: add distortion_model, "
            "equidistant or plumb_bob"
        )
    names = ("k1", "k2", "k3", "k4") if kind is LensKind.EQUIDISTANT else RADIAL
    single = {key: keys.number(key, f"Camera.{key}") for key in RADIAL}
    present = [key for key, value in single.items() if value is not None]
    if listed is not None and present:
        ordered = _ordered(single, names, kind)
        if not np.allclose(_padded(listed), _padded(ordered)):
            raise TwiceError(f"gives the distortion twice, and they differ: {listed} and {ordered}")
        return listed
    if not present:
        return listed
    strange = [key for key in present if key not in names and single[key] != 0.0]
    if strange:
        raise ValueError(f"the model {kind} ({name}) has no coefficient {strange[0]}")
    return _ordered(single, names, kind)


def _ordered(single: dict[str, float | None], names: tuple[str, ...], kind: LensKind | None) -> list[float]:
    values = [single[key] for key in names]
    if kind is LensKind.EQUIDISTANT:
        missing = [key for key, value in zip(names, values, strict=True) if value is None]
        if missing:
            raise ValueError(f"of the distortion, {', '.join(missing)} is missing")
        return [value or 0.0 for value in values]
    given = [place + 1 for place, value in enumerate(values) if value is not None]
    telling = [place + 1 for place, value in enumerate(values) if value]
    for last in (max(given, default=0), max(telling, default=0)):
        count = next(count for count in COUNTS if count >= last)
        if None not in values[5:count]:
            return [value or 0.0 for value in values[:count]]
    missing = [key for key, value in zip(names[5:count], values[5:count], strict=True) if value is None]
    raise ValueError(f"of the distortion, {', '.join(missing)} is missing: OpenCV's rational model has k4, k5 and k6")


def _padded(values: list[float]) -> Float:
    return np.array([*values, *[0.0] * (14 - len(values))])


def _mounting(keys: Keys) -> Float:
    """`T_body_camera`; the identity only where the file says nothing of it.

    Raises:
        ValueError: It is no pose, or is given twice and differently.
    """
    found = []
    for names, turned in ((BODY_CAMERA, False), (CAMERA_BODY, True)):
        for name in names:
            if (given := keys.take(name)) is not None:
                T = pose_of(given, name)
                found.append((name, inverse(T) if turned else T))
    if (apart := _rotation_and_translation(keys)) is not None:
        found.append(("extrinsicRotation", apart))
    for name, T in found[1:]:
        if not np.allclose(T, found[0][1], atol=1e-4):
            raise TwiceError(f"the keys {found[0][0]!r} and {name!r} say different things")
    return found[0][1] if found else np.eye(4)


def pose_of(given: Any, name: str) -> Float:
    """The pose that a key gives as 12 or 16 numbers or as Basalt's map.

    Raises:
        ValueError: It is no pose.
    """
    if isinstance(given, dict) and {"px", "qw"} <= given.keys():
        order = ("px", "py", "pz", "qw", "qx", "qy", "qz")
        return _checked(pose_from_tq(np.array([float(given[key]) for key in order])), name)
    numbers = flat_numbers(given, name)
    if len(numbers) not in (12, 16):
        raise ValueError(f"{name} must be a pose of 4x4 numbers, not {len(numbers)}")
    T = np.array(numbers).reshape(-1, 4)
    return _checked(np.vstack([T, [0, 0, 0, 1]]) if len(T) == 3 else T, name)


def _rotation_and_translation(keys: Keys) -> Float | None:
    """The mounting as VINS-Mono has it: rotation and translation of the camera in the IMU."""
    R, t = keys.numbers("extrinsicRotation"), keys.numbers("extrinsicTranslation")
    if R is None and t is None:
        return None
    if R is None or t is None or len(R) != 9 or len(t) != 3:
        raise ValueError("extrinsicRotation and extrinsicTranslation must have 3x3 and 3 numbers")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.array(R).reshape(3, 3), t
    return _checked(T, "extrinsicRotation")


def _checked(T: Float, name: str) -> Float:
    try:
        return checked_pose(T, name)
    except RecordingError as error:
        raise ValueError(str(error)) from error


def _refuse_parts(keys: Keys) -> None:
    """Refuse intrinsics of a part of the sensor, or of binned pixels."""
    roi = keys.take("roi")
    parts = {f"roi.{key}": value for key, value in roi.items()} if isinstance(roi, dict) else {}
    parts |= {key: keys.take(key) for key in ("binning_x", "binning_y")}
    bad = next((f"{key} {value}" for key, value in parts.items() if value not in (None, 0, 1, False)), None)
    if bad is not None:
        raise ValueError(f"is of a part of the sensor or of binned pixels ({bad}): write the intrinsics of the images")
    if keys.number("skew", "axis_skew") not in (None, 0.0):
        raise ValueError("has skew, which flocc does not take")
