"""The transport over zenoh: two sessions per agent, one writer per key, nothing that blocks the event loop.

Control (heartbeats, elections, records, corrections, requests) is published with DROP; bulk (latents) is fetched with
BLOCK at the lowest priority, in pieces, on threads. Callbacks of zenoh only enqueue. Liveliness tokens are used to
name strangers and doubles, and to account for whom a broadcast went to, never to say who is there: that is what
heartbeats are for.

With a `Radio`, links are emulated at the receiver: every message that arrives is put to the model, which loses,
delays or repeats it. The sender's true position then travels as the attachment of its messages.
"""

import asyncio
import logging
import secrets
import struct
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import BoundedSemaphore
from types import TracebackType

import zenoh

from flocc_agent.config import TransportConfig
from flocc_agent.radio import Radio
from flocc_agent.runtime.addresses import Addresses, AddressWatch, at_addresses, machine_addresses
from flocc_agent.runtime.inbox import Inbox, Incoming, RateLimiter
from flocc_agent.runtime.transport import (
    Fetched,
    FetchFailed,
    LatentLookup,
    Receiver,
    TrafficCounter,
    TransportCounters,
    TransportError,
)
from flocc_agent.runtime.zenoh_admin import AdminService, Answer
from flocc_agent.runtime.zenoh_bulk import BulkService
from flocc_agent.runtime.zenoh_session import Plane, open_session, session_settings
from flocc_protocol import keys
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import checked_name

logger = logging.getLogger(__name__)

POSITION = struct.Struct(">3d")
FRAGMENT_BYTES = 60_000
SLOW_PUTS_MAX = 16
ADDRESSES_MAX = 4096
ADDRESSES_PERIOD_S = 1.0
"""How often this machine's addresses are looked at; sessions are opened anew when they stayed for so long."""
DELAYED_MAX = 20_000
INBOX_BYTES_MAX = 32 * 1024 * 1024
"""Bytes of one kind of message that wait for the robot; the oldest is dropped for a new one."""

PRIORITY = {
    keys.Kind.HEARTBEAT.value: zenoh.Priority.REAL_TIME,
    keys.Kind.ELECTION.value: zenoh.Priority.INTERACTIVE_HIGH,
    keys.Kind.ANSWER.value: zenoh.Priority.INTERACTIVE_HIGH,
    keys.Kind.COORDINATOR.value: zenoh.Priority.INTERACTIVE_HIGH,
    keys.Kind.HANDOVER.value: zenoh.Priority.INTERACTIVE_HIGH,
    keys.Kind.CORRECTION.value: zenoh.Priority.INTERACTIVE_LOW,
    keys.Kind.CORRECTION_REQUEST.value: zenoh.Priority.INTERACTIVE_LOW,
    keys.Kind.KNOT_REQUEST.value: zenoh.Priority.INTERACTIVE_LOW,
    keys.Kind.DIGESTS.value: zenoh.Priority.INTERACTIVE_LOW,
    keys.Kind.DIGEST_REQUEST.value: zenoh.Priority.INTERACTIVE_LOW,
    keys.Kind.RECORDS.value: zenoh.Priority.DATA_HIGH,
    keys.Kind.RECORD_REQUEST.value: zenoh.Priority.DATA_HIGH,
    keys.Kind.CANDIDATES.value: zenoh.Priority.DATA,
    keys.Kind.SHARED_POSES.value: zenoh.Priority.DATA,
}
EXPRESS_PRIORITIES = (zenoh.Priority.REAL_TIME, zenoh.Priority.INTERACTIVE_HIGH)
EXPRESS = frozenset(kind for kind, priority in PRIORITY.items() if priority in EXPRESS_PRIORITIES)


