"""Registration of two classical latents, with the scale from the query's odometry pair.

The network unit is the length of the odometry pair's translation, so the pair has a translation of length one and
Eq. (6) makes a closure metric. The closure is in the same unit where enough points are seen in all three images:
neighbour, query and match. Elsewhere it has length one and no scale.
"""

import threading
from collections import OrderedDict

import cv2
import numpy as np
from numpy.typing import NDArray

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
    View,
    covariance_of_view,
    refine,
)
from flocc_agent.perception.classical.encoder import decode_features
from flocc_agent.perception.classical.features import Features
from flocc_agent.perception.classical.two_view import TwoView, two_view
from flocc_agent.perception.latent import BadLatent

Float = NDArray[np.float64]

BASELINE_MIN_M = 1e-3
"""An odometry pair that moved less gives no scale."""


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
            query_features, match_features = decode_features(query), decode_features(match)
            odometry_pair = self._odometry_pair(query_features, odometry)
        except BadLatent as error:
            return RegistrationFailed(RegistrationFailure.BAD_LATENT, str(error))
        odometry_count = count(odometry_pair)
        loop_pair = two_view(query_features, match_features, self._config)
        if isinstance(loop_pair, int):
            detail = f"{loop_pair} verified correspondences, {self._config.correspondences_min} needed"
            return RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, detail, loop_pair, odometry_count)
        if odometry is not None and isinstance(odometry_pair, TwoView):
            scaled = self._with_scale(query_features, loop_pair, odometry_pair)
            if scaled is not None:
                length_m = odometry.T_neighbour_query[:3, 3]
                scale = odometry_scale(length_m, odometry_pair.view.T_view_query[:3, 3])
                return self._result(loop_pair, scaled, 1, odometry_count, scale)
        if self._direction_sigma_rad(loop_pair) > self._config.direction_sigma_max_rad:
            detail = "the images fix no direction of translation, and no scale from odometry"
            return RegistrationFailed(RegistrationFailure.DEGENERATE, detail, loop_pair.correspondences, odometry_count)
        return self._result(loop_pair, loop_pair.refined, 0, odometry_count, None)

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
            prior = DirectionPrior(
                T, self._config.odometry_rotation_sigma_rad, self._config.odometry_direction_sigma_rad
            )
        pair = two_view(query, decode_features(odometry.latent), self._config, prior)
        with self._lock:
            self._odometry_pairs[odometry.key] = pair
            while len(self._odometry_pairs) > self._config.odometry_pairs_max:
                self._odometry_pairs.popitem(last=False)
        return pair

    def _with_scale(self, query: Features, loop_pair: TwoView, odometry_pair: TwoView) -> Refined | None:
        """Refine neighbour, query and match together; None where they do not fix the closure's length."""
        if odometry_pair.view.prior is None:
            return None
        indices = np.union1d(loop_pair.query_indices, odometry_pair.query_indices)
        neighbour = _view_of(odometry_pair, indices)
        match = _view_of(loop_pair, indices)
        common = neighbour.seen & match.seen
        if int(common.sum()) < self._config.common_points_min:
            return None
        depths = np.zeros(len(indices))
        depths[match.seen] = loop_pair.refined.inverse_depths
        depths[neighbour.seen] = odometry_pair.refined.inverse_depths
        loop_depths = np.zeros(len(indices))
        loop_depths[match.seen] = loop_pair.refined.inverse_depths
        usable = common & (depths > 1e-3) & (loop_depths > 1e-3)
        ratio = float(np.median(loop_depths[usable] / depths[usable])) if usable.any() else 1.0
        T = match.T_view_query.copy()
        T[:3, 3] *= ratio
        only_loop = match.seen & ~neighbour.seen
        depths[only_loop] = loop_depths[only_loop] / ratio
        match = View(T, match.observed, match.seen, match.focal_px, unit_translation=False)
        points = query.points[indices].astype(np.float64)
        refined = refine(points, depths, (neighbour, match), self._config.sigma_px)
        covariance = covariance_of_view(refined, 1, np.zeros(6))
        t = inverse(refined.views[1].T_view_query)[:3, 3]
        length = float(np.linalg.norm(t))
        sigma = float(np.sqrt(max(t @ covariance[3:, 3:] @ t, 0.0))) / max(length, 1e-9) / max(length, 1.0)
        return refined if sigma < self._config.scale_sigma_ratio_max else None

    def _direction_sigma_rad(self, pair: TwoView) -> float:
        """How uncertain the direction of translation is."""
        covariance = covariance_of_view(pair.refined, 0, np.zeros(6))
        return float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0)))

    def _result(
        self, loop_pair: TwoView, refined: Refined, k: int, odometry_count: int, scale: float | None
    ) -> Registration:
        """Put the refined match view into a registration."""
        T_query_match = inverse(refined.views[k].T_view_query)
        length = float(np.linalg.norm(T_query_match[:3, 3]))
        floor = np.array([0.005] * 3 + [0.01 * max(length, 0.1)] * 3)
        covariance = covariance_of_view(refined, k, floor)
        if scale is None:
            t = refined.views[k].T_view_query[:3, 3]
            covariance[3:, 3:] += np.outer(t, t)
        return Registration(T_query_match, loop_pair.correspondences, odometry_count, scale, covariance)


def count(pair: TwoView | int) -> int:
    """Verified correspondences of a pair, whether or not it gave a pose."""
    return pair if isinstance(pair, int) else pair.correspondences


def _view_of(pair: TwoView, indices: NDArray[np.intp]) -> View:
    """Spread a pair's view over a larger, sorted set of query features."""
    places = np.searchsorted(indices, pair.query_indices)
    observed = np.zeros((len(indices), 2))
    observed[places] = pair.view.observed
    seen = np.zeros(len(indices), np.bool_)
    seen[places] = True
    return View(pair.view.T_view_query, observed, seen, pair.view.focal_px, pair.view.unit_translation, pair.view.prior)
