"""Calibrations that people brought: what is right to read from each, and what is refused, in one sentence."""

from pathlib import Path

import numpy as np
import pytest

from flocc_agent.lenses import CameraModel, LensKind
from flocc_launch.datasets.intrinsics import read_lens
from flocc_launch.datasets.source import DatasetError, Lens
from flocc_protocol.errors import FloccError

ORB3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 150.5
Camera1.fy: 151.5
Camera1.cx: 80.25
Camera1.cy: 60.75
Camera1.k1: -0.3
Camera1.k2: 0.08
Camera1.p1: 0.0002
Camera1.p2: 0.00002
Camera.width: 160
Camera.height: 120
Camera.newWidth: 80
Camera.newHeight: 60
Camera.fps: 20
"""
PINHOLE = CameraModel(160, 120, 150.5, 151.5, 80.0, 60.0, (-0.3, 0.1, 0.001, -0.002))
K = [150.5, 0.0, 80.0, 0.0, 151.5, 60.0, 0.0, 0.0, 1.0]
D = [-0.3, 0.1, 0.001, -0.002, 0.0]
T = [0, 0, 1, 0.1, -1, 0, 0, 0.2, 0, -1, 0, 0.3, 0, 0, 0, 1]


def block(key: str, values: list[float], indent: str = "") -> str:
    return f"{indent}{key}:\n" + "".join(f"{indent}- {value}\n" for value in values)


def read(tmp_path: Path, text: str, name: str = "camera.yaml", size: tuple[int, int] | None = None) -> Lens:
    (tmp_path / name.partition("#")[0]).write_text(text, encoding="utf-8")
    return read_lens(tmp_path / name, size)


def chain(
    model: str, intrinsics: list[float], distortion_model: str, distortion: list[float], name: str = "cam0"
) -> str:
    return (
        f"{name}:\n  cam_overlaps: [1]\n  camera_model: {model}\n  distortion_coeffs: {distortion}\n"
        f"  distortion_model: {distortion_model}\n  intrinsics: {intrinsics}\n  resolution: [160, 120]\n"
    )


@pytest.mark.parametrize("name", ["T_cam_imu", "T_imu_cam"])
def test_a_camera_placed_in_the_one_before_it_sits_where_the_chain_says(tmp_path: Path, name: str) -> None:
    """Kalibr's `T_cn_cnm1`: what was not asked for is not taken as the identity."""
    T_body_cam0 = np.array(T, float).reshape(4, 4)
    T_cam1_cam0 = np.array([[0, -1, 0, -0.11], [1, 0, 0, 0.02], [0, 0, 1, 0.03], [0, 0, 0, 1]], float)
    given = np.linalg.inv(T_body_cam0) if name == "T_cam_imu" else T_body_cam0
    first = chain("pinhole", [150.5, 151.5, 80.0, 60.0], "radtan", [0, 0, 0, 0]) + f"  {name}: {given.tolist()}\n"
    placed = f"  T_cn_cnm1: {T_cam1_cam0.tolist()}\n"
    others = "".join(
        chain("pinhole", [140.5, 141.5, 80.0, 60.0], "radtan", [0, 0, 0, 0], f"cam{k}") + placed for k in (1, 2)
    )
    for number in (1, 2):
        lens = read(tmp_path, first + others, f"chain.yaml#cam{number}")
        T_cam_cam0 = np.linalg.matrix_power(T_cam1_cam0, number)
        np.testing.assert_allclose(lens.T_body_camera, T_body_cam0 @ np.linalg.inv(T_cam_cam0), atol=1e-9)
        assert not any("T_cn_cnm1" in note for note in lens.notes)


