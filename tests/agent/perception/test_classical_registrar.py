from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.perception.classical_scenes import PointScene, box, camera_at, seen_from, wall

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import OdometryPair
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.geometry import angle_rad, between
from flocc_agent.perception.classical import classical_registrar
from flocc_agent.perception.classical.encoder import MODEL, decode_features, encode_features
from flocc_agent.perception.classical.features import Features
from flocc_agent.perception.latent import BadLatent, pack
from flocc_agent.perception.multiview import registrar as pair_registrar

Float = NDArray[np.float64]

NEIGHBOUR = camera_at((-0.5, 0.1, 0.0), (0.0, 0.02, 0.0))
QUERY = np.eye(4)
MATCH = camera_at((0.9, -0.3, 0.6), (0.05, 0.2, -0.1))


def latent_from(scene: PointScene, T_world_camera: Float, seed: int, wrong_ratio: float = 0.1) -> bytes:
    rng = np.random.default_rng(seed)
    return encode_features(seen_from(scene, T_world_camera, rng, wrong_ratio=wrong_ratio), {})


def register(
    scene: PointScene, T_match: Float, with_odometry: bool, T_neighbour: Float = NEIGHBOUR
) -> Registration | RegistrationFailed:
    odometry = None
    if with_odometry:
        odometry = OdometryPair(latent_from(scene, T_neighbour, 11), between(T_neighbour, QUERY), "n-q")
    registrar = classical_registrar(ClassicalConfig(acceptance="ratio"))
    return registrar.register(latent_from(scene, QUERY, 12), latent_from(scene, T_match, 13), odometry)


def test_odometry_makes_the_closure_metric_by_equation_6() -> None:
    result = register(box(np.random.default_rng(1)), MATCH, with_odometry=True)

    assert isinstance(result, Registration)
    assert result.scale_initial is not None
    assert result.scale_initial == pytest.approx(float(np.linalg.norm(between(NEIGHBOUR, QUERY)[:3, 3])))
    t_m = result.scale_initial * result.T_query_match_unscaled[:3, 3]
    np.testing.assert_allclose(t_m, MATCH[:3, 3], atol=0.04)
    assert np.degrees(angle_rad(result.T_query_match_unscaled[:3, :3].T @ MATCH[:3, :3])) < 0.5


def test_without_odometry_there_is_a_direction_and_no_scale() -> None:
    result = register(box(np.random.default_rng(1)), MATCH, with_odometry=False)

    assert isinstance(result, Registration)
    assert (result.scale_initial, result.odometry_correspondences) == (None, 0)
    t = result.T_query_match_unscaled[:3, 3]
    assert np.linalg.norm(t) == pytest.approx(1.0)
    np.testing.assert_allclose(t, MATCH[:3, 3] / np.linalg.norm(MATCH[:3, 3]), atol=0.05)
    assert result.covariance is not None
    direction = MATCH[:3, :3].T @ t
    assert direction @ result.covariance[3:, 3:] @ direction > 0.9  # the length is not known


def test_the_covariance_covers_the_error() -> None:
    squared = []
    for seed in range(20):
        result = register(box(np.random.default_rng(seed), 80), MATCH, with_odometry=True)
        assert isinstance(result, Registration)
        assert result.covariance is not None
        assert result.scale_initial is not None
        expected = MATCH.copy()
        expected[:3, 3] /= result.scale_initial
        error = between(result.T_query_match_unscaled, expected)
        t = error[:3, 3]
        squared.append(float(t @ np.linalg.solve(result.covariance[3:, 3:], t)))
    assert np.median(squared) < 6.0  # 2.4 for three degrees of freedom; a tenth of the points is wrong


def test_turning_on_the_spot_is_a_closure_where_odometry_gives_structure() -> None:
    result = register(box(np.random.default_rng(2)), camera_at((0, 0, 0), (0.0, 0.2, 0.0)), with_odometry=True)

    assert isinstance(result, Registration)
    assert result.scale_initial is not None
    assert np.linalg.norm(result.T_query_match_unscaled[:3, 3]) * result.scale_initial < 0.02


