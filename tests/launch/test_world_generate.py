"""A generated world: the same from the same seed, walkable, and seen by several robots from alike places."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.geometry import angle_rad, between
from flocc_agent.runtime.recording import Recording
from flocc_lab.bench.world_overlap import Matcher
from flocc_launch.datasets.drift import DriftSpec, drifted
from flocc_launch.runs.trajectory_errors import ate_m, placed_at_true_start
from flocc_launch.world import layout
from flocc_launch.world import routes as of_town
from flocc_launch.world.generate import generate
from flocc_launch.world.routes import routes, walk
from flocc_launch.world.spec import WorldSpec

Float = NDArray[np.float64]

SMALL = WorldSpec(width=320, height=240, route_m=15.0, image_rate_hz=1.0, robots=2)


@contextmanager
def village() -> Iterator[None]:
    """One block of houses and the square, not six blocks: building the town is what costs, not taking its pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layout, "COLUMNS", 2)
        patch.setattr(layout, "ROWS", 1)
        patch.setattr(layout, "SQUARE", (1, 0))
        patch.setattr(of_town, "ROUTES", (((0, 0), (1, 0)), ((2, 1), (1, 1))))
        yield


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("world")
    with village():
        generate(SMALL, out, processes=2)
    return out


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_recordings_open_and_look_where_they_walk(world: Path) -> None:
    for name in ("alpha", "bravo"):
        recording = Recording.open(world / name)
        assert len(recording.frames) >= 4
        np.testing.assert_array_equal(recording.frames[0].T_odom_body, np.eye(4))
        assert recording.load_image(recording.frames[-1]).pixels.std() > 20


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_world_that_is_there_is_not_rendered_again(world: Path) -> None:
    image = world / "alpha" / "images" / "000000.jpg"
    before = image.stat().st_mtime_ns
    assert generate(SMALL, world) == [world / "alpha", world / "bravo"]
    assert image.stat().st_mtime_ns == before


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_same_seed_gives_the_same_bytes(world: Path, tmp_path: Path) -> None:
    with village():
        generate(SMALL, tmp_path, processes=1)
    files = sorted(path.relative_to(world) for path in world.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file())
    assert [f for f in files if (world / f).read_bytes() != (tmp_path / f).read_bytes()] == []


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_consecutive_views_match_as_geometry_says(world: Path) -> None:
    matched = Matcher([Recording.open(world / "alpha")]).compare((0, 0), (0, 1))
    assert matched.inliers > 100
    assert matched.rotation_error_deg < 1.0
    assert matched.direction_error_deg < 5.0


def walked(spec: WorldSpec) -> list[Float]:
    return [walk(spec, k, nodes).T_fixed_body for k, nodes in enumerate(routes(spec))]


@pytest.mark.parametrize("seed", range(5))
def test_robots_stay_clear_of_the_houses(seed: int) -> None:
    step = layout.STREET_M + layout.BLOCK_M
    for poses in walked(WorldSpec(seed=seed, robots=6)):
        from_middle = np.abs((poses[:, :2, 3] - layout.STREET_M / 2 + step / 2) % step - step / 2).min(axis=1)
        assert from_middle.max() < layout.STREET_M / 2 - 1.2


def shared_and_opposite(first: Float, second: Float) -> tuple[int, int]:
    """Poses of one robot within 2 m of the other's path that look the same way, and those that look back."""
    same = opposite = 0
    for T in first[::10]:
        relative = between(T, second[::10])
        near = np.linalg.norm(relative[:, :3, 3], axis=1) < 2.0
        angles = np.array([angle_rad(R) for R in relative[near, :3, :3]])
        same += bool(np.any(angles < np.deg2rad(25)))
        opposite += bool(np.any(angles > np.deg2rad(155)))
    return same, opposite


def test_every_two_robots_share_views_and_two_meet_head_on() -> None:
    paths = walked(WorldSpec())
    pairs = [(paths[a], paths[b]) for a, b in ((0, 1), (0, 2), (1, 2))]
    counts = [shared_and_opposite(a, b) for a, b in pairs]
    assert all(same >= 10 for same, _ in counts)
    assert max(opposite for _, opposite in counts) >= 10


def test_the_default_world_drifts_by_about_a_metre() -> None:
    spec = WorldSpec()
    estimated, true = [], []
    for index, nodes in enumerate(routes(spec)):
        truth = walk(spec, index, nodes)
        odometry = drifted(truth, spec.drift, np.random.default_rng([spec.seed, 6, index]))
        estimated.append(placed_at_true_start(odometry.T_fixed_body, truth.T_fixed_body))
        true.append(truth.T_fixed_body)
    error_m = ate_m(estimated, true)
    assert error_m is not None
    assert 0.5 < error_m < 2.0


def test_without_errors_odometry_is_the_truth() -> None:
    none = DriftSpec(
        scale_sigma_ratio=0,
        translation_sigma_m_per_sqrt_m=0,
        heading_rate_sigma_rad_per_m=0,
        heading_sigma_rad_per_sqrt_m=0,
    )
    truth = walk(WorldSpec(), 0, routes(WorldSpec())[0])
    odometry = drifted(truth, none, np.random.default_rng(0))
    np.testing.assert_allclose(odometry.T_fixed_body, truth.relative_to_first().T_fixed_body, atol=1e-9)


def test_drift_follows_the_generator() -> None:
    truth = walk(WorldSpec(), 0, routes(WorldSpec())[0])
    one, same, other = (drifted(truth, DriftSpec(), np.random.default_rng(k)).T_fixed_body for k in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.05
