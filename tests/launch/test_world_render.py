"""The renderer is an exact pinhole camera, and its atlas and light are what they claim to be."""

import numpy as np
import pytest

from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import pose, so3_exp
from flocc_launch.world.atlas import LEVELS, pack
from flocc_launch.world.render import Baked, Light, Renderer, bake, clipped
from flocc_launch.world.scene import Pixels, Scene, Solid
from flocc_launch.world.shade import SUN, light_maps

CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
FLAT = Light((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
FACING_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def full_light(scene: Scene) -> list[Pixels]:
    return [np.full((4, 4, 2), 255, dtype=np.uint8) for _ in scene.surfaces]


def dotted(dots: list[tuple[float, float]], size: int = 400, radius: int = 5) -> Pixels:
    """A grey square with white dots, (x, y) in texels."""
    y, x = np.mgrid[0:size, 0:size] + 0.5
    pixels = np.full((size, size, 3), 60, dtype=np.uint8)
    for dot_x, dot_y in dots:
        pixels[(x - dot_x) ** 2 + (y - dot_y) ** 2 < radius**2] = 255
    return pixels


def centroid(image: Pixels, near: tuple[float, float], reach: int = 9) -> tuple[float, float]:
    """Brightness centroid around a pixel."""
    column, row = round(near[0]), round(near[1])
    window = image[row - reach : row + reach + 1, column - reach : column + reach + 1, 0].astype(float) - 60
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return column + float((window * x).sum() / window.sum()), row + float((window * y).sum() / window.sum())


@pytest.mark.parametrize("turned_rad", [(0.0, 0.0, 0.0), (0.1, 0.35, -0.2), (-0.2, -0.4, 0.15)])
def test_points_appear_where_the_pinhole_puts_them(turned_rad: tuple[float, float, float]) -> None:
    scene = Scene()
    dots = [(120.0, 130.0), (200.0, 200.0), (280.0, 250.0)]
    scene.add_wall(np.array([-2.0, 3.0]), np.array([2.0, 3.0]), 0.0, 4.0, scene.add_texture(dotted(dots)))
    T_world_camera = pose(FACING_NORTH @ so3_exp(np.array(turned_rad)), np.array([0.1, -0.3, 1.9]))
    image = Renderer(bake(scene, full_light(scene)), CAMERA).render(T_world_camera, FLAT)
    for dot_x, dot_y in dots:
        world = np.array([-2 + dot_x / 100, 3.0, 4 - dot_y / 100])
        ray = CAMERA.K() @ (T_world_camera[:3, :3].T @ (world - T_world_camera[:3, 3]))
        expected = ray[:2] / ray[2]
        assert centroid(image, (expected[0], expected[1])) == pytest.approx(tuple(expected), abs=0.15)


def test_the_nearer_wall_hides_the_farther() -> None:
    scene = Scene()
    far = scene.add_texture(np.full((8, 8, 3), (200, 0, 0), dtype=np.uint8))
    near = scene.add_texture(np.full((8, 8, 3), (0, 200, 0), dtype=np.uint8))
    scene.add_wall(np.array([-9.0, 5.0]), np.array([9.0, 5.0]), -9.0, 9.0, far)
    scene.add_wall(np.array([0.0, 3.0]), np.array([9.0, 3.0]), -9.0, 9.0, near)
    image = Renderer(bake(scene, full_light(scene)), CAMERA).render(pose(FACING_NORTH, np.zeros(3)), FLAT)
    assert image[120, 80].tolist() == pytest.approx([200, 0, 0], abs=2)
    assert image[120, 240].tolist() == pytest.approx([0, 200, 0], abs=2)


def test_a_surface_is_not_seen_from_behind() -> None:
    scene = Scene()
    wall = scene.add_texture(np.full((8, 8, 3), 250, dtype=np.uint8))
    sky = scene.add_texture(np.full((8, 8, 3), 9, dtype=np.uint8))
    scene.add_wall(np.array([-90.0, 50.0]), np.array([90.0, 50.0]), -90.0, 90.0, sky)
    scene.add_wall(np.array([9.0, 3.0]), np.array([-9.0, 3.0]), -9.0, 9.0, wall)
    image = Renderer(bake(scene, full_light(scene)), CAMERA).render(pose(FACING_NORTH, np.zeros(3)), FLAT)
    assert int(image.max()) < 15


def test_a_floor_that_reaches_behind_the_camera_is_drawn() -> None:
    scene = Scene()
    floor = scene.add_texture(np.full((64, 64, 3), 180, dtype=np.uint8))
    scene.add_floor(np.array([-50.0, 50.0]), np.array([50.0, 50.0]), np.array([-50.0, -50.0]), 0.0, floor)
    image = Renderer(bake(scene, full_light(scene)), CAMERA).render(pose(FACING_NORTH, np.array([0, 0, 1.0])), FLAT)
    assert image[200, 160].tolist() == pytest.approx([180] * 3, abs=2)
    assert image[239, 5].tolist() == pytest.approx([180] * 3, abs=2)


def test_more_light_is_brighter_by_its_root() -> None:
    scene = Scene()
    scene.add_wall(
        np.array([-9.0, 3.0]), np.array([9.0, 3.0]), -9.0, 9.0, scene.add_texture(np.full((8, 8, 3), 100, np.uint8))
    )
    renderer = Renderer(bake(scene, full_light(scene)), CAMERA)
    dim = renderer.render(pose(FACING_NORTH, np.zeros(3)), Light((0.25, 0.25, 0.25), (0, 0, 0)))
    assert dim[120, 160].tolist() == pytest.approx([50] * 3, abs=1)


def test_baked_arrays_survive_a_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    scene = Scene()
    scene.add_wall(np.array([-9.0, 3.0]), np.array([9.0, 3.0]), -9.0, 9.0, scene.add_texture(dotted([(90.0, 90.0)])))
    baked, folder = bake(scene, full_light(scene)), tmp_path_factory.mktemp("baked")
    baked.save(folder)
    T = pose(FACING_NORTH, np.zeros(3))
    again = Renderer(Baked.load(folder), CAMERA).render(T, FLAT)
    np.testing.assert_array_equal(again, Renderer(baked, CAMERA).render(T, FLAT))


def test_no_texture_bleeds_into_another_at_any_level() -> None:
    black, white = np.zeros((50, 70, 3), dtype=np.uint8), np.full((40, 33, 3), 255, dtype=np.uint8)
    atlas = pack([black, white])
    for level in range(LEVELS):
        column, row = atlas.level_corners[:, level]
        for (x, y), (rows, columns), value in zip(atlas.offsets, ((50, 70), (40, 33)), (0, 255), strict=True):
            left, top = int(column + x / 2**level), int(row + y / 2**level)
            part = atlas.pixels[top : top + max(rows >> level, 1), left : left + max(columns >> level, 1)]
            assert part.min() == part.max() == value


def test_a_solid_casts_its_shadow_away_from_the_sun() -> None:
    scene = Scene()
    floor = scene.add_texture(np.full((8, 8, 3), 128, dtype=np.uint8))
    scene.add_floor(np.array([-8.0, 8.0]), np.array([8.0, 8.0]), np.array([-8.0, -8.0]), 0.0, floor)
    scene.add_solid(Solid(np.array([0.0, 0.0, 1.5]), np.array([0.5, 0.5, 1.5])))
    sun = light_maps(scene)[0][..., 1].astype(int)

    def at(x_m: float, y_m: float) -> int:
        rows, columns = sun.shape
        return int(sun[int((8 - y_m) / 16 * rows), int((x_m + 8) / 16 * columns)])

    away = -1.1 * SUN[:2] / np.linalg.norm(SUN[:2])
    assert at(*away) == 0
    assert at(*-away) == pytest.approx(255 * SUN[2], abs=2)


def test_clipping_keeps_what_is_in_front() -> None:
    behind = np.array([[-1.0, 1.0, -1.0], [1.0, 1.0, -1.0], [1.0, 1.0, 3.0], [-1.0, 1.0, 3.0]])
    kept = clipped(behind, near_m=1.0)
    assert kept[:, 2].min() == pytest.approx(1.0)
    assert kept[:, 2].max() == pytest.approx(3.0)
    assert len(clipped(behind - [0, 0, 9])) == 0
