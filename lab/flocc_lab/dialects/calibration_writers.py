"""Calibrations as the field's tools write them: one writer per form, of a drawn camera.

A writer gives a file's name and text, and a form says which camera models and whether a mounting the form can hold.
"""

import json
import re
from typing import Any

import numpy as np

from flocc_agent.geometry import inverse
from flocc_lab.dialects.calibration_form import (
    MEI,
    D,
    E,
    F,
    Float,
    P,
    Rig,
    U,
    WriterForm,
    focal_of,
    kalibr_names,
    matrix_rows,
    number_list,
    opencv_matrix,
    radtan_of,
    ros_name,
    yaml_block,
)
from flocc_lab.dialects.device_writers import (
    bundlefusion,
    colmap,
    depthai,
    gyroflow,
    kitti,
    kitti_raw,
    nerfstudio,
    open3d,
    opensfm,
    realsense,
    record3d,
    replica,
    scannet,
    spectacular,
    zed,
    zed_apart,
)
from flocc_lab.dialects.slam_writers import (
    basalt,
    camodocal,
    droid,
    dso,
    mast3r_slam,
    okvis,
    okvis2,
    openvins,
    orb_slam2,
    orb_slam3,
    rtabmap,
    svo,
    vikit,
    vins_mono,
)


def flat(rig: Rig) -> str:
    """Write flocc's own flat keys."""
    m = rig.model
    keys = "".join(f"{key}: {value!r}\n" for key, value in zip(("fx", "fy", "cx", "cy"), focal_of(m), strict=True))
    distortion = f"distortion: {number_list(radtan_of(m, 4))}\n"
    return f"width: {m.width}\nheight: {m.height}\n{keys}{distortion}T_body_camera:\n{matrix_rows(rig.T_body_camera)}"


def toml(rig: Rig) -> str:
    """Write flocc's camera.toml."""
    m = rig.model
    keys = "".join(f"{key} = {value!r}\n" for key, value in zip(("fx", "fy", "cx", "cy"), focal_of(m), strict=True))
    names = {F: ("omega",), MEI: ("xi",), D: ("xi", "alpha"), U: ("alpha", "beta")}.get(m.kind, ())
    shape = "".join(f"{key} = {value!r}\n" for key, value in zip(names, m.shape, strict=True))
    model = "" if m.kind is P else f"model = {str(m.kind)!r}\n"
    rows = ",".join(number_list(row) for row in rig.T_body_camera)
    distortion = f"distortion = {number_list(m.distortion)}\n" if m.distortion else ""
    return (
        f"[camera]\nwidth = {m.width}\nheight = {m.height}\n{keys}{model}{shape}{distortion}T_body_camera = [{rows}]\n"
    )


def euroc(rig: Rig) -> str:
    """Write sensor.yaml of EuRoC and Kimera."""
    m = rig.model
    return (
        "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0\n"
        + opencv_matrix("T_BS", rig.T_body_camera, tag=False)
        + f"rate_hz: 20\nresolution: [{m.width}, {m.height}]\ncamera_model: pinhole\n"
        f"intrinsics: {number_list(focal_of(m))} #fu, fv\n"
        f"distortion_model: {'radial-tangential' if m.kind is P else 'equidistant'}\n"
        f"distortion_coefficients: {number_list(radtan_of(m, 4))}\n"
    )


def kalibr(rig: Rig) -> str:
    """Write a camchain."""
    m = rig.model
    camera, distortion = kalibr_names(m)
    coefficients = m.shape if m.kind is F else m.distortion
    numbers = (*focal_of(m),) if m.kind is F else (*m.shape, *focal_of(m))
    second = "cam1:\n  camera_model: pinhole\n  intrinsics: [9.0, 9.0, 9.0, 9.0]\n  resolution: [9, 9]\n"
    return (
        f"cam0:\n  T_cam_imu:\n{matrix_rows(inverse(rig.T_body_camera))}  cam_overlaps: [1]\n  camera_model: {camera}\n"
        f"  distortion_coeffs: {number_list(coefficients)}\n  distortion_model: {distortion}\n"
        f"  intrinsics: {number_list(numbers)}\n"
        f"  resolution: [{m.width}, {m.height}]\n  rostopic: /cam0/image_raw\n"
        f"  timeshift_cam_imu: {rig.time_shift_s}\n{second}"
    )


