"""Relative pose from pointmaps and matches: calibrated, uncalibrated, its covariance and its failures."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from tests.agent.perception.mast3r_examples import golden

from flocc_agent.geometry import inverse, se3_exp, se3_log
from flocc_agent.perception.mast3r.relative_pose import (
    PnpParameters,
    PoseFailed,
    RelativePose,
    relative_pose,
    reprojection_jacobian,
    reray,
    weiszfeld_focal,
)
from flocc_lab.bench.pose_table import draw_scene, row, solve, table, true_K


@pytest.mark.golden
def test_focal_lengths_equal_the_references() -> None:
    case = golden("geom.pt")["focal"]
    points, principal = case["pts3d"].numpy(), (float(case["pp"][0]), float(case["pp"][1]))
    assert weiszfeld_focal(points, principal) == pytest.approx(float(case["weiszfeld"]), rel=1e-5)
    assert weiszfeld_focal(points, principal, clip=True) == pytest.approx(float(case["weiszfeld_clip"]), rel=1e-5)


def test_calibrated_direction_stays_under_a_degree_and_a_half_in_every_row() -> None:
    rows = table(trials=8, modes=("calibrated",))
    assert len(rows) == 8
    for found in rows:
        assert found["failed"] == 0
        assert float(found["direction_median_deg"]) < 1.5, found
        assert float(found["rotation_median_deg"]) < 0.5, found


def test_the_trap_is_real_and_reraying_avoids_it() -> None:
    rng = np.random.default_rng(4)
    scenes = [draw_scene(rng, 0.3, 0.1) for _ in range(5)]
    trapped, calibrated = (row(mode, 0.3, 0.1, scenes) for mode in ("true K on the raw pointmap", "calibrated"))
    assert float(trapped["direction_median_deg"]) > 20
    assert float(calibrated["direction_median_deg"]) < 1.5


def test_translation_is_in_the_units_of_the_pointmap() -> None:
    scene = draw_scene(np.random.default_rng(3), 0.0, 0.0)
    points = reray(scene.pts3d.reshape(-1, 3)[:, 2], scene.uv_1, true_K())
    lengths = []
    for unit in (1.0, 250.0):
        solved = relative_pose(points * unit, scene.uv_2, true_K(), PnpParameters())
        assert isinstance(solved, RelativePose)
        lengths.append(np.linalg.norm(solved.T_1_2_unscaled[:3, 3]) / unit)
        assert np.sqrt(np.diag(solved.covariance)[3:]).max() < 0.2 * unit
    assert lengths == pytest.approx([1.0, 1.0], abs=0.05)


def test_the_jacobian_agrees_with_numerical_differentiation() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -2, 4], [2, 2, 9], (5, 3))
    T_1_2, K = se3_exp(rng.normal(0, 0.1, 6)), true_K()

    def projected(xi: np.ndarray) -> np.ndarray:
        T_2_1 = inverse(T_1_2 @ se3_exp(xi))
        p = points @ T_2_1[:3, :3].T + T_2_1[:3, 3]
        return np.asarray((p[:, :2] / p[:, 2:] * K[0, 0]).reshape(-1))

    step = 1e-6
    numerical = np.column_stack([(projected(step * e) - projected(-step * e)) / (2 * step) for e in np.eye(6)])
    assert np.allclose(reprojection_jacobian(points, K, inverse(T_1_2)), numerical, rtol=1e-5, atol=1e-3)


def test_the_covariance_covers_the_errors() -> None:
    rng = np.random.default_rng(1)
    distances = []
    for _ in range(30):
        scene = draw_scene(rng, 0.3, 0.1)
        solved = solve(scene, "calibrated")
        assert isinstance(solved, RelativePose)
        error = se3_log(inverse(scene.T_1_2) @ solved.T_1_2_unscaled)
        distances.append(error @ np.linalg.solve(solved.covariance, error))
    assert 1.5 < float(np.median(distances)) < 30  # about 5.3 for six degrees of freedom; depth noise is not Gaussian


def test_random_matches_give_no_pose_and_say_why() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([-3, -2, 3], [3, 2, 15], (300, 3))
    solved = relative_pose(points, rng.uniform(0, 400, (300, 2)), true_K(), PnpParameters(inliers_min=20))
    assert isinstance(solved, PoseFailed)
    assert "of 300 matches agree" in solved.detail


@pytest.mark.parametrize("spoil", ["behind", "not finite", "few"])
def test_unusable_points_give_no_pose(spoil: str) -> None:
    points = np.ones((30, 3))
    points = {"behind": -points, "not finite": points * np.nan, "few": points[:3]}[spoil]
    solved = relative_pose(points, np.zeros((len(points), 2)), true_K(), PnpParameters())
    assert isinstance(solved, PoseFailed)
    assert "in front of the camera" in solved.detail


def test_one_point_many_times_gives_no_pose() -> None:
    points = np.tile([0.1, 0.2, 4.0], (50, 1))
    solved = relative_pose(points, np.tile([200.0, 150.0], (50, 1)), true_K(), PnpParameters())
    assert isinstance(solved, PoseFailed)


def test_a_map_without_depth_has_no_focal_length() -> None:
    assert weiszfeld_focal(np.zeros((8, 8, 3)), (4.0, 4.0)) is None