def test_orbslam_settings_keep_their_distortion_and_their_fisheye(tmp_path: Path) -> None:
    """Case 01."""
    assert read(tmp_path, ORB3).camera == CameraModel(
        160, 120, 150.5, 151.5, 80.25, 60.75, (-0.3, 0.08, 0.0002, 0.00002)
    )
    fisheye = ORB3.replace("PinHole", "KannalaBrandt8").replace("1.p1", "1.k3").replace("1.p2", "1.k4")
    assert read(tmp_path, fisheye).camera == CameraModel(
        160, 120, 150.5, 151.5, 80.25, 60.75, (-0.3, 0.08, 0.0002, 0.00002), LensKind.EQUIDISTANT
    )
    with pytest.raises(DatasetError, match=r"the model equidistant .KannalaBrandt8. has no coefficient p1"):
        read(tmp_path, ORB3.replace("PinHole", "KannalaBrandt8"))
    with pytest.raises(DatasetError, match="the camera model is 'Fisheye624'; flocc reads plumb_bob"):
        read(tmp_path, ORB3.replace("PinHole", "Fisheye624"))


@pytest.mark.parametrize(
    "text",
    [
        "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: cam\nheight: 120\nwidth: 160\n"
        "distortion_model: plumb_bob\n" + block("d", D) + block("k", K) + "---\n",
        "image_width: 160\nimage_height: 120\ncamera_name: c\ndistortion_model: plumb_bob\n"
        "camera_matrix:\n  rows: 3\n  cols: 3\n" + block("data", K, "  ")
        + "distortion_coefficients:\n  rows: 1\n  cols: 5\n" + block("data", D, "  "),
        "camera_model: pinhole\nresolution: [160, 120]\nintrinsics: [150.5, 151.5, 80.0, 60.0]\n"
        "distortion_model: radtan\n" + block("distortion_coefficients", D[:4]) + block("T_BS", T),
    ],
    ids=["topic-echo", "pyyaml-dump", "mixed"],
)  # fmt: skip
def test_lists_of_one_item_a_line_are_read(tmp_path: Path, text: str) -> None:
    """Case 03."""
    lens = read(tmp_path, text)
    assert lens.camera == PINHOLE
    np.testing.assert_allclose(lens.T_body_camera, np.array(T).reshape(4, 4) if "T_BS" in text else np.eye(4))


def test_eight_coefficients_without_a_name_are_all_used(tmp_path: Path) -> None:
    """Case 04; tests/agent/runtime/test_straightening.py says where pixels then go."""
    distortion = (0.55, -2.6, 0.0007, -0.0003, 1.5, 0.43, -2.5, 1.46)
    text = (
        "%YAML:1.0\n---\nimage_width: 160\nimage_height: 120\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
        "   dt: d\n   data: [ 150.5, 0., 80., 0., 151.5, 60., 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 8\n   dt: d\n"
        "   data: [ 0.55, -2.6, 0.0007, -0.0003, 1.5,\n       0.43, -2.5, 1.46 ]\n"
    )
    assert read(tmp_path, text).camera == CameraModel(160, 120, 150.5, 151.5, 80.0, 60.0, distortion)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("slam.yaml", "width: 160\nheight: 120\n# k1\ncalibration: [150.5, 151.5, 80.0, 60.0, -0.3, 0.1, 0.0, 0.0]\n"),
        ("cameras.txt", "# CAMERA_ID, MODEL\n1 OPENCV 160 120 150.5 151.5 80.0 60.0 -0.3 0.1 0.0 0.0\n"),
        ("droid.txt", "150.5 151.5 80.0 60.0 -0.3 0.1 0.0 0.0\n"),
    ],
)  # fmt: skip
def test_intrinsics_of_reconstruction_programs_are_read(tmp_path: Path, name: str, text: str) -> None:
    """Case 05."""
    wanted = CameraModel(160, 120, 150.5, 151.5, 80.0, 60.0, (-0.3, 0.1, 0.0, 0.0))
    assert read(tmp_path, text, name, (160, 120)).camera == wanted


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (chain("omni", [1.5, 380.0, 381.0, 80.0, 60.0], "radtan", [-0.2, 0.02, 0.0, 0.0]),
         CameraModel(160, 120, 380.0, 381.0, 80.0, 60.0, (-0.2, 0.02, 0.0, 0.0), LensKind.OMNIDIRECTIONAL, (1.5,))),
        (chain("ds", [-0.2, 0.59, 120.0, 121.0, 80.0, 60.0], "none", []),
         CameraModel(160, 120, 120.0, 121.0, 80.0, 60.0, (), LensKind.DOUBLE_SPHERE, (-0.2, 0.59))),
        (chain("eucm", [0.6, 1.1, 120.0, 121.0, 80.0, 60.0], "none", []),
         CameraModel(160, 120, 120.0, 121.0, 80.0, 60.0, (), LensKind.EUCM, (0.6, 1.1))),
        (chain("pinhole", [120.0, 121.0, 80.0, 60.0], "equidistant", [0.1, 0.0, 0.0, 0.0]),
         CameraModel(160, 120, 120.0, 121.0, 80.0, 60.0, (0.1, 0.0, 0.0, 0.0), LensKind.EQUIDISTANT)),
        (chain("pinhole", [120.0, 121.0, 80.0, 60.0], "fov", [0.9]),
         CameraModel(160, 120, 120.0, 121.0, 80.0, 60.0, (), LensKind.FOV, (0.9,))),
    ],
    ids=["omni", "ds", "eucm", "equi", "fov"],
)  # fmt: skip
def test_wide_lenses_of_kalibr_are_read(tmp_path: Path, text: str, wanted: CameraModel) -> None:
    """Case 06."""
    assert read(tmp_path, text).camera == wanted


