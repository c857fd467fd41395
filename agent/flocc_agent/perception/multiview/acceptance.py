"""When a registered pair is a loop closure: by what its front end's wrong pairs never have.

A good match ratio, Eq. (1), suffices, but where keyframes are dense or views differ right pairs have a poor one, too. A
count alone is no evidence: repeated facades give wrong pairs with many correspondences. What separates those is how
certain the rotation is, and whether a third image agrees: the neighbour in the three-view refinement that gives the
scale, or, where the count is in doubt, the neighbour registered with the match by itself. The numbers are fitted on all
scenes together (docs/learned.md).
"""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure, match_ratio
from flocc_agent.geometry import angle_rad, inverse
from flocc_agent.perception.multiview.bundle import TiltPrior
from flocc_agent.perception.multiview.two_view import TwoView

Float = NDArray[np.float64]

RATIO_CORRESPONDENCES_MIN = 20
"""A ratio of fewer is chance, as in the core (`LoopClosingParameters.correspondences_min`)."""
ROTATION_AGREES_RAD = float(np.radians(5.0))
"""Both pairs' rotations are right within 1 to 3 degrees where they are right at all."""
DIRECTION_AGREES_RAD = float(np.radians(15.0))
TILT_AGREES_RAD = float(np.radians(3.0))
"""Two visual-inertial odometries know roll and pitch to a degree each, and wrong poses are tilted any way."""
NEVER = 100_000
"""More correspondences than any picture has features."""


class OdometryNeighbour(Enum):
    """What the query's neighbour says of the pair."""

    NOT_ASKED = "not asked"
    SEES_NOTHING = "sees nothing"
    AGREES = "agrees"
    CONTRADICTS = "contradicts"


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a verdict rests on.

    Attributes:
        correspondences: Verified ones of the loop pair.
        match_ratio: Eq. (1).
        has_scale: Whether three views agree on the length.
        rotation_sigma_rad: How uncertain the rotation is about its worst axis; what few, badly spread points leave.
        neighbour: What the neighbour says.
        neighbour_correspondences: Verified ones of the neighbour with the match.
        tilt_rad: By how much the pose turns one camera's up away from the other's; None where not both know it.
    """

    correspondences: int
    match_ratio: float
    has_scale: bool
    rotation_sigma_rad: float
    neighbour: OdometryNeighbour = OdometryNeighbour.NOT_ASKED
    neighbour_correspondences: int = 0
    tilt_rad: float | None = None


@dataclass(frozen=True, slots=True)
class Needed:
    """What pairs of one kind need.

    Attributes:
        alone: Correspondences that suffice.
        agreeing: Correspondences that suffice where the neighbour agrees.
        rotation_sigma_max_rad: A less certain rotation is none.
    """

    alone: int
    agreeing: int
    rotation_sigma_max_rad: float


@dataclass(frozen=True, slots=True)
class Acceptance:
    """A front end's rule.

    Attributes:
        with_scale: What a pair needs whose length three views agree on.
        without_scale: What another one needs.
        match_ratio_min: Eq. (1) that suffices for either, from `RATIO_CORRESPONDENCES_MIN` correspondences on.
        upright: What suffices beside that where gravity, which both robots know, and the neighbour agree.
    """

    with_scale: Needed
    without_scale: Needed
    match_ratio_min: float
    upright: Needed | None = None

    def has_ratio(self, evidence: Evidence) -> bool:
        """Whether the paper's rule accepts the pair."""
        enough = evidence.correspondences >= RATIO_CORRESPONDENCES_MIN
        return enough and evidence.match_ratio >= self.match_ratio_min

    def needed(self, evidence: Evidence) -> Needed:
        """What a pair of this kind needs."""
        return self.with_scale if evidence.has_scale else self.without_scale

    def needs_neighbour(self, evidence: Evidence) -> bool:
        """Whether the neighbour's word decides."""
        agreed = replace(evidence, neighbour=OdometryNeighbour.AGREES)
        return self.ratio(replace(evidence, neighbour=OdometryNeighbour.NOT_ASKED)) < 1.0 <= self.ratio(agreed)

    def accepts(self, evidence: Evidence) -> bool:
        """Whether the evidence suffices."""
        return self.ratio(evidence) >= 1.0

    def ratio(self, evidence: Evidence) -> float:
        """Evidence over what suffices: Eq. (1) over its threshold, or correspondences over those needed."""
        needed = self.needed(evidence)
        enough = needed.agreeing if evidence.neighbour is OdometryNeighbour.AGREES else needed.alone
        is_certain = evidence.rotation_sigma_rad <= needed.rotation_sigma_max_rad
        by_count = evidence.correspondences / enough if is_certain else 0.0
        by_ratio = evidence.match_ratio / self.match_ratio_min if self.has_ratio(evidence) else 0.0
        return max(by_count, by_ratio, self._by_gravity(evidence))

    def _by_gravity(self, evidence: Evidence) -> float:
        """Correspondences over those needed where gravity has its say; 0 elsewhere."""
        if self.upright is None or evidence.tilt_rad is None or evidence.tilt_rad > TILT_AGREES_RAD:
            return 0.0
        if evidence.rotation_sigma_rad > self.upright.rotation_sigma_max_rad:
            return 0.0
        agrees = evidence.neighbour is OdometryNeighbour.AGREES
        return evidence.correspondences / (self.upright.agreeing if agrees else self.upright.alone)

    def judged(self, result: Registration, evidence: Evidence) -> Registration | RegistrationFailed:
        """The registration with its ratio, or why it is not trusted."""
        if self.accepts(evidence):
            return replace(result, judged_ratio=self.ratio(evidence))
        needed = self.needed(evidence)
        kind = "with" if evidence.has_scale else "without"
        found_deg, most_deg = np.degrees([evidence.rotation_sigma_rad, needed.rotation_sigma_max_rad])
        detail = (
            f"{evidence.correspondences} correspondences {kind} scale, rotation known to {found_deg:.1f} degrees; "
            f"{needed.alone} and {most_deg:.1f} needed; neighbour {evidence.neighbour.value}"
        )
        counts = result.correspondences, result.odometry_correspondences
        return RegistrationFailed(RegistrationFailure.UNCONVINCING, detail, *counts)


