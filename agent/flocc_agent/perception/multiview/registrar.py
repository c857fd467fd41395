"""Registration of two latents of local features, with the scale from the query's odometry pair.

The network unit is the length of the odometry pair's translation, so the pair has a translation of length one and
Eq. (6) makes a closure metric. The closure is in the same unit where enough points are seen in all three images:
neighbour, query and match. Elsewhere it has length one and no scale.

What finds and matches the features is the front end's: `read` and `match`. So is the rule that accepts a pair: how much
evidence a wrong one never has depends on the features (`acceptance.py`).
"""

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import OdometryPair, SeenMatches
from flocc_agent.core.registration import (
    Registration,
    RegistrationFailed,
    RegistrationFailure,
    odometry_scale,
)
from flocc_agent.geometry import inverse
from flocc_agent.perception.latent import BadLatent, failed_by
from flocc_agent.perception.multiview.acceptance import Acceptance, Evidence, evidence_of, evidence_of_neighbour
from flocc_agent.perception.multiview.bundle import DirectionPrior, Refined, covariance_of_view
from flocc_agent.perception.multiview.degeneracy import degeneracy
from flocc_agent.perception.multiview.three_view import three_view
from flocc_agent.perception.multiview.two_view import TwoView, tilt_of, two_view
from flocc_agent.perception.multiview.view_parameters import Geometry, Indices, LocalFeatures, Matched
from flocc_agent.perception.watch.seen_motion import STAYS_MAX_PX, Flow, flow_of, moves_with_the_scene
from flocc_agent.stages import stage

BASELINE_MIN_M = 1e-3
"""An odometry pair that moved less gives no scale."""
ROTATION_SIGMA_MIN_RAD = 0.005
"""Calibration is not better than this, whatever the correspondences say."""
TRANSLATION_SIGMA_MIN_RATIO = 0.01
LENGTH_MIN = 0.1
"""Translations below this, in network units, are not more certain for being short."""
ODOMETRY_PAIRS_MAX = 256
"""Odometry-pair results kept in memory, some 30 kB each."""

Float = NDArray[np.float64]
F = TypeVar("F", bound=LocalFeatures)
Result = Registration | RegistrationFailed


