"""What the driver asks of a transport: datagrams by robot name, and latents by name, counted.

The contract in one sentence: messages may be lost, late, repeated and out of order, their sender is known from the
key that only the sender may write, nothing here ever blocks the event loop, and every queue is bounded.
Repair of lost messages is the replicated log's business, not the transport's.
"""

import threading
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol, TypeVar

from flocc_agent.core.events import LATENT_FALSE, LATENT_UNKNOWN
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
    UNKNOWN = LATENT_UNKNOWN
    """The holder answered that it does not hold it (any more)."""
    DEADLINE = "deadline"
    """Not complete in time; another try goes on where this one ended."""
    TOO_LARGE = "too-large"
    """The holder offers more bytes than this robot accepts."""
    WRONG_HASH = LATENT_FALSE
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


class Traffic(NamedTuple):
    """Messages and their payload bytes. A broadcast counts once at the sender and once at each receiver."""

    messages: int = 0
    payload_bytes: int = 0


ByPeer = dict[str, dict[str, Traffic]]
"""Peer -> kind -> traffic."""


@dataclass(frozen=True, slots=True)
class TransportCounters:
    """What went through a transport so far.

    A byte is one of payload as handed to zenoh: of an encoded message or of a piece of a latent. Keys, attachments,
    requests for latents, and what zenoh, TLS and TCP put around it are not counted. `sent` counts a broadcast once,
    `sent_to` once for each robot that is linked at that moment. What was sent to a robot is what it received, less
    what it received again, plus what it lost; the rest was lost by the network or is on its way.

    Attributes:
        sent: By kind; latents that were served are of kind "latent".
        received: By kind; only what reached the robot.
        sent_to: By receiver and kind.
        received_from: By sender and kind.
        lost_from: By sender and kind: arrived, but the emulated radio or a limit of this robot kept it away.
        repeated_from: By sender and kind: of what was received, what the emulated radio repeated.
        dropped: Messages by reason: inbox-full, too-large, rate, malformed-key, too-many-peers, not-sent, closed,
            radio-loss, radio-range and so on, foreign-version, foreign-swarm, name-twice, serve-busy.
    """

    sent: dict[str, Traffic]
    received: dict[str, Traffic]
    sent_to: ByPeer
    received_from: ByPeer
    lost_from: ByPeer
    repeated_from: ByPeer
    dropped: dict[str, int]

    def links(self) -> dict[str, dict[str, dict[str, int]]]:
        """Payload bytes by table, peer and kind, for files."""
        return {
            table: {
                peer: {kind: traffic.payload_bytes for kind, traffic in kinds.items()}
                for peer, kinds in getattr(self, table).items()
            }
            for table in LINK_TABLES
        }


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

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Every queue: how much is in it, and its maximum."""
        ...


LATENT = "latent"
"""The kind under which pieces of latents are counted."""
KIND_TABLES = ("sent", "received")
LINK_TABLES = ("sent_to", "received_from", "lost_from", "repeated_from")
NAMES_MAX = 4096
"""Kinds, or pairs of peer and kind, that are counted apart; those of further ones are not counted."""


class TrafficCounter:
    """Counts for a transport; any thread may count."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kinds: dict[str, dict[str, list[int]]] = {table: {} for table in KIND_TABLES}
        self._links: dict[str, dict[tuple[str, str], list[int]]] = {table: {} for table in LINK_TABLES}
        self._dropped: Counter[str] = Counter()

    def count_sent(self, kind: str, payload_bytes: int, to: Iterable[str]) -> None:
        """A message left for these robots."""
        with self._lock:
            _count(self._kinds["sent"], kind, payload_bytes)
            for peer in to:
                _count(self._links["sent_to"], (peer, kind), payload_bytes)

    def count_received(self, kind: str, payload_bytes: int, sender: str) -> None:
        """A message reached the robot."""
        with self._lock:
            _count(self._kinds["received"], kind, payload_bytes)
            _count(self._links["received_from"], (sender, kind), payload_bytes)

    def count_lost(self, kind: str, payload_bytes: int, sender: str) -> None:
        """A message arrived and was kept from the robot."""
        with self._lock:
            _count(self._links["lost_from"], (sender, kind), payload_bytes)

    def count_repeated(self, kind: str, payload_bytes: int, sender: str) -> None:
        """A message will reach the robot once more than it was sent."""
        with self._lock:
            _count(self._links["repeated_from"], (sender, kind), payload_bytes)

    def used_bytes(self) -> int:
        """What counts against a budget: messages, sent and received, and latents fetched; those served do not."""
        with self._lock:
            sent, received = self._kinds["sent"], self._kinds["received"]
            messages = sum(payload_bytes for kind, (_, payload_bytes) in sent.items() if kind != LATENT)
            return messages + sum(payload_bytes for _, payload_bytes in received.values())

    def count_dropped(self, reason: str, count: int = 1) -> None:
        """A message was given up."""
        with self._lock:
            self._dropped[reason] += count

    def snapshot(self) -> TransportCounters:
        """All counts at one moment."""
        with self._lock:
            sent, received = (_by_kind(self._kinds[table]) for table in KIND_TABLES)
            links = {table: _by_peer(counted) for table, counted in self._links.items()}
            return TransportCounters(
                sent=sent,
                received=received,
                sent_to=links["sent_to"],
                received_from=links["received_from"],
                lost_from=links["lost_from"],
                repeated_from=links["repeated_from"],
                dropped=dict(sorted(self._dropped.items())),
            )


Name = TypeVar("Name", str, tuple[str, str])


def _count(counted: dict[Name, list[int]], name: Name, payload_bytes: int) -> None:
    counts = counted.get(name)
    if counts is None:
        if len(counted) >= NAMES_MAX:
            return
        counts = counted[name] = [0, 0]
    counts[0] += 1
    counts[1] += payload_bytes


def _by_kind(counted: dict[str, list[int]]) -> dict[str, Traffic]:
    return {kind: Traffic(*counts) for kind, counts in sorted(counted.items())}


def _by_peer(counted: dict[tuple[str, str], list[int]]) -> ByPeer:
    tables: ByPeer = {}
    for (peer, kind), counts in sorted(counted.items()):
        tables.setdefault(peer, {})[kind] = Traffic(*counts)
    return tables
