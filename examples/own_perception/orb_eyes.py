"""A front end of your own in one file: ORB features, metric by the odometry pair.

flocc needs three things of a front end, and this file has one class for each: a describer (which images show one
place), an encoder (what of an image travels to another robot) and a registrar (where two images were taken). `build`
makes them; the entry point in pyproject.toml gives it a name.
"""

import cv2
import numpy as np

from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import Image, OdometryPair, Perception
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.geometry import inverse, pose
from flocc_agent.perception.latent import BadLatent, pack, unpack

MODEL = "orb-1"  # another number when latents change: robots register latents of one model only
FEATURES = 1500
INLIERS_MIN = 20
THRESHOLD_RATIO = 0.003  # 2 pixels at a focal length of 640


def build(config: PerceptionConfig, seed: int) -> Perception:  # noqa: ARG001
    """Make the front end; `[perception.options]` of the configuration is yours."""
    features = int(config.options.get("features", FEATURES))
    return Perception(ThumbnailDescriber(), OrbEncoder(features), OrbRegistrar())


class ThumbnailDescriber:
    """A place is what its image looks like from afar: grey, tiny, without its mean."""

    dimension = 32 * 24

    def describe(self, image):
        """(768,) float32 of unit length."""
        grey = cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY)
        tiny = cv2.resize(grey, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
        tiny -= tiny.mean()
        return tiny / max(float(np.linalg.norm(tiny)), 1e-6)


class OrbEncoder:
    """Image to ORB descriptors and the rays on which they were seen."""

    model = MODEL

    def __init__(self, features: int) -> None:
        self._orb = cv2.ORB_create(features)

    def encode(self, image: Image) -> bytes:
        """Undistorted normalised points (N, 2) and descriptors (N, 32), packed with their shapes."""
        keypoints, descriptors = self._orb.detectAndCompute(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), None)
        if not keypoints:
            return pack(MODEL, {}, {"rays": np.zeros((0, 2), np.float32), "orb": np.zeros((0, 32), np.uint8)})
        pixels = np.array([keypoint.pt for keypoint in keypoints])[:, None]
        rays = cv2.undistortPoints(pixels, image.camera.K(), np.array(image.camera.distortion))[:, 0]
        return pack(MODEL, {}, {"rays": rays.astype(np.float32), "orb": descriptors})


class OrbRegistrar:
    """Two latents to the relative pose of their cameras, in metres."""

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Triangulate the query with its neighbour, metric by odometry; then find the match among the points."""
        try:
            seen, other = features_of(query), features_of(match)
            before = features_of(odometry.latent) if odometry is not None else None
        except BadLatent as error:  # a peer sent it: never an exception
            return RegistrationFailed(RegistrationFailure.BAD_LATENT, str(error))
        loop = verified(seen, other)
        if before is None:
            return RegistrationFailed(RegistrationFailure.DEGENERATE, "no odometry pair", len(loop))
        pair = verified(seen, before)
        counts = len(loop), len(pair)  # Eq. (1) compares them, so both are counted alike
        points_m = triangulated(seen[0], before[0], pair, inverse(odometry.T_neighbour_query))
        common = [(points_m[i], other[0][j]) for i, j in loop if i in points_m]
        if len(common) < INLIERS_MIN:
            return RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, f"{len(common)} in all three", *counts)
        points, rays = (np.array(column, np.float64) for column in zip(*common, strict=True))
        found, rotation, t, inliers = cv2.solvePnPRansac(
            points, rays, np.eye(3), None, reprojectionError=THRESHOLD_RATIO, iterationsCount=1000, confidence=0.999
        )
        if not found or inliers is None or len(inliers) < INLIERS_MIN:
            return RegistrationFailed(RegistrationFailure.NO_MODEL, "no pose fits the points", *counts)
        T_match_query = pose(cv2.Rodrigues(rotation)[0], t.ravel())
        return Registration(inverse(T_match_query), *counts, scale_initial=1.0)  # the unit is a metre already


def features_of(latent: bytes):
    """Rays (N, 2) and descriptors (N, 32); refuses what is damaged or another model's."""
    arrays = unpack(latent, MODEL).arrays
    rays, orb = arrays.get("rays"), arrays.get("orb")
    if rays is None or orb is None or rays.shape != (len(orb), 2) or orb.shape[1:] != (32,) or orb.dtype != np.uint8:
        raise BadLatent("the latent lacks rays (N, 2) or descriptors (N, 32)")
    return rays.astype(np.float64), orb


def verified(first, second) -> list[tuple[int, int]]:
    """Pairs of features that match both ways and agree on one essential matrix."""
    if min(len(first[1]), len(second[1])) < 8:
        return []
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first[1], second[1])
    pairs = [(m.queryIdx, m.trainIdx) for m in matches if m.distance < 64]
    if len(pairs) < 8:
        return []
    rays = [np.array([features[0][pair[k]] for pair in pairs]) for k, features in enumerate((first, second))]
    cv2.setRNGSeed(1)
    _, agree = cv2.findEssentialMat(*rays, np.eye(3), cv2.RANSAC, 0.999, THRESHOLD_RATIO)
    return [] if agree is None else [pair for pair, good in zip(pairs, agree.ravel(), strict=True) if good]


def triangulated(rays, rays_before, pairs, T_query_before) -> dict[int, np.ndarray]:
    """Feature of the query -> its point (3,) in the query camera, metres, in front of it and not too far."""
    if not pairs:
        return {}
    T_before_query = inverse(T_query_before)
    i, j = np.array(pairs).T
    homogeneous = cv2.triangulatePoints(np.eye(3, 4), T_before_query[:3], rays[i].T, rays_before[j].T)
    points = (homogeneous[:3] / homogeneous[3]).T
    baseline_m = float(np.linalg.norm(T_query_before[:3, 3]))
    good = np.isfinite(points).all(axis=1) & (points[:, 2] > 0) & (points[:, 2] < 60 * baseline_m)
    return {int(k): point for k, point, keep in zip(i, points, good, strict=True) if keep}