class ZenohTransport:
    """A `Transport` over zenoh in peer mode. Use it as an async context manager, or close it: always."""

    def __init__(
        self,
        swarm: str,
        robot: str,
        config: TransportConfig,
        radio: Radio | None = None,
        clock_s: Callable[[], float] = time.monotonic,
        bandwidth_bytes_s: float | None = None,
    ) -> None:
        """Prepare; nothing is opened yet.

        Args:
            swarm: Name of the swarm; others are not heard.
            robot: This robot's name, the only one it writes under.
            config: Endpoints, limits, TLS.
            radio: Emulated links, None for the real ones only. Touched on the event loop's thread alone.
            clock_s: Time for the radio's schedule, such as seconds since the start of the run.
            bandwidth_bytes_s: Budget; latents wait for what messages leave of it. None: there is none.
        """
        self.swarm = checked_name(swarm, "swarm name")
        self.robot = checked_name(robot)
        self.boot = secrets.token_hex(8)
        self._config = config
        self._radio = radio
        self._clock_s = clock_s
        self._counter = TrafficCounter()
        self._limiter = RateLimiter(config.peer_messages_per_s, config.peer_bytes_per_s, config.peers_max)
        self._bulk = BulkService(self.swarm, self.robot, config, self._counter, radio, clock_s, bandwidth_bytes_s)
        self._admin = AdminService(self.swarm, self.robot)
        self._receiver: Receiver = lambda *_: None
        self._session: zenoh.Session | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._inbox: Inbox | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._addresses: dict[str, keys.Address] = {}
        self._slow = ThreadPoolExecutor(1, thread_name_prefix=f"{robot}-put")
        self._slow_puts = BoundedSemaphore(SLOW_PUTS_MAX)
        self._delayed: dict[int, asyncio.TimerHandle] = {}
        self._delayed_count = 0
        self._named: set[tuple[str, ...]] = set()
        self._linked: dict[str, str] = {}
        self._watching: asyncio.Task[None] | None = None
        self._closed = False

    async def __aenter__(self) -> "ZenohTransport":
        try:
            await self.open()
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def set_receiver(self, receiver: Receiver) -> None:
        """Name who takes messages."""
        self._receiver = receiver

    def serve_latents(self, lookup: LatentLookup) -> None:
        """Name who holds latents."""
        self._bulk.serve(lookup)

    def serve_admin(self, admin: keys.Admin, answer: Answer) -> None:
        """Answer operators; call before `open`. The answer is made on the event loop's thread."""
        self._admin.serve(admin, answer)

    def counters(self) -> TransportCounters:
        """What went through so far; emulated losses are `radio-...`."""
        counters = self._counter.snapshot()
        if self._radio is not None:
            counters.dropped.update({f"radio-{reason}": n for reason, n in sorted(self._radio.dropped.items())})
        return counters

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Messages that wait for the robot (of the kind with most), and those that the emulated radio delays."""
        network = (0, self._config.inbox_messages_max) if self._inbox is None else self._inbox.size()
        return {"network": network, "delayed": (len(self._delayed), DELAYED_MAX)}

    # --- opening and closing

    async def open(self) -> None:
        """Open both sessions and declare everything; a failure leaves nothing open.

        Raises:
            TransportError: A port in use, a bad address, an unreadable certificate.
        """
        if self._session is not None:
            raise TransportError(f"robot {self.robot}: the transport is open already")
        self._loop = asyncio.get_running_loop()
        limits = (self._config.inbox_messages_max, INBOX_BYTES_MAX)
        self._inbox = Inbox(self._loop, self._arrived, self._counter, *limits)
        watch = AddressWatch(machine_addresses(), self._config.interface)
        try:
            await asyncio.to_thread(self._open_blocking)
        except BaseException:
            await self.close()
            raise
        if self._config.scouts(self.swarm):
            self._watching = asyncio.create_task(self._watch_addresses(watch))

    async def _watch_addresses(self, watch: AddressWatch) -> None:
        """Open both sessions anew when this machine has other addresses: zenoh scouts on those that it found."""
        failed = False
        while True:
            await asyncio.sleep(ADDRESSES_PERIOD_S)
            news = watch.news(machine_addresses())
            if not news and not failed:
                continue
            told = f" ({', '.join(news)})" if news else ""
            logger.warning("robot %s: this machine has other addresses%s, opening the network anew", self.robot, told)
            try:
                await asyncio.shield(asyncio.to_thread(self._reopen_blocking))
                failed = False
            except TransportError as error:
                logger.warning("%s; it is tried again", error)
                failed = True

    def _reopen_blocking(self) -> None:
        """Messages of the meantime are not sent; logs repair that."""
        session, self._session = self._session, None
        self._linked = {}
        self._bulk.close_session()
        if session is not None:
            session.close()
        if not self._closed:
            self._open_blocking(machine_addresses())

    def _open_blocking(self, addresses: Addresses = frozenset()) -> None:
        whose = f"robot {self.robot}"
        control, bulk = (session_settings(self._config, self.swarm, self.robot, plane) for plane in Plane)
        if addresses:
            control, bulk = at_addresses(control, addresses), at_addresses(bulk, addresses)
        session = open_session(control, whose)
        try:
            self._declare_all(session)
            self._bulk.open(bulk, whose)
        except BaseException:
            session.close()
            raise
        self._session = session

    def _declare_all(self, session: zenoh.Session) -> None:
        for pattern in (
            keys.broadcasts_pattern(self.swarm),
            keys.unicasts_pattern(self.swarm, self.robot),
        ):
            session.declare_subscriber(pattern, self._enqueue, allowed_origin=zenoh.Locality.REMOTE)
        liveliness = session.liveliness()
        liveliness.declare_subscriber(keys.presence_pattern(), self._presence_changed, history=True)
        self._token = liveliness.declare_token(keys.alive_key(self.swarm, self.robot, self.boot))
        self._publishers = {kind.value: self._declare(session, kind.value) for kind in keys.Kind}
        assert self._loop is not None
        self._admin.open(session, self._loop)

    def _declare(self, session: zenoh.Session, kind: str) -> zenoh.Publisher:
        return session.declare_publisher(
            keys.broadcast_key(self.swarm, self.robot, kind),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=PRIORITY.get(kind, zenoh.Priority.DATA),
            express=kind in EXPRESS,
        )

    async def close(self) -> None:
        """Close both sessions and end all threads; safe to call twice."""
        for handle in self._delayed.values():
            handle.cancel()
        self._delayed.clear()
        self._closed = True
        self._bulk.stop_fetching()
        if self._watching is not None:
            self._watching.cancel()
            await asyncio.gather(self._watching, return_exceptions=True)
        await asyncio.shield(asyncio.to_thread(self._close_blocking))

    def _close_blocking(self) -> None:
        session, self._session = self._session, None
        self._publishers.clear()
        try:
            self._bulk.close()
        finally:
            if session is not None:
                session.close()
            self._slow.shutdown(wait=True, cancel_futures=True)
            self._admin.close()

    # --- sending

    def broadcast(self, kind: str, payload: bytes) -> None:
        """Send to every robot in range, or drop."""
        kind = keys.checked_kind(kind)
        session = self._session
        if session is None or not self._may_send(payload):
            return self._counter.count_dropped("not-sent")
        if kind not in self._publishers:
            self._publishers[kind] = self._declare(session, kind)
        publisher, attachment = self._publishers[kind], self._position()
        self._put(lambda: publisher.put(payload, attachment=attachment), payload)
        return self._counter.count_sent(kind, len(payload), set(self._linked.values()))

    def unicast(self, to: str, kind: str, payload: bytes) -> None:
        """Send to one robot in range, or drop."""
        key = keys.unicast_key(self.swarm, self.robot, to, kind)
        session, attachment = self._session, self._position()
        if session is None or not self._may_send(payload):
            return self._counter.count_dropped("not-sent")
        quality = PRIORITY.get(kind, zenoh.Priority.DATA)
        drop = zenoh.CongestionControl.DROP
        self._put(
            lambda: session.put(
                key,
                payload,
                congestion_control=drop,
                priority=quality,
                express=kind in EXPRESS,
                attachment=attachment,
            ),
            payload,
        )
        return self._counter.count_sent(keys.checked_kind(kind), len(payload), (to,))

    def _may_send(self, payload: bytes) -> bool:
        return len(payload) <= self._config.message_bytes_max

    def _put(self, put: Callable[[], None], payload: bytes) -> None:
        """Put at once what fits into one batch; longer messages may wait for the link, so a thread puts them."""
        if len(payload) <= FRAGMENT_BYTES:
            self._try_put(put)
        elif self._slow_puts.acquire(blocking=False):
            self._slow.submit(self._slow_put, put)
        else:
            self._counter.count_dropped("not-sent")

    def _slow_put(self, put: Callable[[], None]) -> None:
        try:
            self._try_put(put)
        finally:
            self._slow_puts.release()

    def _try_put(self, put: Callable[[], None]) -> None:
        try:
            put()
        except zenoh.ZError as error:
            self._counter.count_dropped("not-sent")
            logger.debug("robot %s: a message was not sent: %s", self.robot, error)

    def _position(self) -> bytes | None:
        """This robot's true position, where links are emulated and somebody told it."""
        position_m = self._radio.position_m(self.robot) if self._radio is not None else None
        return POSITION.pack(*position_m) if position_m is not None else None

    # --- receiving: `_enqueue` on zenoh's threads, the rest on the loop

    def _enqueue(self, sample: zenoh.Sample) -> None:
        try:
            address = self._address(str(sample.key_expr))
        except DecodeError:
            return self._counter.count_dropped("malformed-key")
        payload_bytes = len(sample.payload)
        refusal = self._refusal(address.sender, payload_bytes)
        if refusal is not None:
            self._counter.count_lost(address.kind, payload_bytes, address.sender)
            return self._counter.count_dropped(refusal)
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else None
        assert self._inbox is not None
        return self._inbox.put(Incoming(address.sender, address.kind, sample.payload.to_bytes(), attachment))

    def _refusal(self, sender: str, payload_bytes: int) -> str | None:
        """Why a message is kept from the robot, if it is."""
        if payload_bytes > self._config.message_bytes_max:
            return "too-large"
        return self._limiter.refusal(sender, payload_bytes, time.monotonic())

    def _address(self, key: str) -> keys.Address:
        address = self._addresses.get(key)
        if address is None:
            address = keys.parse_message_key(key)
            if len(self._addresses) < ADDRESSES_MAX:
                self._addresses[key] = address
        return address

    def _arrived(self, message: Incoming) -> None:
        """Put a message to the emulated radio, if there is one, and deliver it when it says."""
        if self._radio is None or self._radio.parameters.is_perfect:
            return self._deliver(message)
        if message.attachment is not None and len(message.attachment) == POSITION.size:
            self._radio.update_position(message.sender, POSITION.unpack(message.attachment))
        now_s = self._clock_s()
        size = len(message.payload)
        arrivals_s = self._radio.transmit(message.sender, self.robot, message.kind, size, now_s)
        if not arrivals_s:
            self._counter.count_lost(message.kind, size, message.sender)
        for _ in arrivals_s[1:]:
            self._counter.count_repeated(message.kind, size, message.sender)
        for arrival_s in arrivals_s:
            self._deliver_after(arrival_s - now_s, message)
        return None

    def _deliver_after(self, delay_s: float, message: Incoming) -> None:
        if delay_s <= 0.0:
            return self._deliver(message)
        if len(self._delayed) >= DELAYED_MAX:
            self._counter.count_lost(message.kind, len(message.payload), message.sender)
            return self._counter.count_dropped("radio-delayed")
        assert self._loop is not None
        number = self._delayed_count = self._delayed_count + 1
        self._delayed[number] = self._loop.call_later(delay_s, self._deliver_delayed, number, message)
        return None

    def _deliver_delayed(self, number: int, message: Incoming) -> None:
        del self._delayed[number]
        self._deliver(message)

    def _deliver(self, message: Incoming) -> None:
        if self._session is None:
            return
        self._counter.count_received(message.kind, len(message.payload), message.sender)
        self._receiver(message.sender, message.kind, message.payload)

    # --- strangers and doubles

    def _presence_changed(self, sample: zenoh.Sample) -> None:
        """Name, once each, robots of another version or swarm, and a second process with this robot's name."""
        try:
            seen = keys.parse_alive_key(str(sample.key_expr))
        except DecodeError:
            return self._counter.count_dropped("malformed-key")
        if seen.boot == self.boot:
            return None
        if sample.kind != zenoh.SampleKind.PUT:
            self._linked = {boot: robot for boot, robot in self._linked.items() if boot != seen.boot}
            return None
        if seen.version != keys.VERSION:
            return self._name_once(
                "foreign-version", f"robot {seen.robot} speaks protocol {seen.version}, not {keys.VERSION}", seen
            )
        if seen.swarm != self.swarm:
            return self._name_once("foreign-swarm", f"robot {seen.robot} of swarm {seen.swarm} is ignored", seen)
        if seen.robot == self.robot:
            return self._name_once("name-twice", f"another process runs under the name {seen.robot}", seen)
        if len(self._linked) < self._config.peers_max:
            self._linked = {**self._linked, seen.boot: seen.robot}
        return None

    def _name_once(self, reason: str, sentence: str, seen: keys.Presence) -> None:
        self._counter.count_dropped(reason)
        name = (reason, seen.swarm, seen.robot)
        if name not in self._named and len(self._named) < self._config.peers_max:
            self._named.add(name)
            logger.warning("robot %s: %s", self.robot, sentence)

    # --- latents

    async def fetch_latent(
        self,
        owner: str,
        key: str,
        deadline_s: float,
        sha256: bytes | None = None,
        encode_s: float | None = None,
    ) -> Fetched | FetchFailed:
        """Fetch one latent in pieces, a few latents at a time, at the lowest priority."""
        return await self._bulk.fetch(owner, key, deadline_s, sha256, encode_s)
