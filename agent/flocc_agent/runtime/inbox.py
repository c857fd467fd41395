"""Between a network's threads and the event loop: a bounded inbox per kind, and a rate limit per peer.

Threads only append and wake the loop once; the loop drains in batches, urgent kinds first. After a batch it lets
`PAUSE_S` pass before it looks again, because with many neighbours most of the cost of a message is waking up for it.
When an inbox is full its oldest message goes: newer heartbeats and digests say more than older ones, and the log
repairs the rest.
"""

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flocc_agent.runtime.transport import TrafficCounter
from flocc_protocol.keys import Kind

URGENT_FIRST = tuple(kind.value for kind in Kind)
KINDS_MAX = 32
BATCH_MAX = 256
PAUSE_S = 0.02
"""Least time between two batches that have room for more; a message waits half of it on average, on a busy robot."""
BURST_S = 2.0
SILENT_S = 600.0
"""A name that was not heard for so long gives up its place to another one."""


@dataclass(frozen=True, slots=True)
class Incoming:
    """A message as it came from the network."""

    sender: str
    kind: str
    payload: bytes
    attachment: bytes | None = None


class Inbox:
    """Hands messages from any thread to one function on the loop's thread."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        deliver: Callable[[Incoming], None],
        counter: TrafficCounter,
        messages_max: int,
        bytes_max: int,
        urgent_first: Sequence[str] = URGENT_FIRST,
    ) -> None:
        self._loop = loop
        self._deliver = deliver
        self._counter = counter
        self._messages_max = messages_max
        self._bytes_max = bytes_max
        self._lock = threading.Lock()
        self._awake = False
        self._waiting_bytes: dict[str, int] = dict.fromkeys(urgent_first, 0)
        self._queues: dict[str, deque[Incoming]] = {kind: deque() for kind in urgent_first}

    def put(self, message: Incoming) -> None:
        """Append a message; the oldest of its kind give way. Any thread may call."""
        with self._lock:
            if message.kind not in self._queues and len(self._queues) >= KINDS_MAX:
                self._counter.count_dropped("malformed-key")
                return
            self._append(message)
            wake, self._awake = not self._awake, True
        if wake:
            self._wake()

    def size(self) -> tuple[int, int]:
        """Messages of the kind of which most wait, and how many may."""
        with self._lock:
            return max(map(len, self._queues.values())), self._messages_max

    def _append(self, message: Incoming) -> None:
        queue = self._queues.setdefault(message.kind, deque())
        waiting_bytes = self._waiting_bytes.get(message.kind, 0) + len(message.payload)
        queue.append(message)
        while len(queue) > self._messages_max or (waiting_bytes > self._bytes_max and len(queue) > 1):
            oldest = queue.popleft()
            waiting_bytes -= len(oldest.payload)
            self._counter.count_dropped(f"inbox-full-{message.kind}")
            self._counter.count_lost(oldest.kind, len(oldest.payload), oldest.sender)
        self._waiting_bytes[message.kind] = waiting_bytes

    def _wake(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self._drain)
        except RuntimeError:  # the loop is closed: nobody will read any more
            self._counter.count_dropped("closed")

    def _drain(self) -> None:
        """Deliver one batch; come back for the rest after the loop has done other things."""
        batch = self._take_batch()
        for message in batch:
            self._deliver(message)
        if len(batch) == BATCH_MAX:
            self._loop.call_soon(self._drain)
        else:
            self._loop.call_later(PAUSE_S, self._look)

    def _look(self) -> None:
        """Deliver what came during the pause; if nothing did, the next message wakes the loop again."""
        with self._lock:
            self._awake = any(self._queues.values())
        if self._awake:
            self._drain()

    def _take_batch(self) -> list[Incoming]:
        batch: list[Incoming] = []
        with self._lock:
            for kind, queue in self._queues.items():
                while queue and len(batch) < BATCH_MAX:
                    message = queue.popleft()
                    self._waiting_bytes[kind] -= len(message.payload)
                    batch.append(message)
        return batch


@dataclass(slots=True)
class _Bucket:
    """What a peer may still send at once."""

    messages: float
    payload_bytes: float
    filled_s: float


class RateLimiter:
    """Token buckets per peer: a sustained rate of messages and bytes, with bursts of two seconds' worth.

    Where as many peers are known as may be, one that was not heard for `SILENT_S` gives its place to a new one.
    """

    def __init__(self, messages_per_s: float, bytes_per_s: float, peers_max: int) -> None:
        self._messages_per_s = messages_per_s
        self._bytes_per_s = bytes_per_s
        self._peers_max = peers_max
        self._buckets: dict[str, _Bucket] = {}

    def refusal(self, peer: str, payload_bytes: int, now_s: float) -> str | None:
        """Account for a message; say why it must be dropped, None when it may pass."""
        bucket = self._buckets.pop(peer, None)
        if bucket is None:
            if not self._is_room(now_s):
                return "too-many-peers"
            full = (self._messages_per_s * BURST_S, self._bytes_per_s * BURST_S)
            bucket = _Bucket(*full, now_s)
        self._buckets[peer] = bucket  # last, so that the first one is silent for longest
        self._fill(bucket, now_s)
        if bucket.messages < 1.0 or bucket.payload_bytes < payload_bytes:
            return "rate"
        bucket.messages -= 1.0
        bucket.payload_bytes -= payload_bytes
        return None

    def _is_room(self, now_s: float) -> bool:
        """Whether one more peer may be heard, if need be in a silent one's place."""
        if len(self._buckets) < self._peers_max:
            return True
        name, longest = next(iter(self._buckets.items()))
        if now_s - longest.filled_s < SILENT_S:
            return False
        del self._buckets[name]
        return True

    def _fill(self, bucket: _Bucket, now_s: float) -> None:
        elapsed_s = max(0.0, now_s - bucket.filled_s)
        bucket.filled_s = now_s
        bucket.messages = min(self._messages_per_s * BURST_S, bucket.messages + elapsed_s * self._messages_per_s)
        bucket.payload_bytes = min(self._bytes_per_s * BURST_S, bucket.payload_bytes + elapsed_s * self._bytes_per_s)
