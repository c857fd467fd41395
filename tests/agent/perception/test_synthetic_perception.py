import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.perception.classical_scenes import camera_at

from flocc_agent.config import SyntheticConfig
from flocc_agent.core.interfaces import OdometryPair
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure, match_ratio
from flocc_agent.geometry import angle_rad, between, pose
from flocc_agent.perception.latent import BadLatent
from flocc_agent.perception.synthetic import SyntheticPerception, moved_latent, pose_image

Float = NDArray[np.float64]
EXACT = SyntheticConfig(
    rotation_sigma_rad=0.0,
    translation_sigma_ratio=0.0,
    outlier_probability=0.0,
    scale_sigma_ratio=0.0,
    scale_drift_sigma_ratio=0.0,
)


def odometry(perception: SyntheticPerception, T_query: Float, step_m: float = 0.5) -> OdometryPair:
    T_neighbour = T_query @ camera_at((0, 0, -step_m))
    return OdometryPair(perception.encode_pose(T_neighbour, "a/0"), between(T_neighbour, T_query), "a/0-a/1")


def closures(config: SyntheticConfig, seed: int, count: int = 300) -> list[tuple[Registration, Float]]:
    """Registrations of poses 1 m apart, with the true poses."""
    perception = SyntheticPerception(config, seed)
    T_query, T_match = camera_at((3, 1, 0), (0, 0.4, 0)), camera_at((3.6, 1.8, 0), (0, 0.5, 0))
    pairs = []
    for k in range(count):
        latents = perception.encode_pose(T_query, f"a/{k}"), perception.encode_pose(T_match, f"b/{k}")
        result = perception.register(*latents, odometry(perception, T_query))
        if isinstance(result, Registration):
            pairs.append((result, between(T_query, T_match)))
    return pairs


def test_without_noise_the_closure_is_the_truth_by_equation_6() -> None:
    ((result, truth),) = closures(EXACT, seed=1, count=1)

    assert result.scale_initial == pytest.approx(1.0)
    np.testing.assert_allclose(result.T_query_match_unscaled, truth, atol=5e-3)


def test_results_depend_on_seed_and_keys_and_not_on_the_order_of_calls() -> None:
    def results(seed: int, order: list[int]) -> dict[int, bytes]:
        perception = SyntheticPerception(SyntheticConfig(), seed)
        found = {}
        for k in order:
            query = perception.encode_pose(camera_at((0, 0, 0)), f"a/{k}")
            match = perception.encode_pose(camera_at((1, 0, 0)), f"b/{k}")
            result = perception.register(query, match, None)
            found[k] = result.T_query_match_unscaled.tobytes() if isinstance(result, Registration) else b""
        return found

    assert results(1, [0, 1, 2, 3]) == results(1, [3, 1, 0, 2])
    assert results(1, [0, 1, 2, 3]) != results(2, [0, 1, 2, 3])


def test_similarity_falls_with_distance_and_with_the_viewing_angle() -> None:
    perception = SyntheticPerception(SyntheticConfig(alias_probability=0.0), 3)
    here = perception.describe_pose(np.eye(4), "a/0")

    by_distance = [here @ perception.describe_pose(camera_at((d, 0, 0)), "b/0") for d in (0.0, 2.0, 4.0, 20.0)]
    by_angle = [here @ perception.describe_pose(camera_at((0, 0, 0), (0, a, 0)), "b/0") for a in (0.0, 0.5, 1.0, 3.1)]

    assert by_distance == sorted(by_distance, reverse=True)
    assert by_angle == sorted(by_angle, reverse=True)
    assert by_distance[0] > 0.85
    assert max(abs(by_distance[-1]), abs(by_angle[-1])) < 0.3
    assert np.linalg.norm(here) == pytest.approx(1.0, abs=1e-5)


def test_aliased_places_look_alike() -> None:
    config = SyntheticConfig(alias_probability=1.0, alias_places=1, descriptor_noise_ratio=0.0)
    perception = SyntheticPerception(config, 4)

    similarity = perception.describe_pose(camera_at((1, 2, 3)), "a") @ perception.describe_pose(
        camera_at((51, 22, 33)), "b"
    )

    assert similarity == pytest.approx(1.0, abs=1e-4)


def test_correspondences_fall_with_distance_until_there_is_no_registration() -> None:
    perception = SyntheticPerception(EXACT, 5)
    query = perception.encode_pose(np.eye(4), "a/0")
    results = [
        perception.register(query, perception.encode_pose(camera_at((d, 0, 0)), "b/0"), None)
        for d in (0.0, 4.0, 8.0, 30.0)
    ]

    counts = [result.correspondences for result in results]
    assert counts == sorted(counts, reverse=True)
    last = results[-1]
    assert isinstance(last, RegistrationFailed)
    assert last.failure is RegistrationFailure.FEW_CORRESPONDENCES


