"""A data set of a wide lens gives, once remapped, the pictures of the pinhole that it was made of."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from flocc_agent.core.interfaces import Camera
from flocc_agent.lenses import LensKind
from flocc_agent.runtime.recording import Recording, write_camera
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_lab.dialects.wide_pictures import write_wide
from flocc_launch.datasets.commands import convert
from flocc_launch.datasets.source import DatasetError

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
PIXELS = cv2.resize(np.random.default_rng(2).integers(0, 255, (6, 8, 3)).astype(np.uint8), (160, 120))


def write_plain(path: Path, count: int = 3) -> Path:
    (path / "images").mkdir(parents=True)
    for k in range(count):
        cv2.imwrite(str(path / "images" / f"{100 + k}.000.png"), PIXELS)
    write_tum(path / "odometry.tum", Trajectory(np.arange(100.0, 100.0 + count), np.repeat(np.eye(4)[None], count, 0)))
    write_camera(path / "camera.toml", CAMERA, np.eye(4))
    return path


@pytest.mark.parametrize("kind", [LensKind.EQUIDISTANT, LensKind.DOUBLE_SPHERE, LensKind.EUCM])
def test_wide_and_back_is_the_same_picture(tmp_path: Path, kind: LensKind) -> None:
    wide = write_wide(write_plain(tmp_path / "narrow"), tmp_path / "wide", kind)
    recording = Recording.open(convert(wide, tmp_path / "out", view_deg=65.0))
    camera = recording.camera
    assert camera.fx == pytest.approx(CAMERA.fx, rel=1e-3)
    found = recording.load_image(recording.frames[1]).pixels[..., ::-1].astype(int)
    left, top = round(CAMERA.cx - camera.cx), round(CAMERA.cy - camera.cy)
    wanted = PIXELS[top : top + camera.height, left : left + camera.width].astype(int)
    assert found.shape == wanted.shape
    assert np.median(np.abs(found - wanted)) <= 3
    assert np.percentile(np.abs(found - wanted), 99) < 30


def test_a_field_of_view_that_the_lens_does_not_see_is_refused(tmp_path: Path) -> None:
    wide = write_wide(write_plain(tmp_path / "narrow"), tmp_path / "wide", LensKind.EQUIDISTANT)
    with pytest.raises(DatasetError, match=r"the lens fills a pinhole of 7\d degrees at most, not of 140"):
        convert(wide, tmp_path / "out", view_deg=140.0)
