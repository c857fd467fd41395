"""Calibrations as the field's tools write them: one writer per form, of a drawn camera.

A writer gives a file's name and text, and says which camera models and whether a mounting the form can hold.
"""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import inverse, q_wxyz_from_R
from flocc_agent.lenses import CameraModel, LensKind

Float = NDArray[np.float64]
P, E, F = LensKind.PINHOLE, LensKind.EQUIDISTANT, LensKind.FOV
MEI, D, U = LensKind.OMNIDIRECTIONAL, LensKind.DOUBLE_SPHERE, LensKind.EUCM


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """A camera on a body.

    Attributes:
        model: Intrinsics.
        T_body_camera: (4, 4) mounting, metres.
        time_shift_s: What Kalibr calls `timeshift_cam_imu`.
    """

    model: CameraModel
    T_body_camera: Float
    time_shift_s: float = 0.0


@dataclass(frozen=True, slots=True)
class WriterForm:
    """How one tool writes a calibration.

    Attributes:
        name: The file's name.
        write: Gives the text.
        kinds: Camera models that it can say.
        counts: Numbers of distortion coefficients that it can say of a pinhole.
        mounting: Whether it says `T_body_camera`.
        sized: Whether it says the size of the images.
        sizes: Those that it can say; none means any.
        shift: Whether it says the offset of the camera's clock.
    """

    name: str
    write: Callable[[Rig], str]
    kinds: tuple[LensKind, ...] = (P,)
    counts: tuple[int, ...] = (0, 4)
    mounting: bool = False
    sized: bool = True
    sizes: tuple[tuple[int, int], ...] = ()
    shift: bool = False


def _list(values: Sequence[float] | Float) -> str:
    return "[" + ", ".join(repr(float(value)) for value in np.asarray(values).ravel()) + "]"


def _rows(T: Float, indent: str = "  ") -> str:
    return "".join(f"{indent}- {_list(row)}\n" for row in T)


def _block(values: Sequence[float] | Float, indent: str = "") -> str:
    return "".join(f"{indent}- {float(value)!r}\n" for value in np.asarray(values).ravel())


def _matrix(key: str, M: Float, tag: bool = True, indent: str = "") -> str:
    rows, columns = M.shape
    mark = " !!opencv-matrix" if tag else ""
    kind = f"{indent}   dt: d\n" if tag else ""
    return (
        f"{indent}{key}:{mark}\n{indent}   rows: {rows}\n{indent}   cols: {columns}\n{kind}"
        f"{indent}   data: {_list(M)}\n"
    )


def _focal(m: CameraModel) -> tuple[float, float, float, float]:
    return m.fx, m.fy, m.cx, m.cy


def _radtan(m: CameraModel, count: int) -> tuple[float, ...]:
    """Distortion with zeros up to a count."""
    return (*m.distortion, *[0.0] * (count - len(m.distortion)))


def _names(m: CameraModel) -> tuple[str, str]:
    """Kalibr's names of the camera and the distortion model."""
    return {
        P: ("pinhole", "radtan" if m.distortion else "none"),
        E: ("pinhole", "equidistant"),
        F: ("pinhole", "fov"),
        MEI: ("omni", "radtan" if m.distortion else "none"),
        D: ("ds", "none"),
        U: ("eucm", "none"),
    }[m.kind]


def flat(rig: Rig) -> str:
    """Write flocc's own flat keys."""
    m = rig.model
    keys = "".join(f"{key}: {value!r}\n" for key, value in zip(("fx", "fy", "cx", "cy"), _focal(m), strict=True))
    distortion = f"distortion: {_list(_radtan(m, 4))}\n"
    return f"width: {m.width}\nheight: {m.height}\n{keys}{distortion}T_body_camera:\n{_rows(rig.T_body_camera)}"


def toml(rig: Rig) -> str:
    """Write flocc's camera.toml."""
    m = rig.model
    keys = "".join(f"{key} = {value!r}\n" for key, value in zip(("fx", "fy", "cx", "cy"), _focal(m), strict=True))
    names = {F: ("omega",), MEI: ("xi",), D: ("xi", "alpha"), U: ("alpha", "beta")}.get(m.kind, ())
    shape = "".join(f"{key} = {value!r}\n" for key, value in zip(names, m.shape, strict=True))
    model = "" if m.kind is P else f"model = {str(m.kind)!r}\n"
    rows = ",".join(_list(row) for row in rig.T_body_camera)
    distortion = f"distortion = {_list(m.distortion)}\n" if m.distortion else ""
    return (
        f"[camera]\nwidth = {m.width}\nheight = {m.height}\n{keys}{model}{shape}{distortion}T_body_camera = [{rows}]\n"
    )