REFUSED = {
    "omni without xi": (
        chain("omni", [380.0, 380.0, 80.0, 60.0], "radtan", [-0.2, 0.02, 0.0, 0.0]),
        r"intrinsics of the model omnidirectional are 5 numbers \(xi fx fy cx cy\), not 4",
    ),
    "two models": (
        chain("ds", [-0.2, 0.59, 120.0, 120.0, 80.0, 60.0], "equidistant", [0.1, 0.0, 0.0, 0.0]),
        "camera model 'ds' and the distortion model 'equidistant', which do not go together",
    ),
    "a sphere with distortion": (
        chain("eucm", [0.6, 1.1, 120.0, 120.0, 80.0, 60.0], "none", [0.1, 0.0, 0.0, 0.0]),
        "eucm has 0 distortion coefficients, not 4",
    ),
    "a name without coefficients": (
        "width: 160\nheight: 120\nfx: 1\nfy: 1\ncx: 1\ncy: 1\ndistortion_model: radtan\n",
        "names the model 'radtan' but has no distortion coefficients",
    ),
    "a key twice": (ORB3 + "Camera1.k1: 0.3\n", "the key 'Camera1.k1' stands twice with different values in line 17"),
    "two sizes": (
        "width: 160\nheight: 120\nresolution: [80, 60]\nfx: 1\nfy: 1\ncx: 1\ncy: 1\n",
        r"gives two image sizes, \[80.0, 60.0\] and \[160.0, 120.0\]",
    ),
    "two matrices": (
        f"width: 160\nheight: 120\nK: {K}\nintrinsics: [1, 1, 1, 1]\n",
        "gives the intrinsics twice, and they differ",
    ),
    "an unknown key": (
        "width: 160\nheight: 120\nfx: 1\nfy: 1\ncx: 1\ncy: 1\nradial_distortion: [0.1, 0.2]\n",
        "the key 'radial_distortion' is not understood and may be about the camera",
    ),
    "where a URDF puts it": (
        'width: 160\nheight: 120\nfx: 1\nfy: 1\ncx: 1\ncy: 1\norigin: {xyz: "0.1 0 0.3", rpy: "0 0 0"}\n',
        "the key 'origin' is not understood and may be about the camera",
    ),
    "pixels that are no squares": (
        "width: 160\nheight: 120\nfx: 1\nfy: 1\ncx: 1\ncy: 1\npixel_aspect_ratio: 1.2\n",
        "the key 'pixel_aspect_ratio' is not understood and may be about the camera",
    ),
    "skew": (f"width: 160\nheight: 120\nK: {[150, 3, *K[2:]]}\n", "has a skew of 3"),
    "a scaled mounting": (
        f"width: 160\nheight: 120\nfx: 1\nfy: 1\ncx: 1\ncy: 1\nT_BS: {[2 * value for value in T]}\n",
        "T_BS: the pose is not rigid",
    ),
    "half a mounting": (
        f"width: 160\nheight: 120\nfx: 1\nfy: 1\ncx: 1\ncy: 1\nT_BS: {T[:9]}\n",
        "T_BS must be a pose of 4x4 numbers, not 9",
    ),
    "mountings that differ": (
        f"width: 160\nheight: 120\nfx: 1\nfy: 1\ncx: 1\ncy: 1\nT_BS: {T}\nT_cam_imu: {T}\n",
        "the keys 'T_BS' and 'T_cam_imu' say different things",
    ),
    "a part of the sensor": (
        f"width: 160\nheight: 120\nk: {K}\nd: []\nbinning_x: 2\nbinning_y: 2\n",
        "is of a part of the sensor or of binned pixels",
    ),
    "no YAML": ("width: [160\nheight: 120\n", "is no YAML in line"),
    "no calibration": ("just a sentence\n", "is no calibration of a known form; flocc reads flocc TOML; Basalt"),
    "empty": ("\n", "is empty"),
    "seven coefficients": (
        "width: 160\nheight: 120\nfx: 1\nfy: 1\ncx: 1\ncy: 1\ndistortion: [1, 2, 3, 4, 5, 6, 7]\n",
        "distortion has 0 or 4 or 5 or 8 or 12 or 14 coefficients, but there are 7",
    ),
    "words": ("width: 160\nheight: 120\nfx: wide\nfy: 1\ncx: 1\ncy: 1\n", "fx must be a number, not 'wide'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_nothing_is_used_in_part(tmp_path: Path, name: str) -> None:
    text, sentence = REFUSED[name]
    with pytest.raises(DatasetError, match=f"camera.yaml: .*{sentence}"):
        read(tmp_path, text)


def test_a_camera_of_several_is_named_behind_the_file(tmp_path: Path) -> None:
    text = chain("pinhole", [120.0, 121.0, 80.0, 60.0], "none", []) + chain(
        "pinhole", [130.0, 131.0, 80.0, 60.0], "none", [], "cam1"
    )
    first = read(tmp_path, text)
    assert first.camera.fx == 120.0
    assert "cam0 was taken; FILE#NAME takes another camera (cam1)" in first.notes[0]
    assert read(tmp_path, text, "camera.yaml#cam1").camera.fx == 130.0
    with pytest.raises(DatasetError, match="has no camera 'cam7'; it has cam0, cam1"):
        read(tmp_path, text, "camera.yaml#cam7")


def test_what_is_not_used_is_named(tmp_path: Path) -> None:
    lens = read(tmp_path, chain("pinhole", [120.0, 121.0, 80.0, 60.0], "none", []) + "  rostopic: /cam0\n")
    assert lens.notes == (f"{tmp_path / 'camera.yaml'}: not used: cam_overlaps, rostopic",)


def test_intrinsics_without_a_size_must_be_those_of_the_images(tmp_path: Path) -> None:
    assert read(tmp_path, "150 150 80 60\n", "c.txt", (160, 120)).camera.width == 160
    with pytest.raises(DatasetError, match="the image size is missing"):
        read(tmp_path, "150 150 80 60\n", "c.txt")
    with pytest.raises(
        DatasetError, match=r"the principal point \(80, 60\) is not near the middle of the images of 640x"
    ):
        read(tmp_path, "150 150 80 60\n", "c.txt", (640, 480))


def test_settings_that_name_a_calibration_are_followed(tmp_path: Path) -> None:
    camera = "%YAML:1.0\nmodel_type: PINHOLE\ncamera_name: c\nimage_width: 160\nimage_height: 120\n"
    camera += "distortion_parameters:\n   k1: -0.3\n   k2: 0.1\n   p1: 0.001\n   p2: -0.002\n"
    camera += "projection_parameters:\n   fx: 150.5\n   fy: 151.5\n   cx: 80.0\n   cy: 60.0\n"
    (tmp_path / "cam0.yaml").write_text(camera)
    settings = f'%YAML:1.0\nimu: 1\nnum_of_cam: 1\ncam0_calib: "cam0.yaml"\nbody_T_cam0: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: {T}\n'  # noqa: E501
    lens = read(tmp_path, settings, "euroc.yaml")
    assert lens.camera == PINHOLE
    np.testing.assert_allclose(lens.T_body_camera, np.array(T).reshape(4, 4))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_text_is_read_in_any_usual_encoding(tmp_path: Path, encoding: str) -> None:
    text = "# Größe\r\nwidth: 160\r\nheight: 120\r\nfx: 150.5\r\nfy: 151.5\r\ncx: 80.0\r\ncy: 60.0\r\ndistortion: [-0.3, 0.1, 0.001, -0.002]\r\n"  # noqa: E501
    (tmp_path / "camera.yaml").write_bytes(text.encode(encoding))
    assert read_lens(tmp_path / "camera.yaml").camera == PINHOLE


def test_kittis_right_camera_is_beside_the_left_one(tmp_path: Path) -> None:
    rows = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -378 0 700 180 0 0 0 1 0\n"
    lens = read(tmp_path, rows, "calib.txt#P1", (1241, 376))
    assert lens.camera == CameraModel(1241, 376, 700.0, 700.0, 600.0, 180.0)
    assert lens.T_body_camera[:3, 3].tolist() == pytest.approx([0.54, 0.0, 0.0])
    with pytest.raises(DatasetError, match="holds 2 cameras, name one as FILE#NAME: P0, P1"):
        read(tmp_path, rows, "calib.txt", (1241, 376))


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"nowhere.yaml: cannot be read: No such file"):
        read_lens(tmp_path / "nowhere.yaml")
    (tmp_path / "cameras.bin").write_bytes(b"\0\1")
    with pytest.raises(DatasetError, match=r"is a binary file.*model_converter --output_type TXT"):
        read_lens(tmp_path / "cameras.bin")


FLAT = "width: 160\nheight: 120\nfx: 150.5\nfy: 151.5\ncx: 80.0\ncy: 60.0\n"
LISTS = [f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 9)}]\n" for k in range(9)]


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("c.yaml", FLAT + "a: &a [*a]\n", "nested too deeply"),
        ("c.json", '{"a":' * 100000 + "1" + "}" * 100000, "nested too deeply"),
        ("c.yaml", "a0: &a0 [1, 1]\n" + "".join(LISTS) + FLAT, "more than 200000 values"),
        ("c.yaml", FLAT.replace("160", ".inf"), "an image cannot have infx120 pixels"),
        ("c.yaml", FLAT.replace("150.5", "nan"), "must be finite"),
        ("c.txt", "P0: 0 0 80 0 0 0 60 0 0 0 1 0\n", "no focal length"),
        ("c.txt", "1 PINHOLE 160 120 150.5 151.5 abc 60\n", "camera 1 has abc where a number must be"),
        ("c.yaml", "width: 160\nheight: 120\nfx: 0.94\nfy: 1.26\ncx: 0.5\ncy: 0.5\n", "parts of the image's size"),
        ("c.yaml", FLAT.replace("80.0", "800.0"), r"\(800, 60\) lies outside of images of 160x120"),
        (
            "c.yaml",
            FLAT.replace("151.5", "80.0").replace("cx: 80.0", "cx: 151.5"),
            "would be fx cx fy cy, by their sizes",
        ),
        ("c.yaml", FLAT.replace("cx: 80.0", "cx: 60.5").replace("cy: 60.0", "cy: 79.5"), "or cx and cy, are exchanged"),
        (
            "c.json",
            '{"K": [[150, 0, 80], [0, 150, 60], [0, 0, 1]], "D": [[0.1], [0], [0], [0]]}',
            "in a column are what",
        ),
        ("c.yaml", FLAT.replace("151.5", "1e-30"), "focal lengths of 150.5 and 1e-30 pixels are none of images"),
        ("c.yaml", FLAT + "model_type: PINHOLE\nestimate_extrinsic: 2\n", "VINS' settings that do not know where the"),
        (
            "c.yaml",
            FLAT + "estimate_extrinsic: 2\nextrinsicTranslation: [0, 0, 0]\n",
            "do not know where the camera sits",
        ),
        ("c.yaml", FLAT + "rpy: [-1.57, 0.0, -1.57]\n", "the key 'rpy' is not understood"),
        ("c.yaml", FLAT + "sits_at: [0.1, 0.0, 0.3]\n", "the key 'sits_at' is not understood"),
        ("c.yaml", FLAT + "seen_from: {x: 0.1, y: 0.0, z: 0.3}\n", "the key 'seen_from' is not understood"),
        (
            "c.yaml",
            'Camera.type: "Rectified"\nCamera.k1: 0.1\n'
            + "".join(f"Camera.{each}\n" for each in FLAT.splitlines() if "distortion" not in each),
            "Rectified, but there are",
        ),
        ("c.yaml", FLAT + "T_BS: [[1, 0, 0, 65], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n", "mounting in metres"),
        ("c.yaml", FLAT + "R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nt: [0.1, 0, 0]\n", "the key 't' is not understood"),
        ("c.yaml", FLAT + "projection: equidistant\n", "the key 'projection' is not understood"),
        ("c.yaml", FLAT + "units: mm\n", "the key 'units' is not understood"),
        ("c.yaml", FLAT + "a: \x07\n", "is no YAML: unacceptable character"),
        (
            "c.toml",
            "[camera]\n" + FLAT.replace(":", " =").replace("160", "160.5"),
            "camera.width must be a whole number",
        ),
    ],
)
def test_numbers_of_another_unit_and_files_without_an_end_are_refused(
    tmp_path: Path, name: str, text: str, sentence: str
) -> None:
    with pytest.raises(DatasetError if name != "c.toml" else FloccError, match=sentence) as caught:
        read(tmp_path, text, name, (160, 120))
    assert "\n" not in str(caught.value)


