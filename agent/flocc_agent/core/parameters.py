"""The core's parameters: unit in the name, default, and what turning it does.

They are plain dataclasses so that the core stays free of frameworks; `flocc_agent.config` checks them with pydantic.
What is `_inner` a program may give, a test above all, but no file: it is no key (`flocc_agent/config/removed.py`).
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

_CHECKED: dict[str, Any] = {"extra": "forbid", "use_attribute_docstrings": True, "allow_inf_nan": False}

KEYFRAMES_HELD = 20_000
CROWD = 32
"""Robots in range up to which the heartbeat's period is the shortest."""
INNER = "inner"


def _inner(default: Any) -> Any:
    return field(default=default, metadata={INNER: True})


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise ValueError(sentence)


@dataclass(frozen=True, slots=True)
class NeighbourParameters:
    """Who is in range, by heartbeat."""

    __pydantic_config__ = _CHECKED

    heartbeat_period_s: float = _inner(0.5)
    """Time between heartbeats with few robots in range; shorter notices a lost robot sooner and costs more bytes."""
    timeout_s: float = 3.0
    """A robot that was silent for this long is out of range; six periods ride through 30 % loss."""
    neighbours_max: int = _inner(512)
    """Robots heard at once; further ones are refused and counted."""

    def __post_init__(self) -> None:
        _require(self.heartbeat_period_s > 0, "heartbeat_period_s must be positive")
        _require(self.timeout_s > self.heartbeat_period_s, "timeout_s must exceed heartbeat_period_s")
        _require(self.neighbours_max >= 1, "neighbours_max must be at least 1")

    def period_s(self, neighbours: int) -> float:
        """Time between heartbeats with so many robots in range, at most a third of the timeout.

        Until there, what a robot hears per second grows no further than with `CROWD` of them.
        """
        longest_s = max(self.heartbeat_period_s, self.timeout_s / 3.0)
        return min(self.heartbeat_period_s * max(1.0, neighbours / CROWD), longest_s)


@dataclass(frozen=True, slots=True)
class ElectionParameters:
    """The bully election."""

    __pydantic_config__ = _CHECKED

    startup_s: float = _inner(1.5)
    """A robot listens this long after its start before it asks for an election."""
    leader_timeout_s: float = 3.0
    """A leader whose own counter stood still for this long is lost."""
    hops_max: int = _inner(8)
    """A leader is followed over at most this many robots; those further off follow nobody, yet get its corrections."""

    def __post_init__(self) -> None:
        _require(min(self.startup_s, self.leader_timeout_s) > 0, "election times must be positive")
        _require(1 <= self.hops_max <= 64, "hops_max must be in [1, 64]")


@dataclass(frozen=True, slots=True)
class GossipParameters:
    """Replication of logs."""

    __pydantic_config__ = _CHECKED

    logs_max: int = _inner(512)
    """Logs that are kept; further ones are refused and counted."""

    def __post_init__(self) -> None:
        _require(1 <= self.logs_max <= 1024, "logs_max must be in [1, 1024]")


@dataclass(frozen=True, slots=True)
class PlaceRecognitionParameters:
    """Candidates from descriptors (Sec. III-A)."""

    __pydantic_config__ = _CHECKED

    similarity_threshold: float = 0.1
    """A best match of lower cosine similarity is no candidate; the paper's 0.1 is permissive."""
    best_matches: int = 1
    """Candidates per keyframe and other robot; the paper takes the nearest neighbour only."""
    own_gap_keyframes: int = 0
    """A robot also looks for its own keyframes that are at least so many apart; 0: only for other robots'."""
    candidate_order: Literal["auto", "similarity", "spectral"] = "auto"
    """Which candidates are registered first: the most similar, or those that strengthen the pose graph most; auto: the
    latter where the robot has a bandwidth budget."""

    def __post_init__(self) -> None:
        _require(-1 <= self.similarity_threshold <= 1, "similarity_threshold must be in [-1, 1]")
        _require(1 <= self.best_matches <= 16, "best_matches must be in [1, 16]")
        _require(self.own_gap_keyframes >= 0, "own_gap_keyframes must not be negative")

    def under(self, bandwidth_bytes_s: float | None) -> "PlaceRecognitionParameters":
        """With the order that a budget, or none, calls for."""
        if self.candidate_order != "auto":
            return self
        return replace(self, candidate_order="similarity" if bandwidth_bytes_s is None else "spectral")