def euroc(rig: Rig) -> str:
    """Write sensor.yaml of EuRoC and Kimera."""
    m = rig.model
    return (
        "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0\n"
        + _matrix("T_BS", rig.T_body_camera, tag=False)
        + f"rate_hz: 20\nresolution: [{m.width}, {m.height}]\ncamera_model: pinhole\n"
        f"intrinsics: {_list(_focal(m))} #fu, fv\n"
        f"distortion_model: {'radial-tangential' if m.kind is P else 'equidistant'}\n"
        f"distortion_coefficients: {_list(_radtan(m, 4))}\n"
    )


def kalibr(rig: Rig) -> str:
    """Write a camchain."""
    m = rig.model
    camera, distortion = _names(m)
    coefficients = m.shape if m.kind is F else m.distortion
    numbers = (*_focal(m),) if m.kind is F else (*m.shape, *_focal(m))
    second = "cam1:\n  camera_model: pinhole\n  intrinsics: [9.0, 9.0, 9.0, 9.0]\n  resolution: [9, 9]\n"
    return (
        f"cam0:\n  T_cam_imu:\n{_rows(inverse(rig.T_body_camera))}  cam_overlaps: [1]\n  camera_model: {camera}\n"
        f"  distortion_coeffs: {_list(coefficients)}\n  distortion_model: {distortion}\n"
        f"  intrinsics: {_list(numbers)}\n"
        f"  resolution: [{m.width}, {m.height}]\n  rostopic: /cam0/image_raw\n"
        f"  timeshift_cam_imu: {rig.time_shift_s}\n{second}"
    )


def openvins(rig: Rig) -> str:
    """Write kalibr_imucam_chain.yaml of OpenVINS."""
    m = rig.model
    return (
        f"%YAML:1.0\n\ncam0:\n  T_imu_cam: #rotation from camera to IMU R_CtoI\n{_rows(rig.T_body_camera, '    ')}"
        f"  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_coeffs: {_list(_radtan(m, 4))}\n"
        f"  distortion_model: {'radtan' if m.kind is P else 'equidistant'}\n"
        f"  intrinsics: {_list(_focal(m))} #fu, fv, cu, cv\n"
        f"  resolution: [{m.width}, {m.height}]\n  rostopic: /cam0/image_raw\n"
    )


def _ros_name(m: CameraModel) -> str:
    return "equidistant" if m.kind is E else "rational_polynomial" if len(m.distortion) > 5 else "plumb_bob"


def camera_info(rig: Rig) -> str:
    """Write the YAML of ROS's camera_calibration_parsers."""
    m = rig.model
    D_ = np.array([_radtan(m, 5 if m.kind is P else 4)])
    P_ = np.hstack([m.K(), np.zeros((3, 1))])
    return (
        f"image_width: {m.width}\nimage_height: {m.height}\ncamera_name: narrow_stereo\n"
        + _matrix("camera_matrix", m.K(), False)
        + f"distortion_model: {_ros_name(m)}\n"
        + _matrix("distortion_coefficients", D_, False)
        + _matrix("rectification_matrix", np.eye(3), False)
        + _matrix("projection_matrix", P_, False)
    )


def topic_echo(rig: Rig) -> str:
    """Write what `ros2 topic echo --once camera_info` prints."""
    m = rig.model
    D_ = _radtan(m, 5 if m.kind is P else 4)
    return (
        "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: cam\n"
        f"height: {m.height}\nwidth: {m.width}\ndistortion_model: {_ros_name(m)}\nd:\n{_block(D_)}k:\n{_block(m.K())}"
        f"r:\n{_block(np.eye(3))}p:\n{_block(np.hstack([m.K(), np.zeros((3, 1))]))}binning_x: 0\nbinning_y: 0\n"
        "roi:\n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: false\n---\n"
    )


def ros_ini(rig: Rig) -> str:
    """Write ost.txt of ROS's camera_calibration."""
    m = rig.model

    def matrix(M: Float) -> str:
        return "\n".join(" ".join(f"{value!r}" for value in row.tolist()) for row in M)

    P_ = np.hstack([m.K(), np.zeros((3, 1))])
    return (
        f"# oST version 5.0 parameters\n\n[image]\n\nwidth\n{m.width}\n\nheight\n{m.height}\n\n[narrow_stereo]\n\n"
        f"camera matrix\n{matrix(m.K())}\n\ndistortion\n{matrix(np.array([_radtan(m, 5)]))}\n\n"
        f"rectification\n{matrix(np.eye(3))}\n\nprojection\n{matrix(P_)}\n"
    )


def opencv_yaml(rig: Rig) -> str:
    """Write what OpenCV's calibration sample writes."""
    m = rig.model
    fisheye = f"fisheye_model: {int(m.kind is E)}\n"
    return (
        f'%YAML:1.0\n---\ncalibration_time: "Mon"\nnr_of_frames: 20\nimage_width: {m.width}\nimage_height: {m.height}\n'
        f"board_width: 9\nboard_height: 6\nsquare_size: 50.\nfix_aspect_ratio: 1.\nflags: 2\n{fisheye}"
        + _matrix("camera_matrix", m.K())
        + _matrix("distortion_coefficients", np.array([m.distortion or (0.0,) * 5]).T)
        + "avg_reprojection_error: 0.3\n"
    )