def test_turning_on_the_spot_is_degenerate_without_structure() -> None:
    result = register(box(np.random.default_rng(2)), camera_at((0, 0, 0), (0.0, 0.2, 0.0)), with_odometry=False)

    assert isinstance(result, RegistrationFailed)
    assert result.failure is RegistrationFailure.DEGENERATE
    assert "rotation only" in result.detail


def test_odometry_that_did_not_move_gives_no_scale() -> None:
    result = register(box(np.random.default_rng(3)), MATCH, True, T_neighbour=camera_at((0, 0, 0), (0.0, 0.1, 0.0)))

    assert isinstance(result, Registration)
    assert result.scale_initial is None
    assert result.odometry_correspondences > 100


@pytest.mark.parametrize("seed", [4, 5, 6])
def test_a_plane_alone_is_degenerate_since_two_motions_explain_it(seed: int) -> None:
    alone = register(wall(np.random.default_rng(seed)), MATCH, with_odometry=False)

    assert isinstance(alone, RegistrationFailed)
    assert alone.failure is RegistrationFailure.DEGENERATE
    assert "one plane" in alone.detail


@pytest.mark.parametrize("seed", [4, 5, 6])
def test_odometry_tells_the_two_motions_of_a_plane_apart(seed: int) -> None:
    with_structure = register(wall(np.random.default_rng(seed)), MATCH, with_odometry=True)

    assert isinstance(with_structure, Registration)
    assert with_structure.scale_initial is not None
    t_m = with_structure.scale_initial * with_structure.T_query_match_unscaled[:3, 3]
    np.testing.assert_allclose(t_m, MATCH[:3, 3], atol=0.08)


def test_another_place_has_few_correspondences() -> None:
    registrar = classical_registrar(ClassicalConfig(acceptance="ratio"))
    here, elsewhere = box(np.random.default_rng(5)), box(np.random.default_rng(6))

    result = registrar.register(latent_from(here, QUERY, 1), latent_from(elsewhere, QUERY, 2), None)

    assert isinstance(result, RegistrationFailed)
    assert result.failure is RegistrationFailure.FEW_CORRESPONDENCES
    assert "needed" in result.detail


def test_loop_pair_and_odometry_pair_are_counted_alike() -> None:
    scene = box(np.random.default_rng(7))
    neighbour, query = latent_from(scene, NEIGHBOUR, 11), latent_from(scene, QUERY, 12)
    odometry = OdometryPair(neighbour, between(NEIGHBOUR, QUERY), "n-q")

    result = classical_registrar(ClassicalConfig(acceptance="ratio")).register(query, neighbour, odometry)

    assert isinstance(result, Registration)
    assert result.correspondences == result.odometry_correspondences


def test_the_same_latents_give_the_same_bytes_in_any_thread() -> None:
    scene = box(np.random.default_rng(8))
    query = latent_from(scene, QUERY, 1, wrong_ratio=0.5)
    matches = [latent_from(scene, MATCH, seed, wrong_ratio=0.5) for seed in range(6)]
    registrar = classical_registrar(ClassicalConfig(acceptance="ratio"))

    def result(match: bytes) -> bytes:
        found = registrar.register(query, match, None)
        assert isinstance(found, Registration)
        return found.T_query_match_unscaled.tobytes()

    expected = [result(match) for match in matches]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(result, matches * 4)) == expected * 4


def test_odometry_pairs_are_kept_by_key_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = box(np.random.default_rng(9))
    query, match = latent_from(scene, QUERY, 1), latent_from(scene, MATCH, 2)
    monkeypatch.setattr(pair_registrar, "ODOMETRY_PAIRS_MAX", 2)
    registrar = classical_registrar(ClassicalConfig(acceptance="ratio"))
    neighbour, changed = latent_from(scene, NEIGHBOUR, 3), latent_from(scene, NEIGHBOUR, 4)
    read: list[bytes] = []
    decode = registrar._read

    def reading(latent: bytes) -> Features:
        read.append(latent)
        return decode(latent)

    monkeypatch.setattr(registrar, "_read", reading)

    def times_read(key: str, latent: bytes = neighbour) -> int:
        read.clear()
        registrar.register(query, match, OdometryPair(latent, between(NEIGHBOUR, QUERY), key))
        return read.count(latent)

    assert [times_read(key) for key in "aabca"] == [1, 0, 1, 1, 1]
    assert times_read("a", changed) == 1  # a latent that lost what moves with the camera is another one