def camera_info(rig: Rig) -> str:
    """Write the YAML of ROS's camera_calibration_parsers."""
    m = rig.model
    D_ = np.array([radtan_of(m, 5 if m.kind is P else 4)])
    P_ = np.hstack([m.K(), np.zeros((3, 1))])
    return (
        f"image_width: {m.width}\nimage_height: {m.height}\ncamera_name: narrow_stereo\n"
        + opencv_matrix("camera_matrix", m.K(), False)
        + f"distortion_model: {ros_name(m)}\n"
        + opencv_matrix("distortion_coefficients", D_, False)
        + opencv_matrix("rectification_matrix", np.eye(3), False)
        + opencv_matrix("projection_matrix", P_, False)
    )


def topic_echo(rig: Rig) -> str:
    """Write what `ros2 topic echo --once camera_info` prints."""
    m = rig.model
    D_ = radtan_of(m, 5 if m.kind is P else 4)
    return (
        "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: cam\n"
        f"height: {m.height}\nwidth: {m.width}\ndistortion_model: {ros_name(m)}\nd:\n{yaml_block(D_)}"
        f"k:\n{yaml_block(m.K())}"
        f"r:\n{yaml_block(np.eye(3))}p:\n{yaml_block(np.hstack([m.K(), np.zeros((3, 1))]))}binning_x: 0\nbinning_y: 0\n"
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
        f"camera matrix\n{matrix(m.K())}\n\ndistortion\n{matrix(np.array([radtan_of(m, 5)]))}\n\n"
        f"rectification\n{matrix(np.eye(3))}\n\nprojection\n{matrix(P_)}\n"
    )


def opencv_yaml(rig: Rig) -> str:
    """Write what OpenCV's calibration sample writes."""
    m = rig.model
    fisheye = f"fisheye_model: {int(m.kind is E)}\n"
    return (
        f'%YAML:1.0\n---\ncalibration_time: "Mon"\nnr_of_frames: 20\nimage_width: {m.width}\nimage_height: {m.height}\n'
        f"board_width: 9\nboard_height: 6\nsquare_size: 50.\nfix_aspect_ratio: 1.\nflags: 2\n{fisheye}"
        + opencv_matrix("camera_matrix", m.K())
        + opencv_matrix("distortion_coefficients", np.array([m.distortion or (0.0,) * 5]).T)
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
    left = opencv_matrix("M1", m.K()) + opencv_matrix("D1", D_)
    return "%YAML:1.0\n---\n" + left + opencv_matrix("M2", 2 * m.K()) + opencv_matrix("D2", np.zeros((1, 5)))


def matrix_text(rig: Rig) -> str:
    """Write a 4x4 matrix, as ScanNet has it."""
    M = np.eye(4)
    M[:3, :3] = rig.model.K()
    return "\n".join(" ".join(map(repr, row)) for row in M.tolist()) + "\n"


def opencv_fisheye_stereo(rig: Rig) -> str:
    """Write K1 D1 K2 D2 of a pair of cameras."""
    text = opencv_stereo(rig)
    return re.sub(r"^M([12]):", r"K\1:", text, flags=re.MULTILINE)


def nested(rig: Rig) -> str:
    """Write the settings of a neural SLAM, with the camera somewhere inside (NICE-SLAM, MonoGS)."""
    m = rig.model
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    keys = "".join(
        f"    {key}: {value!r}\n" for key, value in zip(names, (*focal_of(m), *radtan_of(m, 5)), strict=True)
    )
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
