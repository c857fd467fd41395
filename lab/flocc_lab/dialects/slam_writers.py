"""Calibrations as SLAM and odometry systems keep them in their settings: one writer per form, of a drawn camera."""

import json
from collections.abc import Sequence

import numpy as np

from flocc_agent.geometry import q_wxyz_from_R
from flocc_lab.dialects.calibration_form import (
    MEI,
    D,
    E,
    F,
    P,
    Rig,
    U,
    focal_of,
    matrix_rows,
    number_list,
    opencv_matrix,
    radtan_of,
    ros_name,
)


def openvins(rig: Rig) -> str:
    """Write kalibr_imucam_chain.yaml of OpenVINS."""
    m = rig.model
    return (
        f"%YAML:1.0\n\ncam0:\n  T_imu_cam: #rotation from camera to IMU R_CtoI\n"
        f"{matrix_rows(rig.T_body_camera, '    ')}"
        f"  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_coeffs: {number_list(radtan_of(m, 4))}\n"
        f"  distortion_model: {'radtan' if m.kind is P else 'equidistant'}\n"
        f"  intrinsics: {number_list(focal_of(m))} #fu, fv, cu, cv\n"
        f"  resolution: [{m.width}, {m.height}]\n  rostopic: /cam0/image_raw\n"
    )


def orb_slam2(rig: Rig) -> str:
    """Write ORB-SLAM 2's settings: dotted keys, no size."""
    m = rig.model
    keys = zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"), (*focal_of(m), *radtan_of(m, 5)), strict=True)
    return (
        "%YAML:1.0\n\n#----\n# Camera Parameters\n"
        + "".join(f"Camera.{key}: {value!r}\n" for key, value in keys)
        + "\nCamera.fps: 30.0\nCamera.RGB: 1\nORBextractor.nFeatures: 1000\nViewer.KeyFrameSize: 0.05\n"
    )


