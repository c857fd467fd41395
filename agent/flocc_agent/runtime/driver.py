"""The asyncio driver: one task owns the core; zenoh's threads and the workers only put events into its inbox.

Effects are carried out in order. What is persisted is on disk before what follows it is sent. Encoding,
registration, optimisation, fetches and disk writes never run on the event loop.
"""

import asyncio
import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.blocks import BlockProblem, BlockStep
from flocc_agent.core.corrections import pose7
from flocc_agent.core.effects import (
    Broadcast,
    Correction,
    Deliver,
    Effect,
    Encode,
    FetchLatent,
    IterateBlock,
    Optimise,
    PersistCorrection,
    PersistRecord,
    PersistTerm,
    Register,
    Report,
    Unicast,
)
from flocc_agent.core.events import (
    BlockIterated,
    BlockIterationFailed,
    Event,
    GraphOptimisationFailed,
    GraphOptimised,
    KeyframeCaptured,
    KeyframeEncoded,
    KeyframeEncodingFailed,
    LatentFetched,
    LatentFetchFailed,
    LatentMissing,
    Leaving,
    Measured,
    MessageReceived,
    PairRegistered,
)
from flocc_agent.core.interfaces import Image, OdometryPair
from flocc_agent.core.measurements import Measurement
from flocc_agent.core.pose_graph import GraphSolution, OptimisationFailed, PoseGraph, map_frame
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.core.reports import (
    ClosureAccepted,
    CorrectionApplied,
    Fact,
    LatentLost,
    LeaderFollowed,
    LeaderLost,
    LogForked,
    NameTaken,
    NeighbourDown,
    NeighbourUp,
    PeerRefused,
    RoundFailed,
    RoundSolved,
    name_of,
)
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import pose_from_tq
from flocc_agent.runtime.event_lines import Reported, values_of
from flocc_agent.runtime.facts import AccountKept, BytesCounted
from flocc_agent.runtime.given_keyframes import GivenKeyframes
from flocc_agent.runtime.metrics import Look
from flocc_agent.runtime.outbox import Outbox
from flocc_agent.runtime.persistence import Persist, write
from flocc_agent.runtime.punctuality import LongestGap
from flocc_agent.runtime.reporting import Reporter, corrected_bodies, result_of
from flocc_agent.runtime.store import Store
from flocc_agent.runtime.transport import Fetched, Transport, TransportCounters
from flocc_agent.runtime.workers import Workers, WorkFailed
from flocc_agent.stages import brief_of, counts_of
from flocc_protocol.arrays import Array
from flocc_protocol.errors import DecodeError, FloccError
from flocc_protocol.ids import KeyframeId
from flocc_protocol.keys import Kind
from flocc_protocol.messages import (
    BATCHES_MAX,
    RECORDS_BATCH_MAX,
    Envelope,
    Message,
    RecordBatch,
    Records,
    UnknownVersion,
    decode,
    encode,
    kind_of,
)

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

INBOX_MAX = 8192
COPIES_MAX = 256
COPIES_PERIOD_S = 0.5
"""Copies of others' records are written so many, and what one message adds, or so long at a time."""
REFUSED_MAX = 512
"""Refusals that are counted apart, by peer and reason."""
IMAGES_MAX = 8
CORRECTIONS_MAX = 16
HEARTBEAT = Kind.HEARTBEAT.value
BYTES_PERIOD_S = 1.0
ACCOUNT_PERIOD_S = 10.0


class Encoded(Protocol):
    """What encoding an image gives."""

    @property
    def descriptor(self) -> Array:
        """Place descriptor."""
        ...

    @property
    def latent(self) -> bytes:
        """Latent of the registrar."""
        ...


@dataclass(frozen=True, slots=True)
class Skills:
    """What the driver's workers can do; named by the composition root.

    Attributes:
        encode: Image to descriptor and latent.
        register: (query latent, match latent, odometry pair) to a relative pose up to scale.
        optimise: Pose graph and last solution to a solution; must be importable by a worker process.
        iterate: One iteration of this robot's block, in distributed mode; importable like `optimise`.
        part: (latent, what the link carries while the asker encodes) to what is sent; see `PictureEncoder.part`.
        encode_s: See `PictureEncoder.encode_s`.
    """

    encode: Callable[[Image], Encoded]
    register: Callable[[bytes, bytes, OdometryPair | None], Registration | RegistrationFailed]
    optimise: Callable[[PoseGraph, GraphSolution | None], GraphSolution | OptimisationFailed]
    iterate: Callable[[BlockProblem], BlockStep | OptimisationFailed]
    part: Callable[[bytes, int | None], bytes]
    encode_s: Callable[[], float | None]