def test_outliers_come_as_often_as_configured_with_a_lower_ratio() -> None:
    pairs = closures(SyntheticConfig(outlier_probability=0.2), seed=6)

    wrong = [r for r, truth in pairs if angle_rad(r.T_query_match_unscaled[:3, :3].T @ truth[:3, :3]) > 0.2]
    right = [r for r, truth in pairs if angle_rad(r.T_query_match_unscaled[:3, :3].T @ truth[:3, :3]) <= 0.2]

    def median_ratio(results: list[Registration]) -> float:
        return float(np.median([match_ratio(r.correspondences, r.odometry_correspondences) for r in results]))

    assert 0.12 < len(wrong) / len(pairs) < 0.28
    assert median_ratio(wrong) < 0.6 * median_ratio(right)


def test_noise_is_what_the_covariance_says() -> None:
    squared = []
    for result, truth in closures(SyntheticConfig(outlier_probability=0.0, scale_sigma_ratio=0.0), seed=7):
        assert result.covariance is not None
        t = between(truth, result.T_query_match_unscaled)[:3, 3]
        squared.append(float(t @ np.linalg.solve(result.covariance[3:, 3:], t)))

    assert 2.5 < np.mean(squared) < 3.5  # three degrees of freedom


def test_scales_spread_and_equation_6_undoes_all_but_the_drift() -> None:
    config = SyntheticConfig(outlier_probability=0.0, scale_sigma_ratio=0.5, scale_drift_sigma_ratio=0.1)
    pairs = closures(config, seed=8)

    lengths = np.array([np.linalg.norm(r.T_query_match_unscaled[:3, 3]) for r, _ in pairs])
    scales = np.array([r.scale_initial for r, _ in pairs], float)

    assert 0.4 < np.std(np.log(lengths)) < 0.6
    assert 0.08 < np.std(np.log(scales * lengths)) < 0.14


def test_no_motion_of_odometry_gives_no_scale() -> None:
    perception = SyntheticPerception(EXACT, 9)
    query, match = perception.encode_pose(np.eye(4), "a/1"), perception.encode_pose(camera_at((1, 0, 0)), "b/1")

    result = perception.register(query, match, odometry(perception, np.eye(4), step_m=0.0))

    assert isinstance(result, Registration)
    assert result.scale_initial is None
    assert result.odometry_correspondences > 0


def test_an_image_of_a_pose_is_worth_the_pose() -> None:
    perception = SyntheticPerception(SyntheticConfig(), 10)
    T = camera_at((1, 2, 3), (0.1, 0.2, 0.3))

    image = pose_image(T, "a/7")

    np.testing.assert_array_equal(perception.describe(image), perception.describe_pose(T, "a/7"))
    via_image = perception.register(perception.encode(image), perception.encode_pose(T, "b/1"), None)
    direct = perception.register(perception.encode_pose(T, "a/7"), perception.encode_pose(T, "b/1"), None)
    assert isinstance(via_image, Registration)
    assert isinstance(direct, Registration)
    np.testing.assert_array_equal(via_image.T_query_match_unscaled, direct.T_query_match_unscaled)


def test_a_latent_of_a_camera_with_something_on_it_is_registered_from_where_it_seems_to_be() -> None:
    perception = SyntheticPerception(EXACT, 10)
    T = camera_at((1, 2, 3), (0.1, 0.2, 0.3))
    one_to_the_right = T @ pose(np.eye(3), np.array([1.0, 0.0, 0.0]))

    moved = moved_latent(perception.encode_pose(T, "a/7"), 1.0)

    assert len(moved) == len(perception.encode_pose(T, "a/7"))
    at_rest = perception.register(perception.encode_pose(one_to_the_right, "b/1"), moved, None)
    assert isinstance(at_rest, Registration)
    np.testing.assert_allclose(at_rest.T_query_match_unscaled, np.eye(4), atol=1e-3)
    with pytest.raises(BadLatent, match="not a synthetic latent"):
        moved_latent(b"", 1.0)


def test_latents_are_padded_to_load_links() -> None:
    perception = SyntheticPerception(SyntheticConfig(latent_bytes=50_000), 11)

    assert len(perception.encode_pose(np.eye(4), "a/0")) == 50_000


@pytest.mark.parametrize("damage", [b"", b"x" * 200, "cut", "nan"])
def test_a_bad_latent_is_a_failure_and_no_exception(damage: bytes | str) -> None:
    perception = SyntheticPerception(SyntheticConfig(), 12)
    good = perception.encode_pose(np.eye(4), "a/0")
    broken = np.full((4, 4), np.nan)
    bad = {"cut": good[:-1], "nan": perception.encode_pose(broken, "a/0")}.get(str(damage), damage)
    assert isinstance(bad, bytes)

    result = perception.register(good, bad, None)

    assert isinstance(result, RegistrationFailed)
    assert result.failure is RegistrationFailure.BAD_LATENT


def test_a_key_that_is_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="longer than 255"):
        SyntheticPerception(SyntheticConfig(), 13).encode_pose(np.eye(4), "k" * 256)
