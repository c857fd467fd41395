"""One type for every camera model that flocc reads, and where a model images a ray.

| kind | shape | distortion |
| --- | --- | --- |
| pinhole | none | OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]: none, 4, 5, 8, 12 or 14 |
| equidistant (Kannala-Brandt) | none | k1 k2 k3 k4 of theta + k1 theta^3 + k2 theta^5 ... |
| fov (Devernay, Faugeras 2001) | omega | none |
| omnidirectional (Mei, Rives 2007) | xi | k1 k2 p1 p2 |
| double sphere (Usenko et al. 2018) | xi, alpha | none |
| eucm (Khomutenko et al. 2016) | alpha, beta | none |
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Camera

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


class LensKind(StrEnum):
    """The family of a camera model."""

    PINHOLE = "pinhole"
    EQUIDISTANT = "equidistant"
    FOV = "fov"
    OMNIDIRECTIONAL = "omnidirectional"
    DOUBLE_SPHERE = "double-sphere"
    EUCM = "eucm"


SHAPE_COUNT = {
    LensKind.PINHOLE: 0,
    LensKind.EQUIDISTANT: 0,
    LensKind.FOV: 1,
    LensKind.OMNIDIRECTIONAL: 1,
    LensKind.DOUBLE_SPHERE: 2,
    LensKind.EUCM: 2,
}
DISTORTION_COUNTS = {
    LensKind.PINHOLE: (0, 4, 5, 8, 12, 14),
    LensKind.EQUIDISTANT: (4,),
    LensKind.FOV: (0,),
    LensKind.OMNIDIRECTIONAL: (0, 4),
    LensKind.DOUBLE_SPHERE: (0,),
    LensKind.EUCM: (0,),
}


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Intrinsics of a camera as it took its pictures, in pixels.

    Attributes:
        width: Of the pictures.
        height: Of the pictures.
        fx: Focal length along x (gamma1 of Mei's model).
        fy: Focal length along y.
        cx: Principal point.
        cy: Principal point.
        distortion: See the table above; trailing zeros are left out.
        kind: The family.
        shape: See the table above.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    kind: LensKind = LensKind.PINHOLE
    shape: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy)  # checks what every camera has
        if not all(map(np.isfinite, (*self.distortion, *self.shape))):
            raise ValueError("camera intrinsics must be finite")
        if len(self.distortion) not in DISTORTION_COUNTS[self.kind]:
            counts = ", ".join(map(str, DISTORTION_COUNTS[self.kind]))
            raise ValueError(f"the model {self.kind} has {counts} distortion coefficients, not {len(self.distortion)}")
        if len(self.shape) != SHAPE_COUNT[self.kind]:
            raise ValueError(f"the model {self.kind} has {SHAPE_COUNT[self.kind]} shape parameters, not {self.shape}")
        if (fault := _shape_fault(self.kind, self.shape)) is not None:
            raise ValueError(fault)
        object.__setattr__(self, "distortion", _trimmed(self.kind, self.distortion))

    @classmethod
    def of_camera(cls, camera: Camera) -> "CameraModel":
        """The model of an agent's camera."""
        c = camera
        return cls(c.width, c.height, c.fx, c.fy, c.cx, c.cy, tuple(c.distortion))

    def K(self) -> Float:
        """Calibration matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def agent_camera(self) -> Camera | None:
        """The same as an agent's camera (pinhole, k1 k2 p1 p2); None where that cannot say it."""
        if self.kind is not LensKind.PINHOLE or len(self.distortion) > 4:
            return None
        k1, k2, p1, p2 = self.distortion or (0.0, 0.0, 0.0, 0.0)
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy, (k1, k2, p1, p2))

    def project(self, rays: Float) -> tuple[Float, Bool]:
        """Where rays are imaged by a model other than pinhole.

        Args:
            rays: (N, 3) directions in the camera frame, of any length but zero.

        Returns:
            (N, 2) pixels, and (N,) whether the model images the ray at all, inside or outside of the picture.

        Raises:
            ValueError: The model is a pinhole: OpenCV undistorts those.
        """
        if self.kind is LensKind.PINHOLE:
            raise ValueError("pinhole pictures are undistorted by OpenCV")
        plane, valid = _PROJECTIONS[self.kind](self, rays / np.linalg.norm(rays, axis=1, keepdims=True))
        return plane * (self.fx, self.fy) + (self.cx, self.cy), valid


