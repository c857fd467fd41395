import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.perception.classical_scenes import FOCAL_PX, box, camera_at, seen_from

from flocc_agent.geometry import angle_rad, inverse, pose, se3_log, so3_exp
from flocc_agent.perception.classical.matching import mutual_matches
from flocc_agent.perception.multiview.bundle import (
    BundleView,
    _linearise,
    covariance_of_view,
    inverse_depths_from,
    refine,
)
from flocc_agent.perception.multiview.two_view import TwoView, decompose_essential, two_view
from flocc_agent.perception.multiview.view_parameters import Geometry

Float = NDArray[np.float64]
GEOMETRY = Geometry()


def test_matches_are_mutual_nearest_neighbours_that_pass_the_ratio_test() -> None:
    rng = np.random.default_rng(1)
    first = rng.integers(0, 256, (60, 128), dtype=np.uint8)
    second = np.concatenate([first[20:50] ^ rng.integers(0, 8, (30, 128), dtype=np.uint8), first[:5], first[:5]])

    i, j = mutual_matches(first, second, 0.8)

    assert i.tolist() == list(range(20, 50))  # the first five have two equal neighbours each
    assert j.tolist() == list(range(30))


def test_matches_do_not_depend_on_which_image_comes_first() -> None:
    rng = np.random.default_rng(2)
    first = rng.integers(0, 40, (200, 128), dtype=np.uint8)
    second = rng.integers(0, 40, (150, 128), dtype=np.uint8)

    i, j = mutual_matches(first, second, 0.995)
    swapped_j, swapped_i = mutual_matches(second, first, 0.995)

    assert len(i) > 10
    assert set(zip(i.tolist(), j.tolist(), strict=True)) == set(
        zip(swapped_i.tolist(), swapped_j.tolist(), strict=True)
    )


@pytest.mark.parametrize("count", [0, 1])
def test_no_matches_with_an_image_that_has_no_features(count: int) -> None:
    features = np.zeros((count, 128), np.uint8)

    i, j = mutual_matches(features, np.ones((50, 128), np.uint8), 0.8)

    assert len(i) == len(j) == 0


def test_an_essential_matrix_has_four_poses_one_of_them_true() -> None:
    T = pose(so3_exp(np.array([0.1, -0.3, 0.2])), np.array([0.6, 0.0, 0.8]))
    x, y, z = T[:3, 3]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ T[:3, :3]

    poses = decompose_essential(-2.5 * E)

    assert len(poses) == 4
    assert sum(np.allclose(candidate, T, atol=1e-9) for candidate in poses) == 1
    assert all(np.isclose(np.linalg.det(candidate[:3, :3]), 1.0) for candidate in poses)


def _two_views(rng: np.random.Generator, sigma_px: float) -> tuple[Float, Float, tuple[BundleView, ...], Float]:
    """Points in the query, their inverse depths, two views with true poses, and the true match pose."""
    world = rng.uniform([-3, -2, 4], [3, 2, 9], (120, 3))
    points = world[:, :2] / world[:, 2:]
    views = []
    for k, T_query_view in enumerate((camera_at((-1, 0, 0)), camera_at((0.8, 0.3, 0.5), (0.1, -0.2, 0.05)))):
        T = inverse(T_query_view)
        p = world @ T[:3, :3].T + T[:3, 3]
        observed = p[:, :2] / p[:, 2:] + rng.normal(0, sigma_px / FOCAL_PX, (len(p), 2))
        views.append(BundleView(T, observed, np.arange(len(p)) % 5 != k, FOCAL_PX, unit_translation=k == 0))
    return points, 1.0 / world[:, 2], tuple(views), inverse(views[1].T_view_query)


def test_gradient_agrees_with_numerical_differentiation() -> None:
    rng = np.random.default_rng(3)
    points, depths, views, _ = _two_views(rng, 1.0)
    rays = np.column_stack([points, np.ones(len(points))])
    view = views[1]
    state = _linearise(rays, depths, views, 1.0)
    step = 1e-6
    numerical = np.zeros(6)
    for k in range(6):
        costs = []
        for sign in (1.0, -1.0):
            delta = np.zeros(6)
            delta[k] = sign * step
            T = pose(so3_exp(delta[:3]) @ view.T_view_query[:3, :3], view.T_view_query[:3, 3] + delta[3:])
            moved = BundleView(T, view.observed, view.seen, FOCAL_PX, unit_translation=False)
            costs.append(_linearise(rays, depths, (views[0], moved), 1.0).cost)
        numerical[k] = (costs[0] - costs[1]) / (2 * step)

    np.testing.assert_allclose(2.0 * state.b[6:], numerical, rtol=1e-4, atol=1e-3)


def test_refinement_recovers_poses_and_length_from_a_disturbed_start() -> None:
    rng = np.random.default_rng(4)
    points, depths, views, T_true = _two_views(rng, 0.0)
    disturbed = pose(so3_exp(np.array([0.05, -0.04, 0.03])), np.array([0.1, -0.1, 0.2])) @ views[1].T_view_query
    start = (views[0], BundleView(disturbed, views[1].observed, views[1].seen, FOCAL_PX, unit_translation=False))

    refined = refine(points, depths * 1.1, start, 0.7, iterations_max=50)

    error = se3_log(inverse(T_true) @ inverse(refined.views[1].T_view_query))
    assert np.abs(error).max() < 1e-4


def test_covariance_is_that_of_repeated_measurements() -> None:
    rng = np.random.default_rng(5)
    normalised = []
    for _ in range(120):
        points, depths, views, T_true = _two_views(np.random.default_rng(6), 0.0)
        noisy = tuple(
            BundleView(
                v.T_view_query, v.observed + rng.normal(0, 0.7 / FOCAL_PX, v.observed.shape), v.seen, FOCAL_PX, u
            )
            for v, u in zip(views, (True, False), strict=True)
        )
        refined = refine(points, depths, noisy, 0.7)
        covariance = covariance_of_view(refined, 1, np.zeros(6))
        error = se3_log(inverse(T_true) @ inverse(refined.views[1].T_view_query))
        normalised.append(float(error @ np.linalg.solve(covariance, error)))

    assert 4.5 < np.mean(normalised) < 9.0  # six for a chi-square of six degrees; robust weights cost a little


@pytest.mark.parametrize("wrong_ratio", [0.0, 0.4])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_views_give_rotation_and_direction(seed: int, wrong_ratio: float) -> None:
    rng = np.random.default_rng(seed)
    scene = box(rng)
    T = camera_at((0.8, -0.2, 0.4), (0.05, 0.15, -0.1))
    query = seen_from(scene, np.eye(4), rng)

    other = seen_from(scene, T, rng, wrong_ratio=wrong_ratio)
    matched = mutual_matches(query.descriptors, other.descriptors, 0.8)
    pair = two_view(query, other, matched, GEOMETRY)

    assert isinstance(pair, TwoView)
    T_query_other = inverse(pair.view.T_view_query)
    assert np.degrees(angle_rad(T_query_other[:3, :3].T @ T[:3, :3])) < 0.5
    assert T_query_other[:3, 3] @ T[:3, 3] / np.linalg.norm(T[:3, 3]) > np.cos(np.radians(3.0))
    assert np.linalg.norm(T_query_other[:3, 3]) == pytest.approx(1.0)


def test_inverse_depths_are_those_of_the_points() -> None:
    points, depths, views, _ = _two_views(np.random.default_rng(8), 0.0)

    found = inverse_depths_from(points, views[1].T_view_query, views[1].observed)

    np.testing.assert_allclose(found, depths, rtol=1e-6)