class Driver:
    """Runs one robot's core on an event loop."""

    def __init__(
        self,
        robot: Robot,
        transport: Transport,
        store: Store,
        workers: Workers,
        skills: Skills,
        reporter: Reporter,
        on_report: Callable[[Reported[Fact]], None],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare; `run` does the rest.

        Args:
            robot: The core, already restored from the store.
            transport: Carries messages and latents; the driver opens and closes it.
            store: Disk or memory.
            workers: Pools off the loop.
            skills: What the workers compute.
            reporter: Says when and where facts happened.
            on_report: Takes each fact; must not block.
            clock_s: Seconds since the start of the run; the core's only clock.
        """
        self.robot = robot
        self._transport = transport
        self._store = store
        self._workers = workers
        self._skills = skills
        self._reporter = reporter
        self._on_report = on_report
        self._clock_s = clock_s
        self._inbox: deque[tuple[float, Event]] = deque()
        self._wake = asyncio.Event()
        self._opened = asyncio.Event()
        self._images: dict[int, Image] = {}
        self._image_count = 0
        self._given = GivenKeyframes.of(robot)
        self._image_slots = asyncio.Semaphore(IMAGES_MAX)
        self._tasks: set[asyncio.Task[None]] = set()
        self._stopping = False
        self._subscribers: list[asyncio.Queue[Correction | None]] = []
        self._refused: Counter[tuple[str, str]] = Counter()
        self._last_graph: PoseGraph | None = None
        self._began_s = clock_s()
        self._bytes_due_s = self._began_s + BYTES_PERIOD_S
        self._copied: list[Persist] = []
        self._copies_due_s = self._began_s
        self._account_due_s = self._began_s + ACCOUNT_PERIOD_S
        self._outbox = Outbox()
        self._gaps = {"sent": LongestGap(), "heard": LongestGap()}
        self.last_correction: Correction | None = None
        self.last_solution: GraphSolution | None = None

    async def opened(self, run: "asyncio.Task[None]") -> None:
        """Wait until the network is open; raises what `run` raised."""
        opening = asyncio.create_task(self._opened.wait())
        done, _ = await asyncio.wait({opening, run}, return_when=asyncio.FIRST_COMPLETED)
        if run in done:
            opening.cancel()
            run.result()

    # For the robot's own program

    async def add_keyframe(self, image: Image, T_odom_camera: Float, stamp_s: float) -> None:
        """Take a keyframe in; waits while too many images wait for the encoder."""
        await self._image_slots.acquire()
        self._image_count += 1
        self._images[self._image_count] = image
        self._given.add(stamp_s)
        self.put(KeyframeCaptured(stamp_s, pose7(T_odom_camera), self._image_count))

    def add_measurement(self, measurement: Measurement, stamp_s: float | None = None) -> None:
        """Take in what was measured at the keyframe that was given last, or at the one with this stamp.

        Raises:
            BadMeasurement: There is no such keyframe.
        """
        index = self._given.index_of(measurement, stamp_s)
        self.put(Measured(measurement, index))

    def keyframe_at(self, stamp_s: float) -> KeyframeId:
        """The own keyframe with this stamp.

        Raises:
            BadMeasurement: There is none.
        """
        return KeyframeId(self.robot.log, self._given.at("closure", stamp_s))

    def subscribe(self) -> "asyncio.Queue[Correction | None]":
        """A queue of corrections, newest kept when it is full; None ends it."""
        queue: asyncio.Queue[Correction | None] = asyncio.Queue(CORRECTIONS_MAX)
        self._subscribers.append(queue)
        if self.last_correction is not None:
            queue.put_nowait(self.last_correction)
        return queue

    def put(self, event: Event) -> None:
        """Put an event into the inbox, on the loop's thread."""
        self._inbox.append((self._clock_s(), event))
        self._wake.set()

    def stop(self) -> None:
        """Ask `run` to hand over and end."""
        self._stopping = True
        self._wake.set()

    def mount_camera(self, T_body_camera: Float) -> None:
        """Say where the camera sits on the body, where that was not known at the start."""
        self._reporter = replace(self._reporter, T_body_camera=T_body_camera)

    def corrected_bodies(self) -> tuple[list[float], Float]:
        """Stamps (s) and (N, 4, 4) corrected body poses of all keyframes; may be called off the loop's thread."""
        return corrected_bodies(self.robot, self._reporter.T_body_camera)

    def busy(self) -> bool:
        """Whether images, fetches, registrations or rounds are under way, or a leader still owes a round."""
        owes_round = self.robot.rounds.deadline() < float("inf")
        return bool(self._inbox or self._images or self._tasks or self.robot.closing.load or owes_round)

    def status(self) -> dict[str, Any]:
        """What this robot does now: leader, neighbours, sizes, map frame, bytes, refusals."""
        robot, counters = self.robot, self._transport.counters()
        applied, term = robot.corrections.applied, robot.election.term
        digests = robot.gossip.digests()
        return {
            "t": round(self._clock_s(), 3),
            "robot": robot.log.robot,
            "log": str(robot.log),
            "leader": None if term is None else term.leader.robot,
            "term": None if term is None else term.counter,
            "role": robot.election.role.value,
            "neighbours": robot.neighbours.names(),
            "keyframes": robot.gossip.logs[robot.log].keyframes,
            "closures": robot.assembly.closures,
            "candidates": robot.closing.load,
            "map_frame": None if applied is None else map_frame(applied.anchor),
            "round": None if applied is None else applied.round,
            "logs": {str(digest.log): [digest.count, digest.checksum] for digest in digests},
            "sent_bytes": sum(traffic.payload_bytes for traffic in counters.sent.values()),
            "received_bytes": sum(traffic.payload_bytes for traffic in counters.received.values()),
            "loss": self._losses(),
            "queues": self._queues(),
            "sizes": {name: list(size) for name, size in self._sizes().items()},
            "heartbeat_gap_s": {which: round(gap.longest_s(self._clock_s()), 3) for which, gap in self._gaps.items()},
            "links": {table: totals(peers) for table, peers in counters.links().items()},
            "stages": brief_of(self._workers.stages.snapshot()),
            "refused": {**counters.dropped, **self._refusals()},
            "busy": self.busy(),
        }

    def look(self) -> Look:
        """What a scrape of the metrics sees."""
        robot = self.robot
        applied, term = robot.corrections.applied, robot.election.term
        return Look(
            counters=self._transport.counters(),
            stages=self._workers.stages.snapshot(),
            refused=self._refusals(),
            gauges={
                "keyframes": robot.gossip.logs[robot.log].keyframes,
                "closures": robot.assembly.closures,
                "candidates": robot.closing.load,
                "neighbours": len(robot.neighbours.names()),
                "logs": len(robot.gossip.logs),
                "leading": float(robot.election.leading),
                "term": 0 if term is None else term.counter,
                "round": 0 if applied is None else applied.round,
            },
            queues=self._sizes(),
            info={"robot": robot.log.robot, "log": str(robot.log)},
        )

    def counters(self) -> dict[str, int]:
        """What was refused or dropped, by reason."""
        return {**self._transport.counters().dropped, **self._refusals()}

    def _refusals(self) -> dict[str, int]:
        """Messages refused by reason, of all peers."""
        refused = Counter[str]()
        for (_, reason), count in self._refused.items():
            refused[f"refused {reason}"] += count
        return dict(refused)

    def result(self) -> dict[str, Any]:
        """What this robot knows, for `result.json`."""
        return result_of(self.robot, self._reporter.T_body_camera, self.last_solution)

    # The loop

    async def run(self) -> None:
        """Open the transport, live until `stop`, hand over, close everything.

        Raises:
            TransportError: The network cannot be used as configured.
        """
        self._transport.set_receiver(self._on_payload)
        self._transport.serve_latents(self._latent_named)
        try:
            await self._transport.open()
            self._opened.set()
            await self._live()
            self._send_records()
            await self._carry_out(self.robot.handle(Leaving(), self._clock_s()))
        finally:
            await self._close()

    async def _live(self) -> None:
        while not self._stopping:
            now = self._clock_s()
            if self.robot.deadline() <= now:
                await self._carry_out(self.robot.tick(now))
            while self._inbox and self.robot.deadline() > self._clock_s():
                put_s, event = self._inbox.popleft()
                now = self._clock_s()
                self._workers.stages.observe("inbox_wait", now - put_s)
                await self._carry_out(self.robot.handle(event, now))
            self._send_due_records()
            self._count_bytes()
            await self._write_copies()
            await self._sleep()

    async def _sleep(self) -> None:
        """Wait for an event or for the next deadline."""
        if self._inbox or self._stopping:
            await asyncio.sleep(0)
            return
        self._wake.clear()
        copies_due_s = self._copies_due_s if self._copied else float("inf")
        due_s = min(self.robot.deadline(), self._bytes_due_s, copies_due_s, self._outbox.due_s())
        pause_s = due_s - self._clock_s()
        alarm = asyncio.get_running_loop().call_later(max(pause_s, 0.0), self._wake.set)
        try:
            await self._wake.wait()
        finally:
            alarm.cancel()

    async def _close(self) -> None:
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._flush()
        self._count_bytes(last=True)
        await self._transport.close()
        await self._workers.close()
        for queue in self._subscribers:
            _put_newest(queue, None)

    def _latent_named(self, key: str, encode_bytes: int | None) -> bytes | None:
        """A latent for the transport, by a name that a peer gave, or the part of it that reaches him sooner."""
        try:
            latent = self._store.latent(KeyframeId.parse(key))
            return None if latent is None else self._skills.part(latent, encode_bytes)
        except (ValueError, FloccError):
            return None

    # Messages

    def _on_payload(self, sender: str, kind: str, payload: bytes) -> None:
        """Check a payload of a peer; what is refused is counted, and logged once per peer and reason."""
        try:
            envelope = decode(payload)
        except UnknownVersion as error:
            self._refuse(sender, "another protocol version", str(error))
            return
        except DecodeError:
            self._refuse(sender, "malformed message")
            return
        if envelope.sender.robot != sender or kind_of(envelope.message) != kind:
            self._refuse(sender, "message of another robot or kind than its key")
            return
        if len(self._inbox) >= INBOX_MAX:
            self._refuse(sender, "too many messages wait")
            return
        if kind == HEARTBEAT:
            self._gaps["heard"].mark(sender, self._clock_s())
        self.put(MessageReceived(envelope))

    def _refuse(self, peer: str, reason: str, detail: str = "") -> None:
        """Count what is refused of a peer by reason; the first is told, with what is special about it."""
        if len(self._refused) >= REFUSED_MAX and (peer, reason) not in self._refused:
            peer, reason = "others", "for more reasons than are kept"
        self._refused[peer, reason] += 1
        if self._refused[peer, reason] == 1:
            self._report(PeerRefused(peer=peer, reason=detail or reason))

    def _send(self, message: Message, to: str | None) -> None:
        payload, kind = encode(Envelope(self.robot.log, message)), kind_of(message)
        if kind == HEARTBEAT:
            self._gaps["sent"].mark(HEARTBEAT, self._clock_s())
        if to is None:
            self._transport.broadcast(kind, payload)
        else:
            self._transport.unicast(to, kind, payload)

    def _send_later(self, batch: RecordBatch) -> None:
        """Broadcast own records, now or with those that follow."""
        too_long = self._outbox.add(batch)
        if too_long is not None:
            self._send(too_long, None)
        self._send_due_records()

    def _send_due_records(self) -> None:
        if self._outbox.due_s() <= self._clock_s():
            self._send_records()

    def _send_records(self) -> None:
        """Broadcast own records that wait."""
        waiting = self._outbox.take(len(self.robot.neighbours.names()), self._clock_s())
        if waiting is not None:
            self._send(waiting, None)

    # Effects

    async def _carry_out(self, effects: list[Effect]) -> None:
        written: list[Persist] = []
        for effect in effects:
            match effect:
                case PersistRecord(log=log) if log != self.robot.log:
                    self._copied.append(effect)
                    continue
                case PersistRecord() | PersistTerm() | PersistCorrection():
                    written.append(effect)
                    continue
                case Report(fact):
                    self._tell(fact)
                    continue
            await self._write(written)
            self._do(effect)
        await self._write(written)
        if len(self._copied) >= COPIES_MAX:
            await self._flush()

    def _tell(self, fact: Fact) -> None:
        """Report what the core tells, and act on what concerns the driver."""
        match fact:
            case PeerRefused():
                self._refuse(fact.peer, fact.reason)
                return
            case LogForked() if fact.log == self.robot.log:
                self._end_log(fact.peer)
            case NeighbourDown():
                self._gaps["heard"].forget(fact.peer)
        self._report(fact)

    def _end_log(self, peer: str) -> None:
        """Others hold records of this robot's log that it did not write here: an old disk, or a second writer."""
        logger.error(
            "%s: %s holds records of this robot's log that are not on its disk (an older copy of the disk, or a second "
            "robot of this name): what it records now reaches nobody. Restart it; it then begins a log of its own",
            self.robot.log,
            peer,
        )
        self._store.end_log()

    async def _write(self, written: list[Persist]) -> None:
        """Bring what is to be kept onto the disk before anything is sent that depends on it."""
        if written:
            self._copied += written
            written.clear()
            await self._flush()

    async def _write_copies(self) -> None:
        """Bring copies of others' records onto the disk, many at a time: what a crash loses of them comes again."""
        now = self._clock_s()
        if now < self._copies_due_s:
            return
        self._copies_due_s = now + COPIES_PERIOD_S
        if self._copied:
            await self._flush()

    async def _flush(self) -> None:
        """Write whatever waits for the disk."""
        batch, self._copied = self._copied, []
        await asyncio.to_thread(write, self._store, batch)

    def _do(self, effect: Effect) -> None:
        match effect:
            case Broadcast(Records(batches=(batch,))) if batch.log == self.robot.log:
                self._send_later(batch)
            case Broadcast(message):
                self._send_records()
                self._send(message, None)
            case Unicast(to, message):
                self._send(message, to)
            case Deliver(correction):
                self._deliver(correction)
            case Encode(keyframe, image):
                self._start(self._encode(keyframe, image))
            case FetchLatent():
                self._start(self._fetch(effect))
            case Register():
                self._start(self._register(effect))
            case Optimise():
                self._start(self._optimise(effect))
            case IterateBlock():
                self._start(self._iterate(effect))
            case _:
                raise AssertionError(f"no way to carry out {type(effect).__name__}")

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            logger.error("%s: a task failed", self.robot.log, exc_info=task.exception())
            self.stop()

    def _deliver(self, correction: Correction) -> None:
        self.last_correction = correction
        for queue in self._subscribers:
            _put_newest(queue, correction)

    async def _encode(self, keyframe: KeyframeId, image: int) -> None:
        result = await self._workers.run("encode", self._skills.encode, self._images[image])
        del self._images[image]
        self._image_slots.release()
        if isinstance(result, WorkFailed):
            self.put(KeyframeEncodingFailed(keyframe, result.reason))
            return
        await asyncio.to_thread(self._store.put_latent, keyframe, result.value.latent)
        self.put(KeyframeEncoded(keyframe, result.value.descriptor))

    async def _fetch(self, effect: FetchLatent) -> None:
        keyframe, holder = effect.keyframe, effect.holder
        encode_s, began_s = self._skills.encode_s(), self._clock_s()
        answer = await self._transport.fetch_latent(holder, str(keyframe), effect.deadline_s, encode_s=encode_s)
        if not isinstance(answer, Fetched):
            self.put(LatentFetchFailed(keyframe, holder, answer.problem.value))
            return
        self._workers.stages.observe("fetch", self._clock_s() - began_s)
        await asyncio.to_thread(self._store.put_latent, keyframe, answer.latent)
        self.put(LatentFetched(keyframe, holder))

    async def _register(self, effect: Register) -> None:
        keyframes = (effect.query, effect.match, effect.neighbour)
        query, match, neighbour = await asyncio.to_thread(lambda: [self._store.latent(k) for k in keyframes])
        if query is None or match is None or neighbour is None:
            missing = keyframes[[query, match, neighbour].index(None)]
            self.put(LatentMissing(effect.pair, missing))
            return
        T_neighbour_query = pose_from_tq(np.array(effect.T_neighbour_query))
        pair = OdometryPair(neighbour, T_neighbour_query, f"{effect.neighbour} {effect.query}")
        result = await self._workers.run("register", self._skills.register, query, match, pair)
        if isinstance(result, WorkFailed):
            self.put(PairRegistered(effect.pair, RegistrationFailed(RegistrationFailure.CRASHED, result.reason)))
            return
        self.put(PairRegistered(effect.pair, result.value))

    async def _optimise(self, effect: Optimise) -> None:
        result = await self._workers.run("optimise", self._skills.optimise, effect.graph, effect.initial)
        solution = result if isinstance(result, WorkFailed) else result.value
        if isinstance(solution, (WorkFailed, OptimisationFailed)):
            self.put(GraphOptimisationFailed(effect.term, effect.round, solution.reason))
            return
        self.last_solution = solution
        self.put(GraphOptimised(effect.term, effect.round, solution))

    async def _iterate(self, effect: IterateBlock) -> None:
        result = await self._workers.run("optimise", self._skills.iterate, effect.problem)
        step = result if isinstance(result, WorkFailed) else result.value
        if isinstance(step, (WorkFailed, OptimisationFailed)):
            self.put(BlockIterationFailed(effect.number, step.reason))
            return
        self.put(BlockIterated(effect.number, step))

    # Reports

    def _report(self, fact: Fact) -> None:
        if logger.isEnabledFor(level := _level(fact)):
            logger.log(level, "%s: %s %s", self.robot.log, name_of(fact), _brief(fact))
        self._on_report(self._reporter.reported(fact, self._clock_s()))

    def _count_bytes(self, last: bool = False) -> None:
        now = self._clock_s()
        if now < self._bytes_due_s and not last:
            return
        self._bytes_due_s = now + BYTES_PERIOD_S
        counters = self._transport.counters()
        sent = {kind: traffic.payload_bytes for kind, traffic in sorted(counters.sent.items())}
        received = {kind: traffic.payload_bytes for kind, traffic in sorted(counters.received.items())}
        counted = BytesCounted(sent=sent, received=received, loss=self._losses(), queues=self._queues())
        self._on_report(self._reporter.reported(counted, now))
        if now >= self._account_due_s or last:
            self._account_due_s = now + ACCOUNT_PERIOD_S
            self._on_report(self._reporter.reported(self._account(counters), now))

    def _losses(self) -> dict[str, float]:
        """Share of each neighbour's last heartbeats that did not arrive."""
        return {name: round(ratio, 3) for name, ratio in self.robot.neighbours.loss_ratios().items()}

    def _queues(self) -> dict[str, int]:
        """What waits: events for the core, images for the encoder, candidates for their registration."""
        return {"inbox": len(self._inbox), "images": len(self._images), "candidates": self.robot.closing.load}

    def _sizes(self) -> dict[str, tuple[int, int]]:
        """Every queue, table and cache: how much is in it, and its maximum."""
        return {
            "inbox": (len(self._inbox), INBOX_MAX),
            "images": (len(self._images), IMAGES_MAX),
            "disk": (len(self._copied), COPIES_MAX + BATCHES_MAX * RECORDS_BATCH_MAX),
            **self._transport.sizes(),
            **self.robot.sizes(),
        }

    def _account(self, counters: TransportCounters) -> AccountKept:
        """Bytes by link and kind, and time by stage, since this start of the agent."""
        stages = counts_of(self._workers.stages.snapshot())
        return AccountKept(since_s=round(self._began_s, 6), **counters.links(), stages=stages)


_WARNINGS = (PeerRefused, NameTaken, LogForked, LatentLost, RoundFailed)
_INFOS = (LeaderFollowed, LeaderLost, NeighbourUp, NeighbourDown, ClosureAccepted, CorrectionApplied, RoundSolved)


def totals(peers: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
    """Bytes by peer, all kinds together."""
    return {peer: sum(kinds.values()) for peer, kinds in peers.items()}


def _level(fact: Fact) -> int:
    if isinstance(fact, _WARNINGS):
        return logging.WARNING
    return logging.INFO if isinstance(fact, _INFOS) else logging.DEBUG


def _brief(fact: Fact) -> str:
    return " ".join(f"{key}={value}" for key, value in values_of(fact).items() if not isinstance(value, (list, dict)))


def _put_newest(queue: "asyncio.Queue[Correction | None]", item: Correction | None) -> None:
    """Put without waiting; the oldest item makes room."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(item)