def _shape_fault(kind: LensKind, shape: tuple[float, ...]) -> str | None:
    if kind is LensKind.FOV and not 0 < shape[0] < np.pi:
        return f"the fov model's omega is {shape[0]:g}, which must be between 0 and pi"
    if kind is LensKind.DOUBLE_SPHERE and not (-1 < shape[0] < 4 and 0 <= shape[1] <= 1):
        return f"the double sphere's xi and alpha are {shape[0]:g}, {shape[1]:g}; alpha must be between 0 and 1"
    if kind is LensKind.EUCM and not (0 <= shape[0] <= 1 and shape[1] > 0):
        return f"the eucm model's alpha and beta are {shape[0]:g}, {shape[1]:g}; alpha is in 0 to 1 and beta positive"
    if kind is LensKind.OMNIDIRECTIONAL and shape[0] < 0:
        return f"the omnidirectional model's xi is {shape[0]:g}, which must not be negative"
    return None


def _trimmed(kind: LensKind, distortion: tuple[float, ...]) -> tuple[float, ...]:
    """Without coefficients that are zero and may be left out."""
    counts = sorted(count for count in DISTORTION_COUNTS[kind] if count <= len(distortion))
    return next((distortion[:count] for count in counts if not any(distortion[count:])), distortion)


def _equidistant(model: CameraModel, rays: Float) -> tuple[Float, Bool]:
    radius, theta = _radius(rays), np.arctan2(_radius(rays), rays[:, 2])
    bent = theta * (1.0 + _powers(theta**2, model.distortion))
    return rays[:, :2] * _over(bent, radius)[:, None], theta <= _turning_rad(model.distortion)


def _fov(model: CameraModel, rays: Float) -> tuple[Float, Bool]:
    (omega,), radius = model.shape, _radius(rays)
    bent = np.arctan2(2.0 * np.tan(omega / 2) * radius, rays[:, 2]) / omega
    return rays[:, :2] * _over(bent, radius)[:, None], rays[:, 2] > 0


def _omnidirectional(model: CameraModel, rays: Float) -> tuple[Float, Bool]:
    (xi,) = model.shape
    depth = rays[:, 2] + xi
    valid = (depth > 1e-9) & (rays[:, 2] > (-1.0 / xi if xi > 1.0 else -xi))
    plane = rays[:, :2] / np.where(valid, depth, 1.0)[:, None]
    if not model.distortion:
        return plane, valid
    k1, k2, p1, p2 = model.distortion
    x, y = plane.T
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    bent = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    return np.stack(bent, axis=1), valid & (1.0 + 3 * k1 * r2 + 5 * k2 * r2 * r2 > 0)


def _double_sphere(model: CameraModel, rays: Float) -> tuple[Float, Bool]:
    xi, alpha = model.shape
    z1 = rays[:, 2] + xi
    d2 = np.sqrt(_radius(rays) ** 2 + z1**2)
    depth = alpha * d2 + (1 - alpha) * z1
    w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    w2 = (w1 + xi) / np.sqrt(2 * w1 * xi + xi * xi + 1)
    valid = (rays[:, 2] > -w2) & (depth > 1e-9)
    return rays[:, :2] / np.where(valid, depth, 1.0)[:, None], valid


def _eucm(model: CameraModel, rays: Float) -> tuple[Float, Bool]:
    alpha, beta = model.shape
    d = np.sqrt(beta * _radius(rays) ** 2 + rays[:, 2] ** 2)
    depth = alpha * d + (1 - alpha) * rays[:, 2]
    w = (1 - alpha) / alpha if alpha > 0.5 else alpha / (1 - alpha)
    valid = (rays[:, 2] > -w * d) & (depth > 1e-9)
    return rays[:, :2] / np.where(valid, depth, 1.0)[:, None], valid


_PROJECTIONS = {
    LensKind.EQUIDISTANT: _equidistant,
    LensKind.FOV: _fov,
    LensKind.OMNIDIRECTIONAL: _omnidirectional,
    LensKind.DOUBLE_SPHERE: _double_sphere,
    LensKind.EUCM: _eucm,
}


def _radius(rays: Float) -> Float:
    return np.asarray(np.hypot(rays[:, 0], rays[:, 1]))


def _over(bent: Float, radius: Float) -> Float:
    """`bent / radius`; on the axis, where both are zero, the direction is zero too and any factor does."""
    return bent / np.maximum(radius, 1e-12)


def _powers(square: Float, coefficients: tuple[float, ...]) -> Float:
    """k1 s + k2 s^2 + ... by Horner's rule."""
    total = np.zeros_like(square)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * square
    return total


def _turning_rad(coefficients: tuple[float, ...]) -> float:
    """The angle up to which an equidistant model's radius grows; beyond it, one pixel would show two directions."""
    theta = np.linspace(0.0, np.pi, 1800)
    falls = np.flatnonzero(np.diff(theta * (1.0 + _powers(theta**2, coefficients))) <= 0)
    return float(theta[falls[0]]) if falls.size else np.pi