def opencv_xml(rig: Rig) -> str:
    """Write the XML of OpenCV's FileStorage."""
    m = rig.model

    def matrix(name: str, M: Float) -> str:
        data = " ".join(repr(float(value)) for value in M.ravel())
        return (
            f'<{name} type_id="opencv-matrix">\n  <rows>{M.shape[0]}</rows>\n  <cols>{M.shape[1]}</cols>\n'
            f"  <dt>d</dt>\n  <data>\n    {data}</data></{name}>\n"
        )

    return (
        '<?xml version="1.0"?>\n<opencv_storage>\n<calibration_Time>"Mon"</calibration_Time>\n'
        f"<image_Width>{m.width}</image_Width>\n<image_Height>{m.height}</image_Height>\n"
        + matrix("Camera_Matrix", m.K())
        + matrix("Distortion_Coefficients", np.array([m.distortion or (0.0,) * 5]).T)
        + "<Avg_Reprojection_Error>0.3</Avg_Reprojection_Error>\n</opencv_storage>\n"
    )


def opencv_json(rig: Rig) -> str:
    """Write the JSON of OpenCV's FileStorage."""
    m = rig.model

    def matrix(M: Float) -> dict[str, Any]:
        return {"type_id": "opencv-matrix", "rows": len(M), "cols": M.shape[1], "dt": "d", "data": M.ravel().tolist()}

    D_ = np.array([m.distortion or (0.0,) * 5])
    table = {"image_width": m.width, "image_height": m.height, "camera_matrix": matrix(m.K())}
    return json.dumps({**table, "distortion_coefficients": matrix(D_)})


def opencv_stereo(rig: Rig) -> str:
    """Write intrinsics.yml of OpenCV's stereo sample: both cameras, without a size."""
    m = rig.model
    D_ = np.array([m.distortion or (0.0,) * 5])
    left = _matrix("M1", m.K()) + _matrix("D1", D_)
    return "%YAML:1.0\n---\n" + left + _matrix("M2", 2 * m.K()) + _matrix("D2", np.zeros((1, 5)))


def orb_slam2(rig: Rig) -> str:
    """Write ORB-SLAM 2's settings: dotted keys, no size."""
    m = rig.model
    keys = zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"), (*_focal(m), *_radtan(m, 5)), strict=True)
    return (
        "%YAML:1.0\n\n#----\n# Camera Parameters\n"
        + "".join(f"Camera.{key}: {value!r}\n" for key, value in keys)
        + "\nCamera.fps: 30.0\nCamera.RGB: 1\nORBextractor.nFeatures: 1000\nViewer.KeyFrameSize: 0.05\n"
    )


def orb_slam3(rig: Rig) -> str:
    """Write ORB-SLAM 3's settings of version 1.0."""
    m = rig.model
    names = ("k1", "k2", "k3", "k4") if m.kind is E else ("k1", "k2", "p1", "p2", "k3")
    keys = zip(("fx", "fy", "cx", "cy", *names), (*_focal(m), *_radtan(m, len(names))), strict=True)
    return (
        f'%YAML:1.0\n\nFile.version: "1.0"\nCamera.type: "{"KannalaBrandt8" if m.kind is E else "PinHole"}"\n'
        + "".join(f"Camera1.{key}: {value!r}\n" for key, value in keys)
        + f"Camera.width: {m.width}\nCamera.height: {m.height}\nCamera.newWidth: {m.width // 2}\nCamera.fps: 20\n"
        + _matrix("IMU.T_b_c1", rig.T_body_camera)
        + "IMU.NoiseGyro: 1.7e-4\nORBextractor.nFeatures: 1000\n"
    )


def camodocal(rig: Rig) -> str:
    """Write a camera of VINS-Fusion."""
    m = rig.model

    def part(name: str, keys: Sequence[str], values: Sequence[float]) -> str:
        return f"{name}:\n" + "".join(f"   {key}: {value!r}\n" for key, value in zip(keys, values, strict=True))

    kind = {P: "PINHOLE", E: "KANNALA_BRANDT", MEI: "MEI"}[m.kind]
    head = (
        f"%YAML:1.0\n---\nmodel_type: {kind}\ncamera_name: camera\nimage_width: {m.width}\nimage_height: {m.height}\n"
    )
    if m.kind is E:
        keys = ("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0")
        return head + part("projection_parameters", keys, (*_radtan(m, 4), *_focal(m)))
    distortion = part("distortion_parameters", ("k1", "k2", "p1", "p2"), _radtan(m, 4))
    if m.kind is P:
        return head + distortion + part("projection_parameters", ("fx", "fy", "cx", "cy"), _focal(m))
    mirror = part("mirror_parameters", ("xi",), m.shape)
    return head + mirror + distortion + part("projection_parameters", ("gamma1", "gamma2", "u0", "v0"), _focal(m))