def evidence_of(result: Registration, tilt: TiltPrior | None = None) -> Evidence:
    """What a registration says for itself, and gravity, where it is known, of its rotation."""
    assert result.covariance is not None
    variance = float(np.linalg.eigvalsh(result.covariance[:3, :3])[-1])
    ratio = match_ratio(result.correspondences, result.odometry_correspondences)
    has_scale, sigma_rad = result.scale_initial is not None, float(np.sqrt(max(variance, 0.0)))
    tilt_rad = None if tilt is None else tilt.error_rad(result.T_query_match_unscaled[:3, :3].T)
    return Evidence(result.correspondences, ratio, has_scale, sigma_rad, tilt_rad=tilt_rad)


def evidence_of_neighbour(
    evidence: Evidence, neighbour_pair: TwoView | int, result: Registration, T_neighbour_query: Float
) -> Evidence:
    """The evidence with what the neighbour, registered with the match by itself, says.

    Args:
        evidence: Without the neighbour.
        neighbour_pair: The match as a view of the neighbour, or the count where there is no pose.
        result: The loop pair's pose.
        T_neighbour_query: (4, 4) from odometry, metres.
    """
    if isinstance(neighbour_pair, int):
        return replace(evidence, neighbour=OdometryNeighbour.SEES_NOTHING, neighbour_correspondences=neighbour_pair)
    agrees = agree(inverse(neighbour_pair.view.T_view_query), result, T_neighbour_query)
    word = OdometryNeighbour.AGREES if agrees else OdometryNeighbour.CONTRADICTS
    return replace(evidence, neighbour=word, neighbour_correspondences=neighbour_pair.correspondences)


def agree(T_neighbour_match_unscaled: Float, result: Registration, T_neighbour_query: Float) -> bool:
    """Whether two registrations of one match, of neighbours joined by odometry, can both be right."""
    T = result.T_query_match_unscaled
    R = T_neighbour_query[:3, :3]
    if angle_rad((R @ T[:3, :3]).T @ T_neighbour_match_unscaled[:3, :3]) > ROTATION_AGREES_RAD:
        return False
    along = R @ T[:3, 3]
    if result.scale_initial is not None:
        return _angle(T_neighbour_query[:3, 3] + result.scale_initial * along, T_neighbour_match_unscaled[:3, 3])
    return _is_between(T_neighbour_match_unscaled[:3, 3], T_neighbour_query[:3, 3], along)


def _angle(expected: Float, found: Float) -> bool:
    """Whether two directions agree."""
    lengths = float(np.linalg.norm(expected) * np.linalg.norm(found))
    return float(expected @ found) >= float(np.cos(DIRECTION_AGREES_RAD)) * lengths


def _is_between(found: Float, first: Float, second: Float) -> bool:
    """Whether a direction is one of `first + k second`, k >= 0: the fan that an unknown length leaves."""
    shares = np.linspace(0.0, 1.0, 50)[:, None]
    unit_first, unit_second = (v / max(float(np.linalg.norm(v)), 1e-9) for v in (first, second))
    fan = (1.0 - shares) * unit_first + shares * unit_second
    return any(_angle(direction, found) for direction in fan)