def test_maps_that_are_taken_over_count_as_written(tmp_path: Path) -> None:
    """YAML's `<<`, which is how several cameras share what is the same in each."""
    shared = f"common: &common\n  resolution: [160, 120]\n  distortion_model: radtan\n  distortion_coeffs: {D[:4]}\n"
    camera = "cam0:\n  <<: *common\n  camera_model: pinhole\n  intrinsics: [150.5, 151.5, 80.0, 60.0]\n"
    assert read(tmp_path, shared + camera).camera == PINHOLE
    assert read(tmp_path, FLAT + "<<: &more {distortion: [-0.3, 0.1, 0.001, -0.002]}\n").camera == PINHOLE


@pytest.mark.parametrize("encoding", ["utf-16", "iso-8859-1", "utf-8"])
def test_xml_is_read_in_the_encoding_that_it_names(tmp_path: Path, encoding: str) -> None:
    numbers = f"<rows>3</rows><cols>3</cols><data>{' '.join(map(str, K))}</data>"
    matrix = f'<camera_matrix type_id="opencv-matrix">{numbers}</camera_matrix>'
    text = f"<?xml version='1.0' encoding='{encoding}'?><!-- Größe --><opencv_storage><image_width>160</image_width>"
    text += f"<image_height>120</image_height>{matrix}</opencv_storage>"
    (tmp_path / "c.xml").write_bytes(text.encode(encoding))
    assert read_lens(tmp_path / "c.xml").camera == CameraModel(160, 120, 150.5, 151.5, 80.0, 60.0, ())


