"""The link model: what becomes of one message between two robots. Pure: no clock, no I/O, one seeded generator.

`launch` asks it at the receiver, `simulate` in the middle; both get the same answers from the same parameters. A
message passes these gates in order: blackout, partition, range, the link's queue (bandwidth), loss; then it is
delayed, perhaps overtaken, perhaps duplicated. Links are directed and independent of each other.

Bulk (latents) waits for everything else on its link, and nothing waits for bulk: the strict priorities of the real
transport. A message that is on its way when a partition begins still arrives.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Position = Sequence[float] | NDArray[np.float64]

EVERYBODY = "*"
BULK_KINDS = frozenset({"latent"})
DRAWS_AT_ONCE = 4096


@dataclass(frozen=True, slots=True)
class LinkParameters:
    """How good one directed link is. The default is a perfect one.

    Attributes:
        loss_ratio: Probability that a message outside of a burst is lost, independently of the others.
        burst_ratio: Long-run share of messages that fall into bursts, all of which are lost (Gilbert's model). The
            total loss is `burst_ratio + (1 - burst_ratio) * loss_ratio`.
        burst_messages_mean: Mean length of a burst, messages (>= 1); longer bursts are rarer at the same ratio.
        latency_s: Least time from sender to receiver.
        jitter_s: Added to it, uniform between 0 and this.
        duplicate_ratio: Probability that a message arrives twice.
        reorder_ratio: Probability that a message is held back and may be overtaken; all others stay in order.
        reorder_delay_s: How long such a message is held back.
        bandwidth_bytes_s: Capacity; None is unlimited. A message of S bytes occupies the link S / bandwidth seconds.
        queue_bytes_max: What may wait for the link; a message that finds the queue full is lost.
    """

    loss_ratio: float = 0.0
    burst_ratio: float = 0.0
    burst_messages_mean: float = 5.0
    latency_s: float = 0.0
    jitter_s: float = 0.0
    duplicate_ratio: float = 0.0
    reorder_ratio: float = 0.0
    reorder_delay_s: float = 0.2
    bandwidth_bytes_s: float | None = None
    queue_bytes_max: int = 4 * 1024 * 1024

    def __post_init__(self) -> None:
        for name in ("loss_ratio", "burst_ratio", "duplicate_ratio", "reorder_ratio"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}, not between 0 and 1")
        for name in ("latency_s", "jitter_s", "reorder_delay_s", "queue_bytes_max"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, not finite and positive")
        if not self.burst_messages_mean >= 1.0:
            raise ValueError(f"burst_messages_mean is {self.burst_messages_mean}, less than 1")
        if self.bandwidth_bytes_s is not None and not self.bandwidth_bytes_s > 0.0:
            raise ValueError(f"bandwidth_bytes_s is {self.bandwidth_bytes_s}, not positive")


@dataclass(frozen=True, slots=True)
class LinkOverride:
    """Another quality for the links from a sender to a receiver; '*' is any robot. The first match counts."""

    sender: str
    receiver: str
    link: LinkParameters


@dataclass(frozen=True, slots=True)
class Partition:
    """Groups of robots that do not hear each other for a while; robots that no group names are one more group."""

    groups: tuple[tuple[str, ...], ...]
    from_s: float = 0.0
    to_s: float = math.inf

    def separates(self, one: str, other: str, now_s: float) -> bool:
        """Whether the two are in different groups now."""
        return self.from_s <= now_s < self.to_s and self._group(one) != self._group(other)

    def _group(self, robot: str) -> int | None:
        return next((i for i, group in enumerate(self.groups) if robot in group), None)


@dataclass(frozen=True, slots=True)
class Blackout:
    """Robots whose radio is dead for a while: nothing in, nothing out."""

    robots: tuple[str, ...]
    from_s: float = 0.0
    to_s: float = math.inf

    def silences(self, robot: str, now_s: float) -> bool:
        """Whether the robot's radio is dead now."""
        return self.from_s <= now_s < self.to_s and robot in self.robots


@dataclass(frozen=True, slots=True)
class RadioParameters:
    """All links of a swarm, and what happens to them over time.

    Attributes:
        link: Every link that no override names.
        overrides: Other qualities, per direction; the first match counts.
        range_m: Robots further apart than this do not hear each other; None is unlimited. A robot whose position
            nobody knows counts as in range.
        partitions: Scheduled separations into groups.
        blackouts: Scheduled silences of single robots.
    """

    link: LinkParameters = LinkParameters()
    overrides: tuple[LinkOverride, ...] = ()
    range_m: float | None = None
    partitions: tuple[Partition, ...] = ()
    blackouts: tuple[Blackout, ...] = ()

    def __post_init__(self) -> None:
        if self.range_m is not None and not self.range_m > 0.0:
            raise ValueError(f"range_m is {self.range_m}, not positive")

    @property
    def is_perfect(self) -> bool:
        """Whether every message arrives at once, so that nobody has to be asked."""
        return self == PERFECT

    def of(self, sender: str, receiver: str) -> LinkParameters:
        """The quality of the directed link between two robots."""
        for override in self.overrides:
            if override.sender in (EVERYBODY, sender) and override.receiver in (EVERYBODY, receiver):
                return override.link
        return self.link

    def emulated(self) -> str | None:
        """What keeps messages back, in words, whenever it does; None where nothing is emulated."""
        ratio = self.link.burst_ratio + (1.0 - self.link.burst_ratio) * self.link.loss_ratio
        rate = self.link.bandwidth_bytes_s
        said = [
            None if self.range_m in (None, math.inf) else f"a range of {self.range_m:g} m",
            f"{100 * ratio:.0f} % loss" if ratio else None,
            None if rate in (None, math.inf) else f"{rate:g} bytes/s",
            "links of other qualities" if self.overrides else None,
            "partitions" if self.partitions else None,
            "blackouts" if self.blackouts else None,
        ]
        return ", ".join(words for words in said if words is not None) or None

    def partitioned(self, groups: tuple[tuple[str, ...], ...], now_s: float) -> "RadioParameters":
        """The same links, separated into groups from now on."""
        return replace(self, partitions=(*self.partitions, Partition(groups, now_s)))

    def healed(self) -> "RadioParameters":
        """The same links without any partition or blackout, present or to come."""
        return replace(self, partitions=(), blackouts=())


PERFECT = RadioParameters()


@dataclass(slots=True)
class _Lane:
    """One priority on one link: when it is free again, and when its last message arrives."""

    free_at_s: float = -math.inf
    last_arrival_s: float = -math.inf


@dataclass(slots=True)
class _Link:
    """What a directed link remembers."""

    parameters: LinkParameters
    in_burst: bool = False
    control: _Lane = field(default_factory=_Lane)
    bulk: _Lane = field(default_factory=_Lane)

    def departs_at_s(self, bulk: bool, size_bytes: int, now_s: float) -> float | None:
        """When the last byte has left, None when the queue is full; the link is occupied until then."""
        rate = self.parameters.bandwidth_bytes_s
        if rate is None:
            return now_s
        lane = self.bulk if bulk else self.control
        start_s = max(now_s, lane.free_at_s)
        if (start_s - now_s) * rate > self.parameters.queue_bytes_max:
            return None
        duration_s = size_bytes / rate
        lane.free_at_s = start_s + duration_s
        if not bulk:
            self.bulk.free_at_s = max(self.bulk.free_at_s, start_s) + duration_s
        return lane.free_at_s


class Radio:
    """Decides for each message when it arrives, if at all, and how often.

    Attributes:
        dropped: Messages lost so far, by reason: blackout, partition, range, queue, burst, loss.
    """

    def __init__(self, parameters: RadioParameters, rng: np.random.Generator) -> None:
        self.dropped: Counter[str] = Counter()
        self._parameters = parameters
        self._rng = rng
        self._draws: list[float] = []
        self._links: dict[tuple[str, str], _Link] = {}
        self._positions_m: dict[str, tuple[float, ...]] = {}

    @property
    def parameters(self) -> RadioParameters:
        """What holds now; assign other parameters to change every link from the next message on."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: RadioParameters) -> None:
        self._parameters = parameters
        for (sender, receiver), link in self._links.items():
            link.parameters = parameters.of(sender, receiver)

    def update_position(self, robot: str, position_m: Position) -> None:
        """Remember where a robot truly is, (3,) metres in any frame that all robots share."""
        self._positions_m[robot] = tuple(float(value) for value in position_m)

    def position_m(self, robot: str) -> tuple[float, ...] | None:
        """Where a robot was last said to be, None if nobody said."""
        return self._positions_m.get(robot)

    def connects(self, sender: str, receiver: str, now_s: float) -> bool:
        """Whether a message could get through at all now."""
        return self._separation(sender, receiver, now_s, None, None) is None

    def transmit(
        self,
        sender: str,
        receiver: str,
        kind: str,
        size_bytes: int,
        now_s: float,
        sender_position_m: Position | None = None,
        receiver_position_m: Position | None = None,
    ) -> list[float]:
        """Send one message.

        Args:
            sender: Robot that speaks.
            receiver: Robot that may hear.
            kind: Kind of the message; "latent" is bulk.
            size_bytes: Size on the wire.
            now_s: When it is sent; must not decrease on a link.
            sender_position_m: (3,) true position; None takes what `update_position` said.
            receiver_position_m: The same for the receiver.

        Returns:
            Times of arrival, s: empty when lost, two when duplicated.
        """
        reason = self._separation(sender, receiver, now_s, sender_position_m, receiver_position_m)
        if reason is not None:
            return self._drop(reason)
        link = self._links.get((sender, receiver))
        if link is None:
            link = self._links[sender, receiver] = _Link(self._parameters.of(sender, receiver))
        bulk = kind in BULK_KINDS
        departure_s = link.departs_at_s(bulk, size_bytes, now_s)
        if departure_s is None:
            return self._drop("queue")
        reason = self._loss(link)
        if reason is not None:
            return self._drop(reason)
        return self._arrivals(link, link.bulk if bulk else link.control, departure_s)

    def _drop(self, reason: str) -> list[float]:
        self.dropped[reason] += 1
        return []

    def _separation(
        self, sender: str, receiver: str, now_s: float, from_m: Position | None, to_m: Position | None
    ) -> str | None:
        """Why the two cannot hear each other at all, if so."""
        parameters = self._parameters
        for blackout in parameters.blackouts:
            if blackout.silences(sender, now_s) or blackout.silences(receiver, now_s):
                return "blackout"
        for partition in parameters.partitions:
            if partition.separates(sender, receiver, now_s):
                return "partition"
        if parameters.range_m is None:
            return None
        here = self._positions_m.get(sender) if from_m is None else from_m
        there = self._positions_m.get(receiver) if to_m is None else to_m
        if here is None or there is None or math.dist(here, there) <= parameters.range_m:
            return None
        return "range"

    def _loss(self, link: _Link) -> str | None:
        """Draw whether the message is lost, and move the link in or out of a burst before."""
        parameters = link.parameters
        if parameters.burst_ratio > 0.0:
            leave = 1.0 / parameters.burst_messages_mean
            enter = leave * parameters.burst_ratio / max(1.0 - parameters.burst_ratio, 1e-9)
            link.in_burst = self._chance(1.0 - leave if link.in_burst else min(enter, 1.0))
            if link.in_burst:
                return "burst"
        else:
            link.in_burst = False
        return "loss" if self._chance(parameters.loss_ratio) else None

    def _arrivals(self, link: _Link, lane: _Lane, departure_s: float) -> list[float]:
        """Delay a message; keep it in order unless it is drawn to be overtaken; perhaps repeat it."""
        parameters = link.parameters
        arrival_s = departure_s + self._delay_s(parameters)
        if self._chance(parameters.reorder_ratio):
            arrival_s += parameters.reorder_delay_s
        else:
            arrival_s = lane.last_arrival_s = max(arrival_s, lane.last_arrival_s)
        if not self._chance(parameters.duplicate_ratio):
            return [arrival_s]
        return [arrival_s, arrival_s + self._delay_s(parameters)]

    def _delay_s(self, parameters: LinkParameters) -> float:
        if parameters.jitter_s == 0.0:
            return parameters.latency_s
        return parameters.latency_s + parameters.jitter_s * self._draw()

    def _chance(self, probability: float) -> bool:
        return probability > 0.0 and self._draw() < probability

    def _draw(self) -> float:
        """One uniform number in [0, 1); drawn in blocks because single draws cost as much as all the rest."""
        if not self._draws:
            self._draws = self._rng.random(DRAWS_AT_ONCE).tolist()
        return self._draws.pop()
