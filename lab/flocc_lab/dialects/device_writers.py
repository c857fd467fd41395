"""Calibrations as cameras, their apps, data sets and reconstruction programs give them: one writer per form."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np

from flocc_agent.geometry import inverse
from flocc_lab.dialects.calibration_form import (
    E,
    F,
    P,
    Rig,
    focal_of,
    radtan_of,
)


def colmap(rig: Rig) -> str:
    """Write COLMAP's cameras.txt."""
    m = rig.model
    name = {P: {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}.get(len(m.distortion), ""), E: "OPENCV_FISHEYE", F: "FOV"}[
        m.kind
    ]
    numbers = " ".join(map(repr, (*focal_of(m), *(m.shape or m.distortion))))
    return (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: 1\n1 {name} {m.width} {m.height} {numbers}\n"
    )


def nerfstudio(rig: Rig) -> str:
    """Write transforms.json."""
    m = rig.model
    names = ("k1", "k2", "k3", "k4") if m.kind is E else ("k1", "k2", "p1", "p2")
    table: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if m.kind is E else "OPENCV", "w": m.width, "h": m.height}
    table |= dict(zip(("fl_x", "fl_y", "cx", "cy", *names), (*focal_of(m), *radtan_of(m, 4)), strict=True))
    frames = [{"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist()}]
    return json.dumps({**table, "frames": frames, "applied_transform": np.eye(3, 4).tolist()})


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
    focal = dict(zip(("fx", "fy", "cx", "cy"), focal_of(m), strict=True))
    return json.dumps({"camera": {"w": m.width, "h": m.height, **focal, "scale": 6553.5}})


def opensfm(rig: Rig) -> str:
    """Write camera_models.json of OpenSfM."""
    m = rig.model
    side = max(m.width, m.height)
    place = {"c_x": (m.cx + 0.5 - m.width / 2) / side, "c_y": (m.cy + 0.5 - m.height / 2) / side}
    names = ("k1", "k2", "k3", "k4") if m.kind is E else ("k1", "k2", "p1", "p2", "k3")
    values = dict(zip(names, radtan_of(m, len(names)), strict=True))
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
        "cameraType": int(m.kind is E), "distortionCoeff": list(radtan_of(m, 14)), "width": m.width, "height": m.height,
        "intrinsicMatrix": m.K().tolist(), "lensPosition": 0, "specHfovDeg": 70.0,
    }  # fmt: skip
    return json.dumps({"boardName": "BW1098OBC", "cameraData": [[0, camera]], "version": 6})


def gyroflow(rig: Rig) -> str:
    """Write a lens profile of Gyroflow."""
    m = rig.model
    lens = {"RMS_error": 0.5, "camera_matrix": m.K().tolist(), "distortion_coeffs": list(m.distortion)}
    size = {"w": m.width, "h": m.height}
    return json.dumps({"camera_brand": "a", "calib_dimension": size, "fisheye_params": lens, "fps": 60.0})


def record3d(rig: Rig) -> str:
    """Write the metadata of a capture of Record3D: the matrix by columns, and the poses of the phone."""
    m = rig.model
    poses = [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]
    return json.dumps({"w": m.width, "h": m.height, "K": m.K().T.ravel().tolist(), "fps": 60, "poses": poses})


def spectacular(rig: Rig) -> str:
    """Write calibration.json of SpectacularAI."""
    m = rig.model
    names = ("focalLengthX", "focalLengthY", "principalPointX", "principalPointY")
    camera: dict[str, Any] = dict(zip(names, focal_of(m), strict=True))
    camera |= {"imageWidth": m.width, "imageHeight": m.height, "imuToCamera": inverse(rig.T_body_camera).tolist()}
    camera |= {
        "model": "kannala-brandt4" if m.kind is E else "brown-conrady",
        "distortionCoefficients": list(radtan_of(m, 4)),
    }
    return json.dumps({"cameras": [camera]})


def zed(rig: Rig) -> str:
    """Write SNxxxx.conf of a ZED camera, of which one section is of the images' size."""
    m = rig.model
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    keys = "".join(f"{key}={value!r}\n" for key, value in zip(names, (*focal_of(m), *radtan_of(m, 5)), strict=True))
    name = {(672, 376): "VGA", (1280, 720): "HD", (1920, 1080): "FHD"}[(m.width, m.height)]
    other = "fx=1\nfy=1\ncx=1\ncy=1\n"
    return f"[LEFT_CAM_2K]\n{other}\n[LEFT_CAM_{name}]\n{keys}\n[RIGHT_CAM_{name}]\n{other}\n[STEREO]\nBaseline=119.9\n"


def zed_apart(rig: Rig) -> str:
    """Write SNxxxx.conf as newer tools of ZED do, with one distortion for all sizes of pictures."""
    m = rig.model
    bare = re.sub(r"^[kp]\d=.*\n", "", zed(Rig(replace(m, distortion=()), rig.T_body_camera)), flags=re.MULTILINE)
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    values = "".join(f"{key}={value!r}\n" for key, value in zip(names, radtan_of(m, 8), strict=True))
    return f"{bare}\n[LEFT_DISTO]\n{values}\n[RIGHT_DISTO]\nk1=0.1\n\n[MISC]\nSensor_ID=1\n"


def realsense(rig: Rig) -> str:
    """Write pyrealsense2's intrinsics, as people dump them."""
    m = rig.model
    names = ("fx", "fy", "ppx", "ppy")
    model = "kannala_brandt4" if m.kind is E else "brown_conrady" if any(m.distortion) else "inverse_brown_conrady"
    table: dict[str, Any] = {"width": m.width, "height": m.height, **dict(zip(names, focal_of(m), strict=True))}
    return json.dumps({**table, "model": f"distortion.{model}", "coeffs": [*radtan_of(m, 5)]})


def scannet(rig: Rig) -> str:
    """Write scene0000_00.txt of ScanNet."""
    m = rig.model
    focal = "".join(f"{key} = {value!r}\n" for key, value in zip(
        ("fx_color", "fy_color", "mx_color", "my_color"), focal_of(m), strict=True
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
