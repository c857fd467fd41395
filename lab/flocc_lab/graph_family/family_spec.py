"""What a member of the family is like: sizes, noise, what is wrong with it; drawn from a seed within stated ranges."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

ROBOTS = (2, 12)
KEYFRAMES = (50, 2000)
CLOSURES = (2, 3000)
OUTLIERS_MAX = 0.7
NOISE_FACTOR_MAX = 3.0
SCALE_OFF_MAX = 0.1
WEAK_CLOSURES = 3
GROUP_CLOSURES = 10
GROUPS_MAX = 3


class Lengths(Enum):
    """What is known of the closures' translations."""

    METRIC = "metric"
    GUESSED = "guessed"
    """A direction, and a guess of its length that is off by about 30 % (Eq. (6))."""
    UNIT = "unit"
    """A direction; closures within a robot are metric."""


@dataclass(frozen=True, slots=True)
class Spec:
    """One draw.

    Attributes:
        seed: What everything follows from.
        keyframes: Of each robot.
        planar: Whether robots stay in a plane.
        lengths: What is known of translations.
        closures: Wanted number of right closures.
        odometry: Declared standard deviation of an edge: rotation rad, translation m.
        closure: Declared standard deviation of a closure: rotation rad, translation m.
        odometry_factor: True noise over declared noise.
        closure_factor: The same of closures.
        heavy_tails: Whether one edge in a hundred is off by about 5.5 standard deviations in all directions.
        scale_off: Measured over true length of each robot's odometry.
        outliers: Part of all closures that are wrong on their own.
        groups: Number of groups of ten wrong closures that agree with each other.
        weak: Whether the last robot is held by three right closures only.
        opposite: Whether every second robot drives along the way of the one before it, in the opposite direction.
        scattered: Whether wrong closures come anywhere; else every pair of robots has its part of them.
        parallel: Whether two robots drive along parallel lines, so that all directions between them are parallel.
    """

    seed: int
    keyframes: tuple[int, ...]
    planar: bool
    lengths: Lengths
    closures: int
    odometry: tuple[float, float]
    closure: tuple[float, float]
    odometry_factor: float
    closure_factor: float
    heavy_tails: bool
    scale_off: tuple[float, ...]
    outliers: float
    groups: int
    weak: bool
    opposite: bool
    scattered: bool
    parallel: bool

    @property
    def robots(self) -> int:
        """Number of robots."""
        return len(self.keyframes)


def drawn(seed: int) -> Spec:
    """The member of the family that a seed names. Sizes are log-uniform, skewed to small ones."""
    rng = np.random.default_rng([seed, 14])
    parallel = bool(rng.random() < 0.05)
    robots = 2 if parallel else round(_log_uniform(rng, *ROBOTS, skew=1.5))
    typical = _log_uniform(rng, *KEYFRAMES, skew=2.0)
    keyframes = np.clip(typical * np.exp(rng.normal(0.0, 0.3, robots)), *KEYFRAMES).astype(int)
    most = min(CLOSURES[1], 2 * int(keyframes.sum()))
    return Spec(
        seed=seed,
        keyframes=tuple(keyframes.tolist()),
        planar=bool(rng.random() < 0.5),
        lengths=Lengths.UNIT if parallel else list(Lengths)[int(rng.integers(3))],
        closures=max(round(_log_uniform(rng, *(CLOSURES[0], most))), CLOSURES[0] * (robots - 1)),
        odometry=(_log_uniform(rng, 0.001, 0.01), _log_uniform(rng, 0.005, 0.05)),
        closure=(_log_uniform(rng, 0.005, 0.05), _log_uniform(rng, 0.02, 0.2)),
        odometry_factor=_factor(rng),
        closure_factor=_factor(rng),
        heavy_tails=bool(rng.random() < 0.3),
        scale_off=_scales(rng, robots),
        outliers=float(rng.uniform(0.0, OUTLIERS_MAX)) if rng.random() < 0.7 else 0.0,
        groups=int(rng.integers(1, GROUPS_MAX + 1)) if rng.random() < 0.25 and not parallel else 0,
        weak=bool(robots > 2 and rng.random() < 0.25),
        opposite=bool(rng.random() < 0.25) and not parallel,
        scattered=bool(rng.random() < 0.25),
        parallel=parallel,
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float, skew: float = 1.0) -> float:
    return float(low * (high / low) ** (rng.random() ** skew))


def _factor(rng: np.random.Generator) -> float:
    """True over declared noise: one in every second draw, else between a third and three."""
    return _log_uniform(rng, 1 / NOISE_FACTOR_MAX, NOISE_FACTOR_MAX) if rng.random() < 0.5 else 1.0


def _scales(rng: np.random.Generator, robots: int) -> tuple[float, ...]:
    """True for 80 % of draws; else one robot's, or all robots', odometry is off by up to 10 %."""
    off, kind = rng.uniform(1 - SCALE_OFF_MAX, 1 + SCALE_OFF_MAX, robots), rng.random()
    if kind < 0.8:
        off[:] = 1.0
    elif kind < 0.9:
        off[np.arange(robots) != rng.integers(robots)] = 1.0
    return tuple(off.tolist())