def vins_mono(rig: Rig) -> str:
    """Write VINS-Mono's settings: camera and mounting in one file."""
    R, t = rig.T_body_camera[:3, :3], rig.T_body_camera[:3, 3:]
    rest = 'imu_topic: "/imu0"\nestimate_extrinsic: 0\nmax_cnt: 150\n'
    return (
        camodocal(rig) + rest + _matrix("extrinsicRotation", R) + _matrix("extrinsicTranslation", t) + "g_norm: 9.81\n"
    )


def basalt(rig: Rig) -> str:
    """Write Basalt's calibration."""
    m = rig.model
    focal = dict(zip(("fx", "fy", "cx", "cy"), _focal(m), strict=True))
    keys: tuple[str, ...] = {
        P: (),
        E: ("k1", "k2", "k3", "k4"),
        D: ("xi", "alpha"),
        U: ("alpha", "beta"),
        F: ("w",),
    }.get(m.kind, ())
    if m.kind is P and m.distortion:
        keys = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    kind = {P: "pinhole-radtan8" if m.distortion else "pinhole", E: "kb4", D: "ds", U: "eucm", F: "fov"}[m.kind]
    values = m.shape or _radtan(m, len(keys))
    numbers = {**focal, **dict(zip(keys, values, strict=True))}
    w, x, y, z = q_wxyz_from_R(rig.T_body_camera[:3, :3])
    t = rig.T_body_camera[:3, 3]
    pose = dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), map(float, (*t, x, y, z, w)), strict=True))
    value = {
        "T_imu_cam": [pose],
        "intrinsics": [{"camera_type": kind, "intrinsics": numbers}],
        "imu_update_rate": 200.0,
    }
    return json.dumps({"value0": {**value, "resolution": [[m.width, m.height]]}}, indent=1)


def colmap(rig: Rig) -> str:
    """Write COLMAP's cameras.txt."""
    m = rig.model
    name = {P: {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}.get(len(m.distortion), ""), E: "OPENCV_FISHEYE", F: "FOV"}[
        m.kind
    ]
    numbers = " ".join(map(repr, (*_focal(m), *(m.shape or m.distortion))))
    return (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: 1\n1 {name} {m.width} {m.height} {numbers}\n"
    )


