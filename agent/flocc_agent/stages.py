"""Time by stage: histograms of fixed size, and a stopwatch for the stages inside of one task.

A stage is a part of the work on a keyframe or a pair: describe, encode, fetch, decode, match, pose, register, optimise,
and the waits before them. Whoever does the work marks it with `stage`; whoever runs the task collects with `timed`;
elsewhere the mark costs nothing and tells nobody.
"""

import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import Lock
from typing import Generic, TypeVar

T = TypeVar("T")

BOUNDS_S: tuple[float, ...] = (*(float(f"{digit}e{power}") for power in range(-4, 2) for digit in (1, 2, 5)), 100.0)
"""Upper ends of a histogram's buckets, 0.1 ms to 100 s in steps of 1, 2, 5; one more bucket holds what is longer."""
STAGES_MAX = 32

_laps: ContextVar[dict[str, float] | None] = ContextVar("laps", default=None)


@dataclass(slots=True)
class Histogram:
    """How often something took how long.

    Attributes:
        counts: Per bucket of `BOUNDS_S`, and one more for what is longer.
        total_s: Sum of all times.
        max_s: The longest.
    """

    counts: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS_S) + 1))
    total_s: float = 0.0
    max_s: float = 0.0

    @property
    def count(self) -> int:
        """Number of times."""
        return sum(self.counts)

    def observe(self, lasted_s: float) -> None:
        """Count one more."""
        self.counts[bisect_left(BOUNDS_S, lasted_s)] += 1
        self.total_s += lasted_s
        self.max_s = max(self.max_s, lasted_s)

    def add(self, counts: Sequence[int], total_s: float, max_s: float) -> None:
        """Count all of another histogram's."""
        self.counts = [mine + other for mine, other in zip(self.counts, counts, strict=True)]
        self.total_s += total_s
        self.max_s = max(self.max_s, max_s)

    def quantile_s(self, share: float) -> float:
        """Time that a share of all took at most, within a bucket by straight line; 0 where there is none."""
        wanted, below = share * self.count, 0
        for k, count in enumerate(self.counts):
            if count and below + count >= wanted:
                low = BOUNDS_S[k - 1] if k else 0.0
                high = min(BOUNDS_S[k], self.max_s) if k < len(BOUNDS_S) else self.max_s
                return low + (high - low) * max(wanted - below, 0.0) / count
            below += count
        return self.max_s


@dataclass(frozen=True, slots=True)
class StageCounts:
    """A histogram as it stands in files; its attributes are those of `Histogram`."""

    counts: tuple[int, ...]
    total_s: float
    max_s: float


class StageTimes:
    """One robot's histograms by stage; any thread may count."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._stages: dict[str, Histogram] = {}

    def observe(self, stage: str, lasted_s: float) -> None:
        """Count one time of a stage; of too many stages the last ones are not kept."""
        with self._lock:
            if stage in self._stages or len(self._stages) < STAGES_MAX:
                self._stages.setdefault(stage, Histogram()).observe(lasted_s)

    def snapshot(self) -> dict[str, Histogram]:
        """Copies of all histograms, by name of the stage."""
        with self._lock:
            return {name: Histogram(list(h.counts), h.total_s, h.max_s) for name, h in sorted(self._stages.items())}


def counts_of(stages: Mapping[str, Histogram]) -> dict[str, StageCounts]:
    """Histograms as they stand in files."""
    return {name: StageCounts(tuple(h.counts), round(h.total_s, 6), round(h.max_s, 6)) for name, h in stages.items()}


def brief_of(stages: Mapping[str, Histogram]) -> dict[str, dict[str, float]]:
    """Histograms for a status line: count, median, 90 % and longest."""
    return {
        name: {
            "count": h.count,
            "median_s": round(h.quantile_s(0.5), 6),
            "p90_s": round(h.quantile_s(0.9), 6),
            "max_s": round(h.max_s, 6),
        }
        for name, h in stages.items()
    }


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Mark what runs inside as a stage of the task around it."""
    laps = _laps.get()
    if laps is None:
        yield
        return
    began_s = time.perf_counter()
    try:
        yield
    finally:
        laps[name] = laps.get(name, 0.0) + time.perf_counter() - began_s


@dataclass(frozen=True, slots=True)
class Timed(Generic[T]):
    """What a task gave, and how long it took, as a whole and by marked stage."""

    value: T
    lasted_s: float
    laps_s: dict[str, float]


def timed(function: Callable[..., T], *arguments: object) -> Timed[T]:
    """Run a function and collect its stages."""
    laps_s: dict[str, float] = {}
    token = _laps.set(laps_s)
    began_s = time.perf_counter()
    try:
        return Timed(function(*arguments), time.perf_counter() - began_s, laps_s)
    finally:
        _laps.reset(token)
