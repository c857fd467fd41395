"""When a registered pair is a closure."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.agent.perception.classical_scenes import box, camera_at, seen_from

from flocc_agent.core.interfaces import OdometryPair
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.geometry import between
from flocc_agent.perception.classical.encoder import decode_features, encode_features
from flocc_agent.perception.classical.features import Features
from flocc_agent.perception.classical.matching import mutual_matches
from flocc_agent.perception.multiview.acceptance import Acceptance, Evidence, Needed, OdometryNeighbour, agree
from flocc_agent.perception.multiview.registrar import PairRegistrar
from flocc_agent.perception.multiview.view_parameters import Geometry, Matched

Float = NDArray[np.float64]

RULE = Acceptance(Needed(40, 20, 0.02), Needed(80, 30, 0.02), 0.3)
SURE = Evidence(50, 0.1, True, 0.01)
NEIGHBOUR, QUERY = camera_at((-0.6, 0.1, 0.0)), camera_at((0, 0, 0))
MATCH = camera_at((1.0, 0.2, 0.5), (0.0, 0.2, 0.0))


@pytest.mark.parametrize(
    ("evidence", "asks", "accepts"),
    [
        (SURE, False, True),
        (replace(SURE, has_scale=False), True, False),
        (replace(SURE, has_scale=False, neighbour=OdometryNeighbour.AGREES), True, True),
        (replace(SURE, has_scale=False, neighbour=OdometryNeighbour.CONTRADICTS), True, False),
        (replace(SURE, correspondences=25), True, False),
        (replace(SURE, correspondences=25, neighbour=OdometryNeighbour.SEES_NOTHING), True, False),
        (replace(SURE, correspondences=19, neighbour=OdometryNeighbour.AGREES), False, False),
        (replace(SURE, rotation_sigma_rad=0.03), False, False),
        (replace(SURE, rotation_sigma_rad=0.03, match_ratio=0.3), False, True),
        (replace(SURE, correspondences=19, match_ratio=0.9), False, False),
        (replace(SURE, correspondences=25, rotation_sigma_rad=0.03), False, False),
    ],
)
def test_a_pair_needs_a_count_or_a_smaller_one_and_its_neighbour(evidence: Evidence, asks: bool, accepts: bool) -> None:
    assert (RULE.needs_neighbour(evidence), RULE.accepts(evidence)) == (asks, accepts)


@pytest.mark.parametrize("scale", [None, 2.0])
def test_two_registrations_of_one_match_agree_or_contradict(scale: float | None) -> None:
    T_query_match = between(QUERY, MATCH)
    T_query_match[:3, 3] /= scale or float(np.linalg.norm(T_query_match[:3, 3]))
    result = Registration(T_query_match, 50, 100, scale)
    found = between(NEIGHBOUR, MATCH)
    turned = found @ camera_at((0, 0, 0), (0.0, 0.15, 0.0))
    aside = found.copy()
    aside[:3, 3] = [-1.0, 0.5, 0.0]

    says = [agree(T, result, between(NEIGHBOUR, QUERY)) for T in (found, turned, aside)]

    assert says == [True, False, False]


def registrar(rule: Acceptance) -> PairRegistrar[Features]:
    def match(first: Features, second: Features) -> Matched:
        return mutual_matches(first.descriptors, second.descriptors, 0.8)

    return PairRegistrar(decode_features, match, Geometry(), rule)


def test_a_pair_in_doubt_is_accepted_when_the_odometry_neighbour_sees_the_same() -> None:
    scene, rng = box(np.random.default_rng(1), 200), np.random.default_rng(2)
    neighbour, query, match = (encode_features(seen_from(scene, T, rng), {}) for T in (NEIGHBOUR, QUERY, MATCH))
    odometry = OdometryPair(neighbour, between(NEIGHBOUR, QUERY), "n-q")
    sceptical = Acceptance(Needed(1000, 20, 0.05), Needed(1000, 20, 0.05), 10.0)

    result, evidence = registrar(sceptical).examined(query, match, odometry)

    assert isinstance(result, Registration)
    assert (result.judged_ratio or 0.0) >= 1.0
    assert evidence is not None
    assert evidence.neighbour is OdometryNeighbour.AGREES
    alone = registrar(sceptical).register(query, match, None)
    assert isinstance(alone, RegistrationFailed)
    assert alone.failure is RegistrationFailure.UNCONVINCING
    assert "1000" in alone.detail


def test_odometry_that_says_otherwise_leaves_a_pair_in_doubt_refused() -> None:
    scene, rng = box(np.random.default_rng(1), 200), np.random.default_rng(2)
    neighbour, query, match = (encode_features(seen_from(scene, T, rng), {}) for T in (NEIGHBOUR, QUERY, MATCH))
    turned = between(NEIGHBOUR, QUERY) @ camera_at((0, 0, 0), (0.0, 0.3, 0.0))
    sceptical = Acceptance(Needed(1000, 20, 0.05), Needed(1000, 20, 0.05), 10.0)

    result, evidence = registrar(sceptical).examined(query, match, OdometryPair(neighbour, turned, "n-q"))

    assert isinstance(result, RegistrationFailed)
    assert evidence is not None
    assert evidence.neighbour is OdometryNeighbour.CONTRADICTS