def test_toml_with_a_mark_is_read_and_what_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("[camera]\n" + FLAT.replace(":", " ="), encoding="utf-8-sig")
    assert read_lens(tmp_path / "c.toml").camera.fx == 150.5
    (tmp_path / "endless.yaml").symlink_to("/dev/zero")
    with pytest.raises(DatasetError, match="is not a file"):
        read_lens(tmp_path / "endless.yaml")


REALSENSE = (
    '{"width": 160, "height": 120, "ppx": 80.0, "ppy": 60.0, "fx": 150.5, "fy": 151.5, "model": "distortion.%s", '
)
REALSENSE += '"coeffs": %s}'


def test_realsenses_other_models_are_a_pinhole_only_with_zeros(tmp_path: Path) -> None:
    zeros = read(tmp_path, REALSENSE % ("inverse_brown_conrady", "[0.0, 0.0, 0.0, 0.0, 0.0]"), "rs.json")
    assert zeros.camera == CameraModel(160, 120, 150.5, 151.5, 80.0, 60.0)
    brown = read(tmp_path, REALSENSE % ("brown_conrady", "[-0.3, 0.1, 0.001, -0.002, 0.0]"), "rs.json")
    assert brown.camera == PINHOLE
    with pytest.raises(DatasetError, match="with other numbers than zeros"):
        read(tmp_path, REALSENSE % ("inverse_brown_conrady", "[-0.3, 0.1, 0.001, -0.002, 0.0]"), "rs.json")


