"""What the driver asks of a transport: datagrams by robot name, and latents by name, counted.

The contract in one sentence: messages may be lost, late, repeated and out of order, their sender is known from the
key that only the sender may write, nothing here ever blocks the event loop, and every queue is bounded.
Repair of lost messages is the replicated log's business, not the transport's.
"""

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from flocc_protocol.errors import FloccError

Receiver = Callable[[str, str, bytes], None]
"""Takes (sender, kind, payload), on the event loop's thread."""

LatentLookup = Callable[[str, int | None], bytes | None]
"""Gives the latent of a name such as `r1/7`, None when it is not held. Called on a thread of the transport."""


class TransportError(FloccError):
    """The network cannot be used as configured: a port in use, a bad address, an unreadable certificate."""


class FetchProblem(Enum):
    """Why a latent did not come."""

    NO_ANSWER = "no-answer"
    """The holder is out of reach, or every piece was lost; worth another try, which goes on where this one ended."""
    UNKNOWN = "unknown"
    """The holder answered that it does not hold it (any more)."""
    DEADLINE = "deadline"
    """Not complete in time; another try goes on where this one ended."""
    TOO_LARGE = "too-large"
    """The holder offers more bytes than this robot accepts."""
    WRONG_HASH = "wrong-hash"
    """The pieces do not add up to what was promised; they are discarded."""
    CLOSED = "closed"
    """The transport was closed meanwhile."""


@dataclass(frozen=True, slots=True)
class FetchFailed:
    """A latent that did not come, and how much of it is kept for the next try."""

    problem: FetchProblem
    kept_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Fetched:
    """A complete latent whose hash is right."""

    latent: bytes


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages and their payload bytes. A broadcast counts once at the sender and once at each receiver."""

    messages: int = 0
    payload_bytes: int = 0


@dataclass(frozen=True, slots=True)
class TransportCounters:
    """What went through a transport so far.

    Attributes:
        sent: By kind; latents that were served are of kind "latent".
        received: By kind; only what reached the robot.
        sent_to: By receiver, unicasts and latents.
        received_from: By sender.
        dropped: Messages by reason: inbox-full, too-large, rate, malformed-key, too-many-peers, not-sent, closed,
            radio-loss, radio-range and so on, foreign-version, foreign-swarm, name-twice, serve-busy.
    """

    sent: dict[str, Traffic]
    received: dict[str, Traffic]
    sent_to: dict[str, Traffic]
    received_from: dict[str, Traffic]
    dropped: dict[str, int]


class Transport(Protocol):
    """Carries messages between robots in range."""

    async def open(self) -> None:
        """Join the network; robots out of reach are no error.

        Raises:
            TransportError: It cannot be used as configured.
        """
        ...

    async def close(self) -> None:
        """Leave the network; safe to call twice, and after a failed `open`."""
        ...

    def broadcast(self, kind: str, payload: bytes) -> None:
        """Send to every robot in range, or drop; never blocks. Errors of the network are counted, not raised."""
        ...

    def unicast(self, to: str, kind: str, payload: bytes) -> None:
        """Send to one robot in range, or drop; never blocks."""
        ...

    def set_receiver(self, receiver: Receiver) -> None:
        """Name who takes messages; call before `open`. Called on the event loop's thread, one at a time."""
        ...

    def serve_latents(self, lookup: LatentLookup) -> None:
        """Name who holds latents; call before `open`. The lookup runs on a thread and may block."""
        ...

    async def fetch_latent(
        self,
        owner: str,
        key: str,
        deadline_s: float,
        sha256: bytes | None = None,
        encode_s: float | None = None,
    ) -> Fetched | FetchFailed:
        """Fetch one latent, in pieces, at the lowest priority.

        Args:
            owner: Robot to ask.
            key: The latent's name, such as `r1/7`.
            deadline_s: Seconds from now.
            sha256: The hash that the latent must have, where a record says so.
            encode_s: How long this robot takes to encode a picture, seconds, where it takes a picture instead of a
                latent when that is sooner over the link as measured so far.
        """
        ...

    def counters(self) -> TransportCounters:
        """What went through so far."""
        ...


class TrafficCounter:
    """Counts for a transport; any thread may count."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._messages: dict[str, Counter[str]] = {table: Counter() for table in TABLES}
        self._bytes: dict[str, Counter[str]] = {table: Counter() for table in TABLES}
        self._dropped: Counter[str] = Counter()

    def count_sent(self, kind: str, payload_bytes: int, to: str | None = None) -> None:
        """A message left; `to` is None for a broadcast."""
        self._count("sent", kind, "sent_to", to, payload_bytes)

    def count_received(self, kind: str, payload_bytes: int, sender: str) -> None:
        """A message reached the robot."""
        self._count("received", kind, "received_from", sender, payload_bytes)

    def count_dropped(self, reason: str, count: int = 1) -> None:
        """A message was given up."""
        with self._lock:
            self._dropped[reason] += count

    def snapshot(self) -> TransportCounters:
        """All counts at one moment."""
        with self._lock:
            traffic = {
                table: {name: Traffic(n, self._bytes[table][name]) for name, n in sorted(messages.items())}
                for table, messages in self._messages.items()
            }
            return TransportCounters(**traffic, dropped=dict(sorted(self._dropped.items())))

    def _count(self, kinds: str, kind: str, peers: str, peer: str | None, payload_bytes: int) -> None:
        with self._lock:
            for table, name in ((kinds, kind), (peers, peer)):
                if name is not None and (name in self._messages[table] or len(self._messages[table]) < NAMES_MAX):
                    self._messages[table][name] += 1
                    self._bytes[table][name] += payload_bytes


TABLES = ("sent", "received", "sent_to", "received_from")
NAMES_MAX = 1024