AMONG_PX = 40.0
AMONG_MIN = 3
"""A feature with so many that move with the camera within that many pixels moves with it, too."""
SHARED_STAY_MIN = 30
"""So many matches that stay at their pixel are one overlay on both cameras; 256 pairs of five places had 10 at most."""
SHARED_AMONG_PX = 60.0
"""What changes on such an overlay is looked for farther around: neither robot's own pictures have shown it yet."""
NOTHING = np.zeros(0, np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class OwnPair:
    """What a query and its odometry neighbour show together.

    Attributes:
        pair: Verified, or how many matches were.
        hidden: Features of query and of neighbour among those that stay at their pixel though the robot moved: they
            are on the lens, or on the robot.
    """

    pair: TwoView | int = 0
    hidden: tuple[Indices, Indices] = (NOTHING, NOTHING)


class PairRegistrar(Generic[F]):
    """Two latents to correspondences and a relative pose up to scale.

    Args:
        read: Features of a latent; raises `BadLatent`.
        match: Which features of two images look alike.
        geometry: Thresholds of the two- and three-view geometry.
        acceptance: What a pair needs to be a closure; None leaves that to Eq. (1) and R_thr, as in the paper.
    """

    def __init__(
        self,
        read: Callable[[bytes], F],
        match: Callable[[F, F], Matched],
        geometry: Geometry,
        acceptance: Acceptance | None = None,
    ) -> None:
        self._read = read
        self._match = match
        self._geometry = geometry
        self._acceptance = acceptance
        self._own_pairs: OrderedDict[tuple[str, int, int], OwnPair] = OrderedDict()
        self._lock = threading.Lock()

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Result:
        """Register the match's latent with the query's; raises nothing for bad latents."""
        try:
            return self.examined(query, match, odometry)[0]
        except BadLatent as error:
            return failed_by(error)

    def examined(
        self, query: bytes, match: bytes, odometry: OdometryPair | None, always: bool = False
    ) -> tuple[Result, Evidence | None]:
        """Register, and give what the verdict rests on; None where there is no pose.

        Args:
            query: Latent of the query.
            match: Latent of the match.
            odometry: The query's odometry pair.
            always: Whether to ask the neighbour in any case, for measurements; else only where it decides.

        Raises:
            BadLatent: A latent is damaged or of another model.
        """
        with stage("decode"):
            query_features, match_features = self._read(query), self._read(match)
        with stage("match"):
            own = self._own_pair(query, query_features, odometry)
            loop_pair = self._loop_pair(query_features, match_features, own.hidden[0])
        with stage("pose"):
            result = self._posed(query_features, loop_pair, own.pair, odometry)
        if isinstance(result, RegistrationFailed):
            return result, None
        evidence = evidence_of(result, tilt_of(query_features, match_features, self._geometry))
        rule = self._acceptance
        if odometry is not None and (always or (rule is not None and rule.needs_neighbour(evidence))):
            with stage("match"):
                neighbour_pair = self._loop_pair(self._read(odometry.latent), match_features, own.hidden[1])
            evidence = evidence_of_neighbour(evidence, neighbour_pair, result, odometry.T_neighbour_query)
        return (result if rule is None else rule.judged(result, evidence)), evidence

    def flow(self, before: bytes, now: bytes, T_odom_before: Float, T_odom_now: Float) -> Flow | None:
        """Verified matches of two of the robot's own latents, or None where they are few.

        Args:
            before: Latent of a keyframe.
            now: Latent of the next one.
            T_odom_before: (4, 4) camera pose by odometry, metres.
            T_odom_now: The same of the next one.
        """
        features_before, features_now = self._read(before), self._read(now)
        matched = self._match(features_now, features_before)
        return flow_of(features_before, features_now, matched, T_odom_before, T_odom_now)

    def matches(self, query: bytes, match: bytes) -> SeenMatches:
        """Tell which points of two images look alike, and which of those agree with one relative pose.

        Raises:
            BadLatent: A latent is damaged or of another model.
        """
        query_features, match_features = self._read(query), self._read(match)
        matched = self._match(query_features, match_features)
        pair = two_view(query_features, match_features, matched, self._geometry)
        agree = (
            np.zeros(len(matched[0]), np.bool_) if isinstance(pair, int) else np.isin(matched[0], pair.query_indices)
        )
        points = query_features.points[matched[0]], match_features.points[matched[1]]
        return SeenMatches(points[0].astype(np.float64), points[1].astype(np.float64), agree)

    def _loop_pair(self, first: F, second: F, hidden: Indices) -> TwoView | int:
        """Verify the matches of two robots' pictures, without the first one's features that move with its camera."""
        matched = without_overlay(first, second, self._match(first, second))
        seen = ~np.isin(matched[0], hidden)
        return two_view(first, second, (matched[0][seen], matched[1][seen]), self._geometry)

    def _posed(
        self, query: F, loop_pair: TwoView | int, odometry_pair: TwoView | int, odometry: OdometryPair | None
    ) -> Result:
        """Turn verified pairs into a result: with scale, without, or why not."""
        counts = count(loop_pair), count(odometry_pair)
        if isinstance(loop_pair, int):
            detail = f"{loop_pair} verified correspondences, {self._geometry.correspondences_min} needed"
            return RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, detail, *counts)
        if odometry is not None and isinstance(odometry_pair, TwoView) and odometry_pair.view.prior is not None:
            scaled = three_view(query, odometry_pair, loop_pair, self._geometry)
            scale = odometry_scale(odometry.T_neighbour_query[:3, 3], odometry_pair.view.T_view_query[:3, 3])
            if scaled is not None and scale is not None:
                return registration(scaled, 1, counts, scale)
        points = query.points[loop_pair.query_indices].astype(np.float64)
        reason = degeneracy(points, loop_pair, self._geometry)
        if reason is not None:
            return RegistrationFailed(RegistrationFailure.DEGENERATE, reason, *counts)
        return registration(loop_pair.refined, 0, counts, None)

    def _own_pair(self, latent: bytes, query: F, odometry: OdometryPair | None) -> OwnPair:
        """Verify the odometry pair, or look it up; a latent may have lost features since."""
        if odometry is None:
            return OwnPair()
        key = odometry.key, hash(latent), hash(odometry.latent)
        with self._lock:
            known = self._own_pairs.get(key)
        if known is not None:
            return known
        own = self._verified(query, self._read(odometry.latent), odometry.T_neighbour_query)
        with self._lock:
            self._own_pairs[key] = own
            while len(self._own_pairs) > ODOMETRY_PAIRS_MAX:
                self._own_pairs.popitem(last=False)
        return own

    def _verified(self, query: F, neighbour: F, T_neighbour_query: Float) -> OwnPair:
        matched = self._match(query, neighbour)
        rays = neighbour.points[matched[1]].astype(np.float64), query.points[matched[0]].astype(np.float64)
        moves = moves_with_the_scene(*rays, query.focal_px, T_neighbour_query)
        hidden = (
            features_among(query, matched[0][~moves]),
            features_among(neighbour, matched[1][~moves]),
        )
        moves &= ~np.isin(matched[0], hidden[0])
        prior = None
        if float(np.linalg.norm(T_neighbour_query[:3, 3])) > BASELINE_MIN_M:
            rotation_rad, direction_rad = (
                self._geometry.odometry_rotation_sigma_rad,
                self._geometry.odometry_direction_sigma_rad,
            )
            prior = DirectionPrior(T_neighbour_query, rotation_rad, direction_rad)
        scene = matched[0][moves], matched[1][moves]
        return OwnPair(two_view(query, neighbour, scene, self._geometry, prior), hidden)


