"""COLMAP's quaternions are w first; a converter that wrote w last is found by what the model says, and refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from flocc_agent.geometry import inverse, pose, q_wxyz_from_R, so3_exp
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.source import DatasetError

WXYZ, XYZW = [0, 1, 2, 3], [1, 2, 3, 0]


def write_model(path: Path, order: list[int], points: bool, seed: int, start: bool = False) -> Path:
    """A walk of 20 cameras past 200 points, with quaternions in some order."""
    rng = np.random.default_rng(seed)
    (path / "images").mkdir(parents=True)
    (path / "cameras.txt").write_text("1 SIMPLE_RADIAL 640 480 500 320 240 0.01\n")
    world = rng.uniform(-20, 20, (200, 3))
    T = np.eye(4) if start else pose(so3_exp(rng.uniform(-1, 1, 3)), rng.uniform(-9, 9, 3))
    rows = []
    for k in range(20):
        cv2.imwrite(str(path / "images" / f"{k:03d}.png"), np.full((480, 640), 40, np.uint8))
        T_camera_world = inverse(T)
        in_camera = world @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        ahead = np.nonzero(in_camera[:, 2] > 1)[0]
        pixels = in_camera[ahead, :2] / in_camera[ahead, 2:] * 500 + (320, 240)
        q, t_m = q_wxyz_from_R(T_camera_world[:3, :3])[order], T_camera_world[:3, 3]
        seen = " ".join(f"{x:.2f} {y:.2f} {n}" for n, (x, y) in zip(ahead, pixels, strict=True)) if points else ""
        rows.append(f"{k + 1} {' '.join(map(repr, [*q.tolist(), *t_m.tolist()]))} 1 {k:03d}.png\n{seen}\n")
        T = T @ pose(so3_exp(rng.normal(0, 0.1, 3)), np.array([0.0, 0.0, 0.3]))
    (path / "images.txt").write_text("".join(rows))
    if points:
        lines = (f"{n} {x} {y} {z} 9 9 9 0.5 1 2\n" for n, (x, y, z) in enumerate(world))
        (path / "points3D.txt").write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR\n" + "".join(lines))
    return path


@pytest.mark.parametrize("seed", range(6))
def test_points_that_project_tell_the_order(tmp_path: Path, seed: int) -> None:
    assert len(read_source(write_model(tmp_path / "right", WXYZ, True, seed)).images) == 20
    with pytest.raises(
        DatasetError, match=r"images.txt:1: .* must be QX QY QZ QW: the points project .*; write w first"
    ):
        read_source(write_model(tmp_path / "wrong", XYZW, True, seed))


def test_a_first_camera_that_is_not_turned_tells_the_order(tmp_path: Path) -> None:
    assert len(read_source(write_model(tmp_path / "right", WXYZ, False, 1, start=True)).images) == 20
    with pytest.raises(DatasetError, match="the first camera is not turned only so"):
        read_source(write_model(tmp_path / "wrong", XYZW, False, 1, start=True))


def test_a_path_of_half_the_length_tells_the_order(tmp_path: Path) -> None:
    said = []
    for seed in range(12):
        read_source(write_model(tmp_path / f"right{seed}", WXYZ, False, seed))
        try:
            read_source(write_model(tmp_path / f"wrong{seed}", XYZW, False, seed))
        except DatasetError as error:
            said.append(str(error))
    assert len(said) >= 3
    assert all("as long so; write w first" in sentence for sentence in said)
