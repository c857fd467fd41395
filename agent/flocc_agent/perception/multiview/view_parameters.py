"""Constants of the two- and three-view geometry, and the local features that it works on."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.intp]
Matched = tuple[Indices, Indices]
"""Indices (K,) into the features of the first and of the second image, ascending in the first."""


class LocalFeatures(Protocol):
    """Local features as the geometry sees them."""

    @property
    def points(self) -> NDArray[np.float32]:
        """(N, 2) float32, x/z and y/z in the camera frame, free of distortion."""
        ...

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels of the picture that the features were found in; turns rays into pixels."""
        ...

    @property
    def up(self) -> NDArray[np.float64] | None:
        """(3,) direction against gravity in the camera frame, of length one, where odometry knew it."""
        ...


@dataclass(frozen=True, slots=True)
class Geometry:
    """What decides whether matches are a relative pose.

    Attributes:
        inlier_threshold_px: A correspondence this close to its place is verified, in pixels of the features' picture.
        sigma_px: Noise of a correspondence; weights the covariance.
        correspondences_min: Fewer verified correspondences are no registration: eight fix an essential matrix, twice
            as many a wrong one hardly ever has.
        iterations_max: Hypotheses of the robust estimator; 2000 find the pose among 60 % wrong matches.
        common_points_min: Points seen in the neighbour, the query and the match that fix the closure's scale; with
            fewer it has none.
        scale_sigma_ratio_max: A scale more uncertain than this is not given.
        direction_sigma_max_rad: A closure without scale whose direction is more uncertain than this is degenerate.
        odometry_rotation_sigma_rad: How far odometry's rotation between neighbours may be from the images',
            calibration error included.
        odometry_direction_sigma_rad: How far odometry's direction of motion may be from the images'.
        tilt_sigma_rad: How far off two cameras' directions against gravity may be from each other; infinite: they are
            not looked at.
        sure_without_gravity: From so many verified correspondences on gravity is not asked for another estimate.
    """

    inlier_threshold_px: float = 2.0
    sigma_px: float = 0.7
    correspondences_min: int = 15
    iterations_max: int = 2000
    common_points_min: int = 10
    scale_sigma_ratio_max: float = 0.3
    direction_sigma_max_rad: float = 0.35
    odometry_rotation_sigma_rad: float = 0.03
    odometry_direction_sigma_rad: float = 0.2
    tilt_sigma_rad: float = 0.02
    sure_without_gravity: int = 60