@pytest.mark.parametrize(
    "latent",
    [
        b"",
        b"\x80\x04pickle",
        pack(MODEL, {"focal_px": 500.0}, {}),
        pack(MODEL, {"focal_px": 0}, {"points": np.zeros((9, 2), "f4"), "descriptors": np.zeros((9, 128), "u1")}),
        pack(MODEL, {"focal_px": 9.0}, {"points": np.zeros((8, 2), "f4"), "descriptors": np.zeros((9, 128), "u1")}),
        pack(MODEL, {"focal_px": 9.0}, {"points": np.full((9, 2), 1e9, "f4"), "descriptors": np.zeros((9, 128), "u1")}),
    ],
)
def test_a_bad_latent_of_a_peer_is_a_failure_and_no_exception(latent: bytes) -> None:
    good = latent_from(box(np.random.default_rng(10)), QUERY, 1)

    result = classical_registrar(ClassicalConfig(acceptance="ratio")).register(good, latent, None)

    assert isinstance(result, RegistrationFailed)
    assert result.failure is RegistrationFailure.BAD_LATENT
    assert result.detail


def test_features_survive_the_latent() -> None:
    features = seen_from(box(np.random.default_rng(11)), QUERY, np.random.default_rng(1))

    read = decode_features(encode_features(features, {"width": 640}))

    np.testing.assert_array_equal(read.points, features.points)
    np.testing.assert_array_equal(read.descriptors, features.descriptors)
    assert read.focal_px == features.focal_px


def test_a_latent_of_no_features_is_read_and_not_registered() -> None:
    empty = pack(
        MODEL, {"focal_px": 500.0}, {"points": np.zeros((0, 2), "f4"), "descriptors": np.zeros((0, 128), "u1")}
    )
    registrar = classical_registrar(ClassicalConfig(acceptance="ratio"))

    result = registrar.register(empty, empty, None)

    assert isinstance(result, RegistrationFailed)
    assert result.failure is RegistrationFailure.FEW_CORRESPONDENCES
    with pytest.raises(BadLatent):
        decode_features(b"x")


def _odd_positions(kind: str, rng: np.random.Generator, count: int) -> Float:
    """Feature positions (N, 2) that no sensible scene gives."""
    t = rng.uniform(-0.5, 0.5, count)
    few = rng.uniform(-0.5, 0.5, (3, 2))
    return {
        "one point": np.zeros((count, 2)),
        "a line": np.column_stack([t, 0.3 * t]),
        "three points": few[rng.integers(0, 3, count)],
        "far out": np.column_stack([t * 190, t * 10]),
        "noise": rng.uniform(-0.5, 0.5, (count, 2)),
        "a conic": np.column_stack([t, t**2]),
    }[kind]


KINDS = ("one point", "a line", "three points", "far out", "noise", "a conic")


@pytest.mark.parametrize("kind", KINDS)
def test_odd_features_give_a_result_or_a_failure_and_no_exception(kind: str) -> None:
    rng = np.random.default_rng(14)
    descriptors = rng.integers(0, 256, (60, 128), dtype=np.uint8)

    def latent(of_kind: str) -> bytes:
        points = _odd_positions(of_kind, rng, 60).astype(np.float32)
        return pack(MODEL, {"focal_px": 400.0}, {"points": points, "descriptors": descriptors})

    query = latent(kind)
    for other in KINDS:
        match = latent(other)
        for T in (NEIGHBOUR, QUERY):
            odometry = OdometryPair(latent(other), between(T, QUERY), other)
            result = classical_registrar(ClassicalConfig(acceptance="ratio")).register(query, match, odometry)
            same = classical_registrar(ClassicalConfig(acceptance="ratio")).register(query, query, odometry)
            for found in (result, same):
                if isinstance(found, Registration):
                    assert np.all(np.isfinite(found.T_query_match_unscaled))
                    assert found.covariance is not None
                    assert np.all(np.linalg.eigvalsh(found.covariance) > 0)