def features_among(features: LocalFeatures, those: Indices, radius_px: float = AMONG_PX) -> Indices:
    """All features that have several of those close by: what changes on an overlay lies among what does not."""
    if len(those) < AMONG_MIN:
        return those
    points = features.points * np.float32(features.focal_px)
    squares = (points**2).sum(axis=1)
    distances = squares[:, None] - 2.0 * points @ points[those].T + squares[those]
    return np.union1d(those, np.flatnonzero((distances < radius_px**2).sum(axis=1) >= AMONG_MIN))


def without_overlay(first: LocalFeatures, second: LocalFeatures, matched: Matched) -> Matched:
    """Matches that do not stay at their pixel: what does, in pictures from two places, is on both cameras' lenses.

    Where many do, both show one thing, such as a burnt-in clock, and what lies among them goes as well.
    """
    moved = first.points[matched[0]] - second.points[matched[1]]
    moves = np.linalg.norm(moved, axis=1) * first.focal_px > STAYS_MAX_PX
    stay = matched[0][~moves], matched[1][~moves]
    if len(stay[0]) >= SHARED_STAY_MIN:
        for features, of_pair, staying in zip((first, second), matched, stay, strict=True):
            moves &= ~np.isin(of_pair, features_among(features, staying, SHARED_AMONG_PX))
    return matched[0][moves], matched[1][moves]


def registration(refined: Refined, k: int, counts: tuple[int, int], scale_initial: float | None) -> Registration:
    """Put view k, the match, into a result; without scale its length is one and as uncertain."""
    view = refined.views[k]
    length = float(np.linalg.norm(view.T_view_query[:3, 3]))
    floor = np.array([ROTATION_SIGMA_MIN_RAD] * 3 + [TRANSLATION_SIGMA_MIN_RATIO * max(length, LENGTH_MIN)] * 3)
    covariance = covariance_of_view(refined, k, floor)
    if scale_initial is None:
        covariance[3:, 3:] += np.outer(view.T_view_query[:3, 3], view.T_view_query[:3, 3])
    return Registration(inverse(view.T_view_query), *counts, scale_initial, covariance)


def count(pair: TwoView | int) -> int:
    """Verified correspondences of a pair, whether or not it gave a pose."""
    return pair if isinstance(pair, int) else pair.correspondences