def test_zeds_distortion_in_a_section_of_its_own_is_used(tmp_path: Path) -> None:
    conf = "[LEFT_CAM_VGA]\nfx=350.5\nfy=351.5\ncx=336.5\ncy=188.5\n\n"
    conf += "[LEFT_DISTO]\nk1=-0.17\nk2=0.02\np1=0.001\np2=0.002\n"
    camera = read(tmp_path, conf, "SN1.conf", (672, 376)).camera
    assert camera == CameraModel(672, 376, 350.5, 351.5, 336.5, 188.5, (-0.17, 0.02, 0.001, 0.002))
    with pytest.raises(DatasetError, match="LEFT_CAM_VGA and LEFT_DISTO give k1 twice"):
        read(tmp_path, conf.replace("cy=188.5", "cy=188.5\nk1=0.1"), "SN1.conf", (672, 376))
    with pytest.raises(DatasetError, match="the section 'LEFT_FISHEYE' is not understood"):
        read(tmp_path, conf.replace("LEFT_DISTO", "LEFT_FISHEYE"), "SN1.conf", (672, 376))


def test_four_coefficients_of_a_stereo_pair_may_be_a_fisheyes(tmp_path: Path) -> None:
    pair = f"%YAML:1.0\n---\nK1: {K}\nD1: [0.1, 0.02, 0.001, 0.002]\nK2: {K}\nD2: [0.1, 0.02, 0.001, 0.002]\n"
    with pytest.raises(DatasetError, match="nothing says whether the four numbers of D1 are of a fisheye"):
        read(tmp_path, pair, "stereo.yml", (160, 120))
    five = read(tmp_path, pair.replace("0.002]", "0.002, 0.0]"), "stereo.yml#left", (160, 120)).camera
    assert five.distortion[:4] == (0.1, 0.02, 0.001, 0.002)


