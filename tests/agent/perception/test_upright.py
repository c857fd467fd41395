"""Registration by cameras that know which way is up: three correspondences, and gravity as a prior that is checked."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.agent.perception.classical_scenes import box, camera_at, seen_from

from flocc_agent.config import ClassicalConfig, PerceptionConfig
from flocc_agent.config.section import ConfigError, validated
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.geometry import Float, angle_rad, inverse, so3_exp
from flocc_agent.perception.classical import ClassicalEncoder
from flocc_agent.perception.classical.encoder import MODEL, decode_features, encode_features
from flocc_agent.perception.classical.features import Features
from flocc_agent.perception.classical.sift_registrar import ACCEPTANCE
from flocc_agent.perception.latent import BadLatent, pack, unpack
from flocc_agent.perception.multiview.acceptance import Evidence, OdometryNeighbour
from flocc_agent.perception.multiview.bundle import TiltPrior
from flocc_agent.perception.multiview.two_view import TwoView, two_view
from flocc_agent.perception.multiview.upright import levelled, upright_poses
from flocc_agent.perception.multiview.view_parameters import Geometry, Matched
from flocc_agent.perception.watch.camera_watch import CameraWatch

UP_WORLD = np.array([0.0, -1.0, 0.0])
FREE = Geometry(tilt_sigma_rad=np.inf)


def pair(seed: int, wrong_ratio: float, tilt_error_deg: float = 0.7) -> tuple[Features, Features, Float]:
    """Query and other image of one scene, tilted and turned at random, and `T_other_query`."""
    rng = np.random.default_rng(seed)
    scene = box(rng, 60)
    poses = [camera_at((0.0, 0.0, 0.0)), camera_at(tuple(rng.uniform(-1.5, 1.5, 3)), tuple(rng.normal(size=3) * 0.2))]
    images = []
    for k, T in enumerate(poses):
        seen = seen_from(scene, T, rng, wrong_ratio=wrong_ratio * k)
        up = so3_exp(rng.normal(size=3) * np.radians(tilt_error_deg)) @ T[:3, :3].T @ UP_WORLD
        images.append(Features(seen.points, seen.descriptors, seen.focal_px, up))
    return images[0], images[1], inverse(poses[1]) @ poses[0]


def same_points(query: Features, other: Features) -> Matched:
    """Which features are of one point: those that look alike."""
    alike = (query.descriptors[:, None] == other.descriptors[None]).all(axis=2)
    first, second = np.nonzero(alike)
    return first, second


def is_right(T: Float, truth: Float) -> bool:
    cosine = float(T[:3, 3] @ truth[:3, 3] / (np.linalg.norm(T[:3, 3]) * np.linalg.norm(truth[:3, 3])))
    return angle_rad(T[:3, :3].T @ truth[:3, :3]) < float(np.radians(5.0)) and cosine > float(np.cos(np.radians(15.0)))


def found(seed: int, wrong_ratio: float, geometry: Geometry) -> bool:
    query, other, truth = pair(seed, wrong_ratio)
    result = two_view(query, other, same_points(query, other), geometry)
    return isinstance(result, TwoView) and is_right(result.view.T_view_query, truth)


def test_levels_any_direction() -> None:
    rng = np.random.default_rng(3)
    for up in [*rng.normal(size=(20, 3)), np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])]:
        unit = up / np.linalg.norm(up)
        A = levelled(unit)
        assert A @ unit == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
        assert pytest.approx(np.eye(3), abs=1e-9) == A @ A.T
        assert np.linalg.det(A) == pytest.approx(1.0)


def test_finds_the_pose_of_exact_points_exactly() -> None:
    query, other, truth = pair(5, wrong_ratio=0.0, tilt_error_deg=0.0)
    assert query.up is not None
    assert other.up is not None
    i, j = same_points(query, other)
    points, observed = query.points[i].astype(float), other.points[j].astype(float)
    best = upright_poses(points, observed, (query.up, other.up), 2.0 / query.focal_px, 1)[0]
    assert is_right(best, truth)
    assert TiltPrior(query.up, other.up, 0.02).error_rad(best[:3, :3]) < 1e-6


def test_gravity_finds_pairs_of_which_two_thirds_of_the_matches_are_wrong() -> None:
    free, upright = (sum(found(seed, 0.67, geometry) for seed in range(40)) for geometry in (FREE, Geometry()))
    assert upright >= free
    assert upright >= 25


def test_a_wrong_gravity_takes_nothing_away() -> None:
    for seed in range(8):
        query, other, truth = pair(seed, wrong_ratio=0.0)
        upside_down = Features(query.points, query.descriptors, query.focal_px, np.array([0.0, 0.6, 0.8]))
        result = two_view(upside_down, other, same_points(query, other), Geometry())
        assert isinstance(result, TwoView)
        assert is_right(result.view.T_view_query, truth)


def test_fewer_than_three_correspondences_give_no_pose() -> None:
    up = np.array([0.0, -1.0, 0.0])
    assert upright_poses(np.zeros((2, 2)), np.zeros((2, 2)), (up, up), 0.01, 2) == []


def test_points_that_all_coincide_give_no_pose_and_no_error() -> None:
    up = np.array([0.0, -1.0, 0.0])
    same = np.tile([0.1, 0.2], (20, 1))
    for T in upright_poses(same, same, (up, up), 0.01, 2):
        assert np.all(np.isfinite(T))


def test_the_latent_says_which_way_is_up_and_a_latent_that_does_not_is_read_as_before() -> None:
    query, _, _ = pair(1, 0.0)
    read = decode_features(encode_features(query, {}))
    assert query.up is not None
    assert read.up == pytest.approx(query.up, abs=1e-5)
    silent = Features(query.points, query.descriptors, query.focal_px)
    assert decode_features(encode_features(silent, {})).up is None
    assert b'"up"' not in encode_features(silent, {})


@pytest.mark.parametrize("up", [[0.0, 0.0], [0.0, 0.0, 2.0], "up", [0.0, 0.0, None], [[1.0], 0.0, 0.0]])
def test_a_latent_whose_up_is_no_direction_is_bad(up: object) -> None:
    query, _, _ = pair(1, 0.0)
    content = unpack(encode_features(query, {}), MODEL)
    with pytest.raises(BadLatent, match="against gravity"):
        decode_features(pack(MODEL, {**content.header, "up": up}, content.arrays))


def test_the_watch_turns_up_from_odometry_into_the_camera() -> None:
    pixels = np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8)
    image = Image(pixels, Camera(160, 120, 130.0, 130.0, 80.0, 60.0))
    T_odom_camera = camera_at((1.0, 2.0, 3.0), (-np.pi / 2, 0.0, 0.0))
    upright = CameraWatch(up_odom=(0.0, 0.0, 2.0))._upright(image, T_odom_camera)
    assert upright.up == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)
    read = decode_features(ClassicalEncoder(ClassicalConfig()).encode(upright))
    assert read.up == pytest.approx([0.0, -1.0, 0.0], abs=1e-6)
    assert CameraWatch()._upright(image, T_odom_camera).up is None


@pytest.mark.parametrize("up", [[0.0, 0.0, 0.0], [0.0, 1.0], [0.0, 0.0, float("inf")]])
def test_a_configured_up_that_is_no_direction_is_refused(up: list[float]) -> None:
    with pytest.raises(ConfigError, match="odometry_up"):
        validated(PerceptionConfig, json.loads(json.dumps({"odometry_up": up})), "a file")


CERTAIN, AGREES = 0.01, OdometryNeighbour.AGREES


@pytest.mark.parametrize(
    ("evidence", "accepted"),
    [
        (Evidence(20, 0.1, True, CERTAIN, AGREES, 20, tilt_rad=0.03), True),
        (Evidence(19, 0.1, True, CERTAIN, AGREES, 20, tilt_rad=0.03), False),
        (Evidence(20, 0.1, True, CERTAIN, AGREES, 20, tilt_rad=0.06), False),
        (Evidence(20, 0.1, True, CERTAIN, AGREES, 20), False),
        (Evidence(20, 0.1, True, 0.02, AGREES, 20, tilt_rad=0.03), False),
        (Evidence(59, 0.1, True, CERTAIN, OdometryNeighbour.CONTRADICTS, 20, tilt_rad=0.0), False),
    ],
)
def test_gravity_and_neighbour_together_suffice_where_neither_does(evidence: Evidence, accepted: bool) -> None:
    assert ACCEPTANCE.accepts(evidence) is accepted
    doubtful = replace(evidence, neighbour=OdometryNeighbour.NOT_ASKED)
    assert ACCEPTANCE.needs_neighbour(doubtful) is (accepted or evidence.neighbour is OdometryNeighbour.CONTRADICTS)


def test_a_gravity_that_contradicts_takes_no_evidence_away() -> None:
    sure = Evidence(100, 0.1, True, 0.005)
    assert ACCEPTANCE.accepts(sure)
    assert ACCEPTANCE.accepts(replace(sure, tilt_rad=1.5))