def orb_slam3(rig: Rig) -> str:
    """Write ORB-SLAM 3's settings of version 1.0."""
    m = rig.model
    names = ("k1", "k2", "k3", "k4") if m.kind is E else ("k1", "k2", "p1", "p2", "k3")
    keys = zip(("fx", "fy", "cx", "cy", *names), (*focal_of(m), *radtan_of(m, len(names))), strict=True)
    return (
        f'%YAML:1.0\n\nFile.version: "1.0"\nCamera.type: "{"KannalaBrandt8" if m.kind is E else "PinHole"}"\n'
        + "".join(f"Camera1.{key}: {value!r}\n" for key, value in keys)
        + f"Camera.width: {m.width}\nCamera.height: {m.height}\nCamera.newWidth: {m.width // 2}\nCamera.fps: 20\n"
        + opencv_matrix("IMU.T_b_c1", rig.T_body_camera)
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
        return head + part("projection_parameters", keys, (*radtan_of(m, 4), *focal_of(m)))
    distortion = part("distortion_parameters", ("k1", "k2", "p1", "p2"), radtan_of(m, 4))
    if m.kind is P:
        return head + distortion + part("projection_parameters", ("fx", "fy", "cx", "cy"), focal_of(m))
    mirror = part("mirror_parameters", ("xi",), m.shape)
    return head + mirror + distortion + part("projection_parameters", ("gamma1", "gamma2", "u0", "v0"), focal_of(m))


def vins_mono(rig: Rig) -> str:
    """Write VINS-Mono's settings: camera and mounting in one file."""
    R, t = rig.T_body_camera[:3, :3], rig.T_body_camera[:3, 3:]
    rest = 'imu_topic: "/imu0"\nestimate_extrinsic: 0\nmax_cnt: 150\n'
    mounting = opencv_matrix("extrinsicRotation", R) + opencv_matrix("extrinsicTranslation", t)
    return f"{camodocal(rig)}{rest}{mounting}g_norm: 9.81\n"


def basalt(rig: Rig) -> str:
    """Write Basalt's calibration."""
    m = rig.model
    focal = dict(zip(("fx", "fy", "cx", "cy"), focal_of(m), strict=True))
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
    values = m.shape or radtan_of(m, len(keys))
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


def dso(rig: Rig) -> str:
    """Write camera.txt of DSO; FOV with lengths relative to the size, as TUM's monocular data set has them."""
    m = rig.model
    numbers = " ".join(map(repr, (*focal_of(m), *radtan_of(m, 4))))
    first = f"{'RadTan' if m.kind is P else 'KannalaBrandt'} {numbers}"
    if m.kind is F:
        relative = m.fx / m.width, m.fy / m.height, (m.cx + 0.5) / m.width, (m.cy + 0.5) / m.height
        first = " ".join(map(repr, (*relative, *m.shape)))
    return f"{first}\n{m.width} {m.height}\ncrop\n640 480\n"


def rtabmap(rig: Rig) -> str:
    """Write what RTAB-Map exports."""
    m = rig.model
    head = f'%YAML:1.0\n---\ncamera_name: "left"\nimage_width: {m.width}\nimage_height: {m.height}\n'
    D_ = np.array([radtan_of(m, 5 if m.kind is P else 4)])
    return (
        head + opencv_matrix("camera_matrix", m.K()) + opencv_matrix("distortion_coefficients", D_)
        + f"distortion_model: {ros_name(m)}\n" + opencv_matrix("rectification_matrix", np.eye(3))
        + opencv_matrix("local_transform", rig.T_body_camera[:3])
    )  # fmt: skip


def svo(rig: Rig) -> str:
    """Write a rig of SVO and maplab."""
    m = rig.model
    kind = {P: "radial-tangential", E: "equidistant"}[m.kind] if m.distortion else "none"
    parameters = opencv_matrix("parameters", np.array([m.distortion]).T, False, "      ") if m.distortion else ""
    return (
        "cameras:\n- camera:\n"
        f"    distortion:\n{parameters}      type: {kind}\n    image_height: {m.height}\n    image_width: {m.width}\n"
        + opencv_matrix("intrinsics", np.array([focal_of(m)]).T, False, "    ")
        + "    label: cam0\n    line-delay-nanoseconds: 0\n    type: pinhole\n"
        + opencv_matrix("T_B_C", rig.T_body_camera, False, "  ")
        + "label: rig\n"
    )


def okvis(rig: Rig) -> str:
    """Write OKVIS's settings."""
    m = rig.model
    kind = {P: "radialtangential", E: "equidistant"}[m.kind]
    return (
        f"%YAML:1.0\ncameras:\n  - {{T_SC: {number_list(rig.T_body_camera)},\n"
        f"     image_dimension: [{m.width}, {m.height}],\n"
        f"     distortion_coefficients: {number_list(radtan_of(m, 4))},\n     distortion_type: {kind},\n"
        f"     focal_length: [{m.fx!r}, {m.fy!r}],\n     principal_point: [{m.cx!r}, {m.cy!r}]}}\n"
        "camera_params:\n    camera_rate: 20\nimu_params:\n    a_max: 176.0\n"
    )


def mast3r_slam(rig: Rig) -> str:
    """Write intrinsics.yaml of MASt3R-SLAM."""
    m = rig.model
    numbers = number_list((*focal_of(m), *m.distortion))
    return f"width: {m.width}\nheight: {m.height}\n# fx, fy, cx, cy, k1, ...\ncalibration: {numbers}\n"


def droid(rig: Rig) -> str:
    """Write the one line of DROID-SLAM."""
    return " ".join(map(repr, (*focal_of(rig.model), *rig.model.distortion))) + "\n"


def vikit(rig: Rig) -> str:
    """Write camera.yaml of rpg's vikit; ATAN with lengths relative to the size."""
    m = rig.model
    focal = focal_of(m)
    if m.kind is F:
        focal = m.fx / m.width, m.fy / m.height, (m.cx + 0.5) / m.width, (m.cy + 0.5) / m.height
    name = {P: "Pinhole", F: "ATAN", E: "EquidistantCamera"}[m.kind]
    keys = "".join(f"cam_{key}: {value!r}\n" for key, value in zip(("fx", "fy", "cx", "cy"), focal, strict=True))
    values = m.shape or radtan_of(m, 4)
    keys += "".join(f"cam_d{k}: {value!r}\n" for k, value in enumerate(values))
    return f"cam_model: {name}\ncam_width: {m.width}\ncam_height: {m.height}\nscale: 0.5\n{keys}"


def okvis2(rig: Rig) -> str:
    """Write settings of OKVIS 2, whose camera_type is that of the pictures."""
    return okvis(rig).replace(
        "distortion_type", "camera_type: gray,\n        slam_use: okvis,\n        distortion_type"
    )