def test_the_unified_model_is_the_extended_one_with_one(tmp_path: Path) -> None:
    text = (
        '{"value0": {"T_imu_cam": [{"px": 0, "py": 0, "pz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}], "intrinsics": '
        '[{"camera_type": "ucm", "intrinsics": {"fx": 120.0, "fy": 121.0, "cx": 80.0, "cy": 60.0, "alpha": 0.6}}], '
        '"resolution": [[160, 120]]}}'
    )
    wanted = CameraModel(160, 120, 120.0, 121.0, 80.0, 60.0, (), LensKind.EUCM, (0.6, 1.0))
    assert read(tmp_path, text, "calib.json").camera == wanted


def test_a_fisheye_in_rtabmaps_six_numbers_has_four(tmp_path: Path) -> None:
    text = (
        "image_width: 160\nimage_height: 120\ndistortion_model: fisheye\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {K}\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 6\n  data: [0.1, 0.02, 0.0, 0.0, 0.001, 0.002]\n"
    )
    assert read(tmp_path, text).camera.distortion == (0.1, 0.02, 0.001, 0.002)
    with pytest.raises(DatasetError, match="has 4 coefficients, but there are 6"):
        read(tmp_path, text.replace("0.02, 0.0, 0.0", "0.02, 0.3, 0.0"))