@dataclass(frozen=True, slots=True)
class LoopClosingParameters:
    """Candidates to closures (Sec. III-B)."""

    __pydantic_config__ = _CHECKED

    match_ratio_threshold: float = 0.3
    """R_thr: a registration with a lower match ratio, Eq. (1), is refused; not where perception judges itself."""
    correspondences_min: int = 20
    """A registration with fewer correspondences is refused whatever its ratio; not where perception judges itself."""
    fetches_max: int = _inner(2)
    """Latents fetched at one time."""
    fetch_timeout_s: float = 10.0
    """A fetch that takes longer has failed and is tried again."""
    registrations_max: int = _inner(1)
    """Pairs registered at one time; more than workers only fills their queue."""
    candidates_max: int = _inner(4000)
    """Open candidates; the least similar ones are dropped beyond this."""
    closures_enough: int = _inner(3)
    """Of the same stretches of two ways no more pairs are registered once so many ways agree; 0: all are."""
    sparing_logs_min: int = _inner(32)
    """Of so many logs that closures join: every robot learns every closure, and in a smaller team they cost little."""

    def __post_init__(self) -> None:
        _require(self.match_ratio_threshold >= 0, "match_ratio_threshold must not be negative")
        _require(self.correspondences_min >= 0, "correspondences_min must not be negative")
        _require(self.fetch_timeout_s > 0, "fetch_timeout_s must be positive")
        _require(self.fetches_max >= 1, "fetches_max must be at least 1")
        _require(self.registrations_max >= 1, "registrations_max must be at least 1")
        _require(self.candidates_max >= 1, "candidates_max must be at least 1")
        _require(self.closures_enough >= 0, "closures_enough must not be negative")
        _require(self.sparing_logs_min >= 0, "sparing_logs_min must not be negative")


@dataclass(frozen=True, slots=True)
class MemoryParameters:
    """What a robot holds in memory."""

    __pydantic_config__ = _CHECKED

    keyframes_held: int = KEYFRAMES_HELD
    """Keyframes of all robots held in memory in full; of older ones the records are on disk, and one descriptor stands
    for each place. Less saves memory, about 1 kB each."""

    def __post_init__(self) -> None:
        _require(self.keyframes_held >= 1, "keyframes_held must be at least 1")


@dataclass(frozen=True, slots=True)
class RoundParameters:
    """The leader's optimisation rounds."""

    __pydantic_config__ = _CHECKED

    period_s: float = 2.0
    """Shortest time between two rounds."""

    def __post_init__(self) -> None:
        _require(self.period_s > 0, "period_s must be positive")


@dataclass(frozen=True, slots=True)
class DistributedParameters:
    """Distributed optimisation, where `backend.mode` chooses it: for experiments, no key of a file."""

    __pydantic_config__ = _CHECKED

    period_s: float = _inner(0.2)
    """Shortest time between two steps of a robot; shorter converges sooner and sends more."""
    wait_s: float = _inner(1.0)
    """A robot waits this long for news of a neighbour before it steps on old ones; longer rides out more loss."""
    choose_s: float = _inner(5.0)
    """Shortest time between two choices of the closures of one pair of robots."""
    repeat_s: float = _inner(0.5)
    """First pause after which a robot at rest tells its shared poses again; doubles up to `repeat_max_s`."""
    repeat_max_s: float = _inner(16.0)
    """Longest pause between repetitions, for robots that come into range later."""
    timeout_s: float = _inner(60.0)
    """A step or a choice without a result by then is given up."""
    tolerance: float = _inner(1e-3)
    """A part whose poses moved less (metres, or entries of a rotation) rests until it hears something new."""

    def __post_init__(self) -> None:
        _require(0 < self.period_s <= self.wait_s, "period_s must be in (0, wait_s]")
        _require(0 < self.repeat_s <= self.repeat_max_s, "repeat_s must be in (0, repeat_max_s]")
        _require(self.timeout_s > 0 and self.choose_s > 0, "timeout_s and choose_s must be positive")
        _require(self.tolerance > 0, "tolerance must be positive")


@dataclass(frozen=True, slots=True)
class CoreParameters:
    """All parameters of the core."""

    __pydantic_config__ = _CHECKED

    neighbours: NeighbourParameters = field(default_factory=NeighbourParameters)
    election: ElectionParameters = field(default_factory=ElectionParameters)
    gossip: GossipParameters = field(default_factory=GossipParameters, metadata={INNER: True})
    place_recognition: PlaceRecognitionParameters = field(default_factory=PlaceRecognitionParameters)
    loop_closing: LoopClosingParameters = field(default_factory=LoopClosingParameters)
    rounds: RoundParameters = field(default_factory=RoundParameters)
    memory: MemoryParameters = field(default_factory=MemoryParameters)
    distributed: DistributedParameters = field(default_factory=DistributedParameters, metadata={INNER: True})

    def under(self, bandwidth_bytes_s: float | None) -> "CoreParameters":
        """With the order of candidates that a budget, or none, calls for."""
        return replace(self, place_recognition=self.place_recognition.under(bandwidth_bytes_s))
