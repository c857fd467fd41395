"""A map's sparse cloud: points where both keyframes of a closure see them, coloured where recordings are at hand."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.launch.map_missions import BLOCK, mission

from flocc_agent.core.interfaces import Camera, SeenMatches
from flocc_agent.geometry import inverse, se3_exp
from flocc_agent.runtime.map_folder import MapFolder
from flocc_agent.runtime.recording import write_camera
from flocc_launch.maps.gathering import stamps_s
from flocc_launch.maps.map_export import PLY_HEADER, POINTS, VERTEX, export_points
from flocc_launch.maps.map_points import _Film, points_of, recordings_of, triangulated
from flocc_launch.maps.map_saving import save_map
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
RNG = np.random.default_rng(8)
T_MAP_QUERY = se3_exp(np.array([0.1, -0.4, 0.2, 5.0, 3.0, 1.0]))
T_MAP_MATCH = T_MAP_QUERY @ se3_exp(np.array([0.05, 0.1, 0.0, 1.0, 0.1, -0.2]))


def seen(points: Float, T_map_camera: Float) -> Float:
    """Points (N, 3) of the map as x/z and y/z in a camera."""
    there = (points - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
    return np.asarray(there[:, :2] / there[:, 2:])


def test_rays_meet_where_the_points_are() -> None:
    points = (T_MAP_QUERY @ np.vstack([RNG.uniform(-2, 2, (2, 40)), RNG.uniform(4, 9, 40), np.ones(40)]))[:3].T
    agree = np.arange(40) % 4 != 3
    matches = SeenMatches(seen(points, T_MAP_QUERY), seen(points, T_MAP_MATCH), agree)
    at_m, which = triangulated(matches, T_MAP_QUERY, T_MAP_MATCH)
    assert which.tolist() == np.flatnonzero(agree).tolist()
    np.testing.assert_allclose(at_m, points[agree], atol=1e-9)


def test_what_does_not_meet_in_front_of_both_is_no_point() -> None:
    points = (T_MAP_QUERY @ np.array([[0.0, 0.0, 6.0, 1.0], [0.5, 0.2, 400.0, 1.0], [0.3, 0.1, 5.0, 1.0]]).T)[:3].T
    matches = SeenMatches(seen(points, T_MAP_QUERY), seen(points, T_MAP_MATCH), np.ones(3, np.bool_))
    matches.match[2] += [0.0, 0.1]  # another point of the picture
    assert triangulated(matches, T_MAP_QUERY, T_MAP_MATCH)[1].tolist() == [0]
    behind = SeenMatches(matches.query, seen(points, T_MAP_MATCH @ inverse(T_MAP_QUERY) @ T_MAP_MATCH), matches.agree)
    turned = T_MAP_QUERY @ se3_exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert len(triangulated(behind, turned, T_MAP_MATCH)[1]) == 0


class Telling:
    """Sees one wall, 5 m before the query, in any two latents."""

    def __init__(self, poses: dict[LogId, Float]) -> None:
        self._poses = poses
        self.asked = 0

    def matches(self, query: bytes, match: bytes) -> SeenMatches | None:
        self.asked += 1
        return self.of[self.asked - 1]

    of: list[SeenMatches]


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> MapFolder:
    out = tmp_path_factory.mktemp("block")
    mission(out / "run", BLOCK)
    save_map(out / "run", out / "map")
    return MapFolder.open(out / "map")


def test_each_used_closure_gives_points_with_the_colours_of_its_picture(opened: MapFolder, tmp_path: Path) -> None:
    poses, logs = opened.poses(), list(opened.poses())
    telling, walls = Telling(poses), []
    telling.of = []
    for query, match in opened.used_closures():
        T_query, T_match = poses[query.log][query.index], poses[match.log][match.index]
        wall = (T_query @ np.array([[0.0, 0.0, 5.0, 1.0], [0.4, -0.1, 5.0, 1.0]]).T)[:3].T
        walls.append(wall)
        telling.of.append(SeenMatches(seen(wall, T_query), seen(wall, T_match), np.ones(2, np.bool_)))
    colour_of = {log: (k, 2, 3) for k, log in enumerate(logs)}
    found = points_of(opened, telling, {}, colour_of, lambda *_: None)  # type: ignore[arg-type]
    assert found is not None
    assert 0 < found.closures <= telling.asked == len(walls)
    apart_m = np.linalg.norm(found.at_m[:, None] - np.concatenate(walls)[None], axis=2).min(axis=1)
    assert apart_m.max() < 1e-6
    assert {tuple(each) for each in found.colours.tolist()} <= set(colour_of.values())


def test_a_front_end_that_cannot_tell_gives_no_points(opened: MapFolder, tmp_path: Path) -> None:
    tmp_path.joinpath("files").mkdir()
    assert export_points(opened, tmp_path / "files", [], lambda *_: None) is None
    assert list((tmp_path / "files").iterdir()) == []


def test_colours_are_the_pixels_of_recordings(opened: MapFolder, tmp_path: Path) -> None:
    log = next(iter(opened.poses()))
    folder = tmp_path / log.robot
    folder.mkdir()
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, 32:] = (10, 200, 30)
    cv2.imwrite(str(folder / "0.png"), picture[..., ::-1])
    stamp_s = stamps_s(opened, log)[0]
    (folder / "images.txt").write_text(f"{stamp_s:.6f} 0.png\n")
    (folder / "odometry.tum").write_text(f"{stamp_s:.6f} 0 0 0 0 0 0 1\n")
    write_camera(folder / "camera.toml", Camera(64, 48, 60.0, 60.0, 31.5, 23.5), np.eye(4))
    assert recordings_of(opened, [tmp_path]) == {log: folder}
    assert recordings_of(opened, [folder]) == {log: folder}
    film, own = _Film(opened, {log: folder}), np.full((3, 3), 7, np.uint8)
    rays = np.array([[0.2, 0.0], [-0.2, 0.0], [3.0, 0.0]])
    assert film.colours(KeyframeId(log, 0), rays, own).tolist() == [[10, 200, 30], [0, 0, 0], [7, 7, 7]]
    assert film.colours(KeyframeId(log, 1), rays, own).tolist() == own.tolist()
    header = PLY_HEADER.format(count=3, comment=POINTS)
    assert header.endswith("end_header\n")
    assert VERTEX.itemsize == 27