@pytest.mark.parametrize(
    ("name", "text", "wanted"),
    [
        ("P.txt", "500 0 320 -60\n0 500 240 0\n0 0 1 0\n", [0.12, 0, 0]),
        ("calib_cam_to_cam.txt#K1", "K_00: 500 0 320 0 500 240 0 0 1\nP_rect_00: 500 0 320 0 0 500 240 0 0 0 1 0\n"
         "S_01: 640 480\nK_01: 500 0 320 0 500 240 0 0 1\nR_01: 0 1 0 -1 0 0 0 0 1\nT_01: -0.5 0.1 0\n"
         "P_rect_01: 500 0 320 -60 0 500 240 0 0 0 1 0\n", [0.1, 0.5, 0]),
    ],
)  # fmt: skip
def test_where_a_camera_of_several_sits_is_read(tmp_path: Path, name: str, text: str, wanted: list[float]) -> None:
    lens = read(tmp_path, text, name, (640, 480))
    np.testing.assert_allclose(lens.T_body_camera[:3, 3], wanted, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"frames": [], "w": 640, "h": 480, "fl_x": 700, "camera_angle_x": 0.5}', "fl_x is 700, but camera_angle_x"),
        ('{"calib_dimension": {"w": 640, "h": 480}, "input_horizontal_stretch": 1.333, "fisheye_params":'
         '{"camera_matrix": [[300, 0, 320], [0, 301, 240], [0, 0, 1]], "distortion_coeffs": [0.1, 0, 0, 0]}}',
         "is of pictures that are stretched by 1.333 and 1.0 first"),
    ],
)  # fmt: skip
def test_a_lens_that_a_second_key_changes_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(DatasetError, match=said):
        read(tmp_path, text, "camera.json")


INNER = "width: 640\n  height: 480\n  fx: 400\n  fy: 401\n  cx: 320\n  cy: 240\n"


@pytest.mark.parametrize(
    "beside",
    [
        "extrinsic:\n  x: 1.7\n  y: 0.1\n  z: 1.2\n  pitch: 0.03\n",
        "distortion:\n  k1: -0.28\n  k2: 0.07\n  p1: 0\n  p2: 0\n",
        "imu_to_cam: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n",
        "sits:\n  where: [0.1, 0.2, 0.3]\n",
    ],
)
def test_a_map_beside_that_of_the_camera_is_no_less_read(tmp_path: Path, beside: str) -> None:
    with pytest.raises(DatasetError, match=beside.partition(":")[0]):
        read(tmp_path, f"intrinsic:\n  {INNER}{beside}", "camera.yaml")


def test_a_map_beside_that_of_the_camera_that_says_nothing_is_named(tmp_path: Path) -> None:
    beside = "Feature:\n  scale_factor: 1.2\nmapping:\n  bound: [[-2.9, 8.9], [-3.2, 5.5], [-3.5, 3.3]]\n"
    lens = read(tmp_path, f"Camera:\n  {INNER}{beside}", "camera.yaml")
    assert any("not used: Feature, mapping" in note for note in lens.notes)