def nerfstudio(rig: Rig) -> str:
    """Write transforms.json."""
    m = rig.model
    names = ("k1", "k2", "k3", "k4") if m.kind is E else ("k1", "k2", "p1", "p2")
    table: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if m.kind is E else "OPENCV", "w": m.width, "h": m.height}
    table |= dict(zip(("fl_x", "fl_y", "cx", "cy", *names), (*_focal(m), *_radtan(m, 4)), strict=True))
    frames = [{"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist()}]
    return json.dumps({**table, "frames": frames, "applied_transform": np.eye(3, 4).tolist()})


def dso(rig: Rig) -> str:
    """Write camera.txt of DSO; FOV with lengths relative to the size, as TUM's monocular data set has them."""
    m = rig.model
    numbers = " ".join(map(repr, (*_focal(m), *_radtan(m, 4))))
    first = f"{'RadTan' if m.kind is P else 'KannalaBrandt'} {numbers}"
    if m.kind is F:
        relative = m.fx / m.width, m.fy / m.height, (m.cx + 0.5) / m.width, (m.cy + 0.5) / m.height
        first = " ".join(map(repr, (*relative, *m.shape)))
    return f"{first}\n{m.width} {m.height}\ncrop\n640 480\n"


def rtabmap(rig: Rig) -> str:
    """Write what RTAB-Map exports."""
    m = rig.model
    head = f'%YAML:1.0\n---\ncamera_name: "left"\nimage_width: {m.width}\nimage_height: {m.height}\n'
    D_ = np.array([_radtan(m, 5 if m.kind is P else 4)])
    return (
        head + _matrix("camera_matrix", m.K()) + _matrix("distortion_coefficients", D_)
        + f"distortion_model: {_ros_name(m)}\n" + _matrix("rectification_matrix", np.eye(3))
        + _matrix("local_transform", rig.T_body_camera[:3])
    )  # fmt: skip


def svo(rig: Rig) -> str:
    """Write a rig of SVO and maplab."""
    m = rig.model
    kind = {P: "radial-tangential", E: "equidistant"}[m.kind] if m.distortion else "none"
    parameters = _matrix("parameters", np.array([m.distortion]).T, False, "      ") if m.distortion else ""
    return (
        "cameras:\n- camera:\n"
        f"    distortion:\n{parameters}      type: {kind}\n    image_height: {m.height}\n    image_width: {m.width}\n"
        + _matrix("intrinsics", np.array([_focal(m)]).T, False, "    ")
        + "    label: cam0\n    line-delay-nanoseconds: 0\n    type: pinhole\n"
        + _matrix("T_B_C", rig.T_body_camera, False, "  ")
        + "label: rig\n"
    )


def okvis(rig: Rig) -> str:
    """Write OKVIS's settings."""
    m = rig.model
    kind = {P: "radialtangential", E: "equidistant"}[m.kind]
    return (
        f"%YAML:1.0\ncameras:\n  - {{T_SC: {_list(rig.T_body_camera)},\n"
        f"     image_dimension: [{m.width}, {m.height}],\n"
        f"     distortion_coefficients: {_list(_radtan(m, 4))},\n     distortion_type: {kind},\n"
        f"     focal_length: [{m.fx!r}, {m.fy!r}],\n     principal_point: [{m.cx!r}, {m.cy!r}]}}\n"
        "camera_params:\n    camera_rate: 20\nimu_params:\n    a_max: 176.0\n"
    )


def mast3r_slam(rig: Rig) -> str:
    """Write intrinsics.yaml of MASt3R-SLAM."""
    m = rig.model
    numbers = _list((*_focal(m), *m.distortion))
    return f"width: {m.width}\nheight: {m.height}\n# fx, fy, cx, cy, k1, ...\ncalibration: {numbers}\n"


def droid(rig: Rig) -> str:
    """Write the one line of DROID-SLAM."""
    return " ".join(map(repr, (*_focal(rig.model), *rig.model.distortion))) + "\n"


def matrix_text(rig: Rig) -> str:
    """Write a 4x4 matrix, as ScanNet has it."""
    M = np.eye(4)
    M[:3, :3] = rig.model.K()
    return "\n".join(" ".join(map(repr, row)) for row in M.tolist()) + "\n"


def kitti(rig: Rig) -> str:
    """Write calib.txt of KITTI's odometry sequences, of which only P0 is of the camera that is the body."""
    P0 = np.hstack([rig.model.K(), np.zeros((3, 1))])
    return f"P0: {' '.join(map(repr, P0.ravel().tolist()))}\nTr: {' '.join(['0'] * 12)}\n"


def kitti_raw(rig: Rig) -> str:
    """Write calib_cam_to_cam.txt of KITTI's raw drives, with one camera."""
    m = rig.model
    P0 = np.hstack([m.K(), np.zeros((3, 1))])
    return (
        "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
        f"S_rect_00: {m.width} {m.height}\nR_rect_00: {' '.join(['0'] * 9)}\n"
        f"P_rect_00: {' '.join(map(repr, P0.ravel().tolist()))}\n"
    )


def open3d(rig: Rig) -> str:
    """Write Open3D's camera: the matrix by columns."""
    m = rig.model
    return json.dumps({"width": m.width, "height": m.height, "intrinsic_matrix": m.K().T.ravel().tolist()})


def replica(rig: Rig) -> str:
    """Write cam_params.json of Replica's renderings."""
    m = rig.model
    focal = dict(zip(("fx", "fy", "cx", "cy"), _focal(m), strict=True))
    return json.dumps({"camera": {"w": m.width, "h": m.height, **focal, "scale": 6553.5}})


def opensfm(rig: Rig) -> str:
    """Write camera_models.json of OpenSfM."""
    m = rig.model
    side = max(m.width, m.height)
    place = {"c_x": (m.cx + 0.5 - m.width / 2) / side, "c_y": (m.cy + 0.5 - m.height / 2) / side}
    names = ("k1", "k2", "k3", "k4") if m.kind is E else ("k1", "k2", "p1", "p2", "k3")
    values = dict(zip(names, _radtan(m, len(names)), strict=True))
    kind = "fisheye_opencv" if m.kind is E else "brown"
    table = {
        "projection_type": kind,
        "width": m.width,
        "height": m.height,
        "focal_x": m.fx / side,
        "focal_y": m.fy / side,
    }
    return json.dumps({"v2 maker model": {**table, **place, **values}})


def depthai(rig: Rig) -> str:
    """Write a board's calibration of DepthAI, with one camera."""
    m = rig.model
    camera = {
        "cameraType": int(m.kind is E), "distortionCoeff": list(_radtan(m, 14)), "width": m.width, "height": m.height,
        "intrinsicMatrix": m.K().tolist(), "lensPosition": 0, "specHfovDeg": 70.0,
    }  # fmt: skip
    return json.dumps({"boardName": "BW1098OBC", "cameraData": [[0, camera]], "version": 6})


def gyroflow(rig: Rig) -> str:
    """Write a lens profile of Gyroflow."""
    m = rig.model
    lens = {"RMS_error": 0.5, "camera_matrix": m.K().tolist(), "distortion_coeffs": list(m.distortion)}
    size = {"w": m.width, "h": m.height}
    return json.dumps({"camera_brand": "a", "calib_dimension": size, "fisheye_params": lens, "fps": 60.0})


def vikit(rig: Rig) -> str:
    """Write camera.yaml of rpg's vikit; ATAN with lengths relative to the size."""
    m = rig.model
    focal = _focal(m)
    if m.kind is F:
        focal = m.fx / m.width, m.fy / m.height, (m.cx + 0.5) / m.width, (m.cy + 0.5) / m.height
    name = {P: "Pinhole", F: "ATAN", E: "EquidistantCamera"}[m.kind]
    keys = "".join(f"cam_{key}: {value!r}\n" for key, value in zip(("fx", "fy", "cx", "cy"), focal, strict=True))
    values = m.shape or _radtan(m, 4)
    keys += "".join(f"cam_d{k}: {value!r}\n" for k, value in enumerate(values))
    return f"cam_model: {name}\ncam_width: {m.width}\ncam_height: {m.height}\nscale: 0.5\n{keys}"


def record3d(rig: Rig) -> str:
    """Write the metadata of a capture of Record3D: the matrix by columns, and the poses of the phone."""
    m = rig.model
    poses = [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]
    return json.dumps({"w": m.width, "h": m.height, "K": m.K().T.ravel().tolist(), "fps": 60, "poses": poses})


def spectacular(rig: Rig) -> str:
    """Write calibration.json of SpectacularAI."""
    m = rig.model
    names = ("focalLengthX", "focalLengthY", "principalPointX", "principalPointY")
    camera: dict[str, Any] = dict(zip(names, _focal(m), strict=True))
    camera |= {"imageWidth": m.width, "imageHeight": m.height, "imuToCamera": inverse(rig.T_body_camera).tolist()}
    camera |= {
        "model": "kannala-brandt4" if m.kind is E else "brown-conrady",
        "distortionCoefficients": list(_radtan(m, 4)),
    }
    return json.dumps({"cameras": [camera]})


def zed(rig: Rig) -> str:
    """Write SNxxxx.conf of a ZED camera, of which one section is of the images' size."""
    m = rig.model
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    keys = "".join(f"{key}={value!r}\n" for key, value in zip(names, (*_focal(m), *_radtan(m, 5)), strict=True))
    name = {(672, 376): "VGA", (1280, 720): "HD", (1920, 1080): "FHD"}[(m.width, m.height)]
    other = "fx=1\nfy=1\ncx=1\ncy=1\n"
    return f"[LEFT_CAM_2K]\n{other}\n[LEFT_CAM_{name}]\n{keys}\n[RIGHT_CAM_{name}]\n{other}\n[STEREO]\nBaseline=119.9\n"


def zed_apart(rig: Rig) -> str:
    """Write SNxxxx.conf as newer tools of ZED do, with one distortion for all sizes of pictures."""
    m = rig.model
    bare = re.sub(r"^[kp]\d=.*\n", "", zed(Rig(replace(m, distortion=()), rig.T_body_camera)), flags=re.MULTILINE)
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    values = "".join(f"{key}={value!r}\n" for key, value in zip(names, _radtan(m, 8), strict=True))
    return f"{bare}\n[LEFT_DISTO]\n{values}\n[RIGHT_DISTO]\nk1=0.1\n\n[MISC]\nSensor_ID=1\n"


def realsense(rig: Rig) -> str:
    """Write pyrealsense2's intrinsics, as people dump them."""
    m = rig.model
    names = ("fx", "fy", "ppx", "ppy")
    model = "kannala_brandt4" if m.kind is E else "brown_conrady" if any(m.distortion) else "inverse_brown_conrady"
    table: dict[str, Any] = {"width": m.width, "height": m.height, **dict(zip(names, _focal(m), strict=True))}
    return json.dumps({**table, "model": f"distortion.{model}", "coeffs": [*_radtan(m, 5)]})


def okvis2(rig: Rig) -> str:
    """Write settings of OKVIS 2, whose camera_type is that of the pictures."""
    return okvis(rig).replace(
        "distortion_type", "camera_type: gray,\n        slam_use: okvis,\n        distortion_type"
    )


def opencv_fisheye_stereo(rig: Rig) -> str:
    """Write K1 D1 K2 D2 of a pair of cameras."""
    text = opencv_stereo(rig)
    return re.sub(r"^M([12]):", r"K\1:", text, flags=re.MULTILINE)


def scannet(rig: Rig) -> str:
    """Write scene0000_00.txt of ScanNet."""
    m = rig.model
    focal = "".join(f"{key} = {value!r}\n" for key, value in zip(
        ("fx_color", "fy_color", "mx_color", "my_color"), _focal(m), strict=True
    ))  # fmt: skip
    return f"axisAlignment = 1 0 0 0\ncolorHeight = {m.height}\ncolorWidth = {m.width}\nfx_depth = 5\n{focal}"


def bundlefusion(rig: Rig) -> str:
    """Write _info.txt of BundleFusion's recordings."""
    m = rig.model
    K = np.eye(4)
    K[:3, :3] = m.K()
    row = " ".join(map(repr, K.ravel().tolist()))
    return (
        f"m_versionNumber = 4\nm_colorWidth = {m.width}\nm_colorHeight = {m.height}\nm_depthWidth = 1\n"
        f"m_calibrationColorIntrinsic = {row}\nm_calibrationDepthIntrinsic = 1 0 0 0\nm_frames.size = 9\n"
    )


def nested(rig: Rig) -> str:
    """Write the settings of a neural SLAM, with the camera somewhere inside (NICE-SLAM, MonoGS)."""
    m = rig.model
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    keys = "".join(f"    {key}: {value!r}\n" for key, value in zip(names, (*_focal(m), *_radtan(m, 5)), strict=True))
    size = f"    width: {m.width}\n    height: {m.height}\n    depth_scale: 5000.0\n    distorted: True\n"
    return f"Results:\n  save_dir: out/a\nDataset:\n  type: tum\n  Calibration:\n{keys}{size}Training:\n  lr: 0.1\n"


FORMS: dict[str, WriterForm] = {
    "flocc YAML": WriterForm("camera.yaml", flat, mounting=True),
    "flocc TOML": WriterForm("camera.toml", toml, (P, E, F, MEI, D, U), (0, 4, 5, 8, 12, 14), True),
    "EuRoC, Kimera": WriterForm("sensor.yaml", euroc, (P, E), (4,), True),
    "Kalibr": WriterForm("camchain.yaml", kalibr, (P, E, F, MEI, D, U), mounting=True, shift=True),
    "OpenVINS": WriterForm("kalibr_imucam_chain.yaml", openvins, (P, E), (4,), True),
    "ROS camera_info": WriterForm("ost.yaml", camera_info, (P, E), (0, 4, 5, 8)),
    "ros2 topic echo": WriterForm("echo.yaml", topic_echo, (P, E), (0, 4, 5, 8)),
    "ROS INI": WriterForm("ost.txt", ros_ini, counts=(0, 4, 5)),
    "OpenCV YAML": WriterForm("out_camera_data.yml", opencv_yaml, (P, E), (0, 4, 5, 8, 12, 14)),
    "OpenCV XML": WriterForm("out_camera_data.xml", opencv_xml, counts=(0, 4, 5, 8, 12, 14)),
    "OpenCV JSON": WriterForm("out_camera_data.json", opencv_json, counts=(0, 4, 5, 8, 12, 14)),
    "OpenCV stereo": WriterForm("intrinsics.yml", opencv_stereo, counts=(0, 4, 5, 8), sized=False),
    "ORB-SLAM 2": WriterForm("TUM1.yaml", orb_slam2, counts=(0, 4, 5), sized=False),
    "ORB-SLAM 3": WriterForm("EuRoC.yaml", orb_slam3, (P, E), (0, 4, 5), True),
    "VINS-Fusion (camodocal)": WriterForm("cam0.yaml", camodocal, (P, E, MEI)),
    "VINS-Mono": WriterForm("euroc_config.yaml", vins_mono, (P, E, MEI), mounting=True),
    "Basalt": WriterForm("calibration.json", basalt, (P, E, F, D, U), (0, 4, 5, 8), True),
    "COLMAP": WriterForm("cameras.txt", colmap, (P, E, F), (0, 4, 8)),
    "nerfstudio, instant-ngp": WriterForm("transforms.json", nerfstudio, (P, E)),
    "DSO, TUM monoVO": WriterForm("camera.txt", dso, (P, E, F)),
    "RTAB-Map": WriterForm("rtabmap_camera.yaml", rtabmap, (P, E), (0, 4, 5, 8), True),
    "SVO, maplab": WriterForm("svo.yaml", svo, (P, E), mounting=True),
    "OKVIS": WriterForm("config_fpga_p2_euroc.yaml", okvis, (P, E), (4,), True),
    "MASt3R-SLAM": WriterForm("intrinsics.yaml", mast3r_slam, counts=(0, 4, 5, 8)),
    "DROID-SLAM": WriterForm("droid.txt", droid, counts=(0, 4, 5, 8), sized=False),
    "matrix (7-Scenes, ScanNet, Stray Scanner)": WriterForm(
        "intrinsic_color.txt", matrix_text, counts=(0,), sized=False
    ),
    "KITTI odometry": WriterForm("calib.txt", kitti, counts=(0,), sized=False),
    "KITTI raw": WriterForm("calib_cam_to_cam.txt", kitti_raw, counts=(0,)),
    "Open3D": WriterForm("camera_intrinsic.json", open3d, counts=(0,)),
    "Replica": WriterForm("cam_params.json", replica, counts=(0,)),
    "OpenSfM, ODM": WriterForm("camera_models.json", opensfm, (P, E), (0, 4, 5)),
    "DepthAI": WriterForm("depthai.json", depthai, (P, E), (0, 4, 5, 8, 12, 14)),
    "Gyroflow": WriterForm("gyroflow.json", gyroflow, (E,)),
    "vikit (SVO 1, FAST-LIVO)": WriterForm("pinhole.yaml", vikit, (P, E, F)),
    "Record3D": WriterForm("metadata.json", record3d, counts=(0,)),
    "SpectacularAI": WriterForm("spectacular.json", spectacular, (P, E), mounting=True),
    "ZED": WriterForm("SN123.conf", zed, counts=(0, 4, 5), sizes=((672, 376), (1280, 720), (1920, 1080)), sized=False),
    "ZED, distortion apart": WriterForm(
        "SN124.conf", zed_apart, counts=(0, 8), sizes=((672, 376), (1280, 720), (1920, 1080)), sized=False
    ),
    "RealSense (pyrealsense2)": WriterForm("realsense.json", realsense, (P, E), (0, 4, 5)),
    "OKVIS 2": WriterForm("okvis2.yaml", okvis2, (P, E), (4,), True),
    "OpenCV stereo, K1 D1": WriterForm("stereo.yml", opencv_fisheye_stereo, counts=(5, 8), sized=False),
    "ScanNet scene": WriterForm("scene0000_00.txt", scannet, counts=(0,)),
    "BundleFusion": WriterForm("_info.txt", bundlefusion, counts=(0,)),
    "NICE-SLAM, MonoGS": WriterForm("fr1_desk.yaml", nested, counts=(0, 4, 5)),
}
"""Every form that is read, by the name that docs/data-sets.md has for it."""

REFUSED: dict[str, tuple[str, str]] = {
    "COLMAP binary": ("cameras.bin", "\0\1\0\0"),
    "MATLAB": ("cameraParams.mat", "MATLAB 5.0 MAT-file\0\0"),
    "numpy": ("calib.npz", "PK\3\4\0\0"),
    "Kalibr report": ("results-cam.txt", "Calibration results \n====================\nCamera-system parameters:\n"),
    "Kalibr target or IMU": ("target.yaml", "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\n"),
    "OCamCalib (Scaramuzza)": (
        "calib_results.txt",
        "#polynomial coefficients for the DIRECT mapping function\n5 -1 0 1\n",
    ),
    "camodocal Scaramuzza": ("cam.yaml", "%YAML:1.0\nmodel_type: SCARAMUZZA\nimage_width: 6\nimage_height: 4\n"),
    "mrcal": ("camera-0.cameramodel", "{'lensmodel': 'LENSMODEL_OPENCV8',\n 'intrinsics': [1,2,3,4]}\n"),
    "Metashape": ("cam.xml", "<?xml version='1.0'?><calibration><projection>frame</projection><f>1</f></calibration>"),
    "Meshroom": ("scene.sfm", '{"views": [], "intrinsics": [], "poses": []}'),
    "Bundler, VisualSFM": ("bundle.out", "# Bundle file v0.3\n1 1\n"),
    "COLMAP thin prism": ("cameras.txt", "1 THIN_PRISM_FISHEYE 640 480 500 500 320 240 0 0 0 0 0 0 0 0\n"),
    "rs-enumerate-devices": (
        "realsense.txt",
        ' Intrinsic of "Color" / 640x480\n  PPX:  320.6\n  Distortion: Inverse Brown Conrady\n',
    ),
    "Azure Kinect": ("kinect.json", '{"CalibrationInformation": {"Cameras": []}}'),
    "calib.io": ("calibio.json", '{"Calibration": {"cameras": []}}'),
    "Project Aria": ("aria.json", '{"CameraCalibrations": [{"Label": "camera-rgb"}]}'),
    "EasyMocap": ("intri.yml", '%YAML:1.0\n---\nnames:\n  - "1"\nK_1: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n'),
    "Pix4D": ("pix4d.cam", "Pix4D camera calibration file 0\n#Focal Length mm\nF 8.8\n"),
    "Middlebury stereo": ("calib.txt", "cam0=[600 0 320; 0 600 240; 0 0 1]\nwidth=640\nheight=480\n"),
    "MRPT": ("mrpt.ini", "[CAMERA_PARAMS]\nresolution=[640 480]\nfx=600\n"),
    "cuVSLAM EDEX": ("stereo.edex", '[{"version": "0.9", "cameras": []}]'),
    "ROS launch file": ("camera.launch", "<launch>\n<node pkg='a'/></launch>\n"),
}
"""Forms that are refused by name, with a file of each."""
