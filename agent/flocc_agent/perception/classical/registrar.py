"""Registration of two classical latents, with the scale from the query's odometry pair.

The network unit is the length of the odometry pair's translation, so the pair has a translation of length one and
Eq. (6) makes a closure metric. The closure is in the same unit where enough points are seen in all three images:
neighbour, query and match. Elsewhere it has length one and no scale.
"""

import threading
from collections import OrderedDict

import cv2
import numpy as np

from flocc_agent.config import ClassicalConfig
from flocc_agent.core.interfaces import OdometryPair
from flocc_agent.core.registration import (
    Registration,
    RegistrationFailed,
    RegistrationFailure,
    odometry_scale,
)
from flocc_agent.geometry import inverse
from flocc_agent.perception.classical.bundle import (
    DirectionPrior,
    Refined,
    covariance_of_view,
)
from flocc_agent.perception.classical.degeneracy import degeneracy
from flocc_agent.perception.classical.encoder import decode_features
from flocc_agent.perception.classical.features import Features
from flocc_agent.perception.classical.three_view import three_view
from flocc_agent.perception.classical.two_view import TwoView, two_view
from flocc_agent.perception.latent import BadLatent
from flocc_agent.stages import stage

ODOMETRY_ROTATION_SIGMA_RAD = 0.03
"""How far odometry's rotation between neighbours may be from the images', calibration error included."""
ODOMETRY_DIRECTION_SIGMA_RAD = 0.2
"""How far odometry's direction of motion between neighbours may be from the images'."""
BASELINE_MIN_M = 1e-3
"""An odometry pair that moved less gives no scale."""
ROTATION_SIGMA_MIN_RAD = 0.005
"""Calibration is not better than this, whatever the correspondences say."""
TRANSLATION_SIGMA_MIN_RATIO = 0.01
LENGTH_MIN = 0.1
"""Translations below this, in network units, are not more certain for being short."""


class ClassicalRegistrar:
    """Two latents to correspondences and a relative pose up to scale."""

    def __init__(self, config: ClassicalConfig) -> None:
        cv2.setNumThreads(1)
        self._config = config
        self._odometry_pairs: OrderedDict[str, TwoView | int] = OrderedDict()
        self._lock = threading.Lock()

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's; raises nothing for bad latents."""
        try:
            with stage("decode"):
                query_features, match_features = decode_features(query), decode_features(match)
            with stage("match"):
                odometry_pair = self._odometry_pair(query_features, odometry)
        except BadLatent as error:
            return RegistrationFailed(RegistrationFailure.BAD_LATENT, str(error))
        with stage("match"):
            loop_pair = two_view(query_features, match_features, self._config.correspondences_min)
        with stage("pose"):
            return self._judged(query_features, loop_pair, odometry_pair, odometry)

    def _judged(
        self, query: Features, loop_pair: TwoView | int, odometry_pair: TwoView | int, odometry: OdometryPair | None
    ) -> Registration | RegistrationFailed:
        """Turn verified pairs into a result: with scale, without, or why not."""
        counts = count(loop_pair), count(odometry_pair)
        if isinstance(loop_pair, int):
            detail = f"{loop_pair} verified correspondences, {self._config.correspondences_min} needed"
            return RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, detail, *counts)
        if odometry is not None and isinstance(odometry_pair, TwoView) and odometry_pair.view.prior is not None:
            scaled = three_view(query, odometry_pair, loop_pair)
            scale = odometry_scale(odometry.T_neighbour_query[:3, 3], odometry_pair.view.T_view_query[:3, 3])
            if scaled is not None and scale is not None:
                return registration(scaled, 1, counts, scale)
        points = query.points[loop_pair.query_indices].astype(np.float64)
        reason = degeneracy(points, loop_pair)
        if reason is not None:
            return RegistrationFailed(RegistrationFailure.DEGENERATE, reason, *counts)
        return registration(loop_pair.refined, 0, counts, None)

    def _odometry_pair(self, query: Features, odometry: OdometryPair | None) -> TwoView | int:
        """Verify the odometry pair, or look it up."""
        if odometry is None:
            return 0
        with self._lock:
            known = self._odometry_pairs.get(odometry.key)
        if known is not None:
            return known
        T = odometry.T_neighbour_query
        prior = None
        if float(np.linalg.norm(T[:3, 3])) > BASELINE_MIN_M:
            prior = DirectionPrior(T, ODOMETRY_ROTATION_SIGMA_RAD, ODOMETRY_DIRECTION_SIGMA_RAD)
        pair = two_view(query, decode_features(odometry.latent), self._config.correspondences_min, prior)
        with self._lock:
            self._odometry_pairs[odometry.key] = pair
            while len(self._odometry_pairs) > self._config.odometry_pairs_max:
                self._odometry_pairs.popitem(last=False)
        return pair


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
