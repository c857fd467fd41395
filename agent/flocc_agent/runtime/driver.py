"""The asyncio driver: one task owns the core; zenoh's threads and the workers only put events into its inbox.

Effects are carried out in order. What is persisted is on disk before what follows it is sent. Encoding,
registration, optimisation, fetches and disk writes never run on the event loop.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.corrected import CorrectedLog, Correction, Corrector
from flocc_agent.core.effects import (
    Broadcast,
    ChooseClosures,
    Deliver,
    DropLog,
    Effect,
    Encode,
    FetchLatent,
    Optimise,
    PersistCorrection,
    PersistRecord,
    PersistTerm,
    Register,
    Report,
    StepConsensus,
    Unicast,
)
from flocc_agent.core.events import (
    Event,
    GraphOptimised,
    KeyframeCaptured,
    LatentFetched,
    Leaving,
    Measured,
    MessageReceived,
)
from flocc_agent.core.interfaces import Image
from flocc_agent.core.measurements import Measurement, belongs_to, record_of
from flocc_agent.core.reports import (
    Fact,
    LogForked,
    NeighbourDown,
    PeerRefused,
)
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.admission import Refusal, admitted
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.evidence import solver_of
from flocc_agent.runtime.given_keyframes import GivenKeyframes, checked_keyframe
from flocc_agent.runtime.jobs import IMAGES_MAX, Job, Tools, check, fetch, job_of
from flocc_agent.runtime.metrics import Look
from flocc_agent.runtime.persistence import DiskQueue, Persist
from flocc_agent.runtime.punctuality import LongestGap
from flocc_agent.runtime.reporting import Reporter, corrected_bodies, result_of
from flocc_agent.runtime.robot_result import RobotResult
from flocc_agent.runtime.sending import Sender
from flocc_agent.runtime.signature_queue import SignatureQueue
from flocc_agent.runtime.status import AgentStatus, SolverStatus
from flocc_agent.runtime.telemetry import Sizes, Telemetry
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId
from flocc_protocol.keys import Kind
from flocc_protocol.messages import Envelope

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

INBOX_MAX = 8192
CORRECTIONS_MAX = 16


class Driver:
    """Runs one robot's core on an event loop."""

    def __init__(
        self, robot: Robot, tools: Tools, reporter: Reporter, on_report: Callable[[Reported[Fact]], None]
    ) -> None:
        """Prepare; `run` does the rest.

        Args:
            robot: The core, already restored from the store.
            tools: What its jobs work with; the driver opens and closes the transport, and closes the workers.
            reporter: Says when and where facts happened.
            on_report: Takes each fact; must not block.
        """
        self.robot = robot
        self._tools = tools
        self._clock_s = tools.clock_s
        self._inbox: deque[tuple[float, Event]] = deque()
        self._wake = asyncio.Event()
        self._opened = asyncio.Event()
        self._given = GivenKeyframes.of(robot)
        self._jobs: set[asyncio.Task[Event]] = set()
        self._signed = SignatureQueue(robot.claims, lambda claims: check(claims, tools), self._on_envelope)
        self._checking: asyncio.Task[None] | None = None
        self._stopping = False
        self._closed = False
        self._subscribers: list[asyncio.Queue[Correction | None]] = []
        self._disk = DiskQueue(tools.store, tools.clock_s())
        self._sender = Sender(robot, tools.transport, tools.clock_s)
        self._heard_gap = LongestGap()
        gaps = {"sent": self._sender.heartbeat_gap, "heard": self._heard_gap}
        self._telemetry = Telemetry(robot, tools, reporter, on_report, gaps, self._sizes)
        self._corrector = Corrector(robot)
        self.last_correction: Correction | None = None
        self.solved: SolverStatus | None = None

    async def opened(self, run: "asyncio.Task[None]") -> None:
        """Wait until the network is open; raises what `run` raised."""
        opening = asyncio.create_task(self._opened.wait())
        done, _ = await asyncio.wait({opening, run}, return_when=asyncio.FIRST_COMPLETED)
        if run in done:
            opening.cancel()
            run.result()

    # For the robot's own program

    async def add_keyframe(self, image: Image, T_odom_camera: Float, stamp_s: float) -> None:
        """Take a keyframe in; waits while too many images wait for the encoder.

        Raises:
            BadKeyframe: No log may hold it.
        """
        T, stamp_s = checked_keyframe(T_odom_camera, stamp_s), float(stamp_s)
        number = await self._tools.images.put(image)
        self._given.add(stamp_s)
        self.put(KeyframeCaptured(stamp_s, T, number))

    def add_measurement(self, measurement: Measurement, stamp_s: float | None = None) -> None:
        """Take in what was measured at the keyframe that was given last, or at the one with this stamp.

        Raises:
            BadMeasurement: There is no such keyframe, or no log may hold the measurement.
        """
        index = self._given.index_of(measurement, stamp_s)
        record_of(measurement, belongs_to(measurement, self.robot.log, index))
        self.put(Measured(measurement, index))

    def keyframe_at(self, stamp_s: float) -> KeyframeId:
        """The own keyframe with this stamp.

        Raises:
            BadMeasurement: There is none.
        """
        return KeyframeId(self.robot.log, self._given.at("closure", stamp_s))

    async def fetch_latent(self, keyframe: KeyframeId, deadline_s: float) -> bool:
        """Bring a latent from its owner into the store; whether it came."""
        event = await fetch(FetchLatent(keyframe, keyframe.log.robot, deadline_s), self._tools)
        self.put(event)
        return isinstance(event, LatentFetched)

    def subscribe(self) -> "asyncio.Queue[Correction | None]":
        """A queue of corrections, newest kept when it is full; None ends it."""
        queue: asyncio.Queue[Correction | None] = asyncio.Queue(CORRECTIONS_MAX)
        self._subscribers.append(queue)
        if self.last_correction is not None:
            queue.put_nowait(self.last_correction)
        if self._closed:
            _put_newest(queue, None)
        return queue

    def unsubscribe(self, queue: "asyncio.Queue[Correction | None]") -> None:
        """A queue that nobody reads any more."""
        self._subscribers.remove(queue)

    @property
    def is_stopping(self) -> bool:
        """Whether it was asked to end, or has ended."""
        return self._stopping or self._closed

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
        self._telemetry.mount_camera(T_body_camera)

    def corrected_bodies(self) -> tuple[list[float], Float]:
        """Stamps (s) and (N, 4, 4) corrected body poses of all keyframes; may be called off the loop's thread."""
        return corrected_bodies(self.robot, self._T_body_camera)

    def corrected_logs(self) -> dict[str, CorrectedLog]:
        """All robots in this robot's map as of now; what it gives may be read off the loop's thread."""
        return self._corrector.now(self._T_body_camera)

    @property
    def _T_body_camera(self) -> Float:
        """Where the camera sits on the body, as it is known by now."""
        return self._telemetry.reporter.T_body_camera

    def busy(self) -> bool:
        """Whether images, fetches, registrations or rounds are under way, or a leader still owes a round."""
        owes_round = self.robot.rounds.deadline() < float("inf")
        waits = self._inbox or self._tools.images or self._signed.is_waiting()
        return bool(waits or self._jobs or self.robot.closing.load or owes_round)

    def status(self) -> AgentStatus:
        """What this robot does now: leader, neighbours, sizes, map frame, bytes, refusals."""
        return self._telemetry.status(self.busy())

    def look(self) -> Look:
        """What a scrape of the metrics sees."""
        return self._telemetry.look()

    def result(self) -> RobotResult:
        """What this robot knows, for `result.json`."""
        return result_of(self.robot, self._T_body_camera, self.robot.rounds.solution())

    # The loop

    async def run(self) -> None:
        """Open the transport, live until `stop`, hand over, close everything.

        Raises:
            TransportError: The network cannot be used as configured.
        """
        self._tools.transport.set_receiver(self._on_payload)
        self._tools.transport.serve_latents(self._latent_named)
        try:
            await self._tools.transport.open()
            self._opened.set()
            await self._live()
            self._sender.send_records()
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
                self._tools.workers.stages.observe("inbox_wait", now - put_s)
                await self._carry_out(self.robot.handle(event, now))
                if isinstance(event, MessageReceived):
                    self._signed.on_handled(event.envelope)
            self._check_signatures()
            self._sender.send_due_records()
            self._telemetry.count_bytes()
            await self._disk.write_due(self._clock_s())
            await self._sleep()

    async def _sleep(self) -> None:
        """Wait for an event or for the next deadline."""
        if self._inbox or self._stopping:
            await asyncio.sleep(0)
            return
        self._wake.clear()
        due_s = min(self.robot.deadline(), self._telemetry.due_s(), self._disk.due_s(), self._sender.due_s())
        due_s = min(due_s, self._signed.due_s())
        pause_s = due_s - self._clock_s()
        alarm = asyncio.get_running_loop().call_later(max(pause_s, 0.0), self._wake.set)
        try:
            await self._wake.wait()
        finally:
            alarm.cancel()

    async def _close(self) -> None:
        """End everything, whatever fails of it: threads of an open transport would keep the process from ending."""
        try:
            jobs = [*self._jobs, *([] if self._checking is None else [self._checking])]
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)
            await self._disk.flush()
            self._telemetry.count_bytes(last=True)
        finally:
            try:
                await self._tools.transport.close()
            finally:
                await self._tools.workers.close()
                self._closed = True
                for queue in self._subscribers:
                    _put_newest(queue, None)

    def _sizes(self) -> Sizes:
        """The driver's own queues: how much is in them, and their maximum."""
        return {
            "inbox": (len(self._inbox), INBOX_MAX),
            "images": (len(self._tools.images), IMAGES_MAX),
            "disk": self._disk.size(),
            "signed": self._signed.size(),
        }

    # What peers send

    def _on_payload(self, sender: str, kind: str, payload: bytes) -> None:
        """Put a message of a peer into the inbox; what is refused is counted, and told once per peer and reason."""
        envelope = admitted(sender, kind, payload)
        if isinstance(envelope, Refusal):
            self._telemetry.refuse(sender, envelope.reason, envelope.detail)
            return
        if len(self._inbox) >= INBOX_MAX:
            self._telemetry.refuse(sender, "too many messages wait")
            return
        if kind == Kind.HEARTBEAT.value:
            self._heard_gap.mark(sender, self._clock_s())
        if self._tools.sealer is None or not self._signed.is_for(envelope):
            self._on_envelope(envelope)
        elif self._signed.put(envelope, self._clock_s()):
            self._wake.set()
        else:
            self._telemetry.refuse(sender, "too many signed messages wait")

    def _on_envelope(self, envelope: Envelope) -> None:
        self.put(MessageReceived(envelope))

    def _check_signatures(self) -> None:
        """Begin the next turn of signed messages, if one is due."""
        turn = self._signed.next_turn(self._clock_s())
        if turn:
            self._checking = asyncio.create_task(self._signed.run_turn(turn, self._clock_s()))
            self._checking.add_done_callback(self._checked)

    def _checked(self, turn: asyncio.Task[None]) -> None:
        """What a turn brings is in the inbox; one that raised is a bug, and ends the agent."""
        if not turn.cancelled() and (error := turn.exception()) is not None:
            logger.error("%s: looking at signatures failed", self.robot.log, exc_info=error)
            self.stop()

    def _latent_named(self, key: str, encode_bytes: int | None) -> bytes | None:
        """A latent for the transport, by a name that a peer gave, or the part of it that reaches him sooner."""
        try:
            latent = self._tools.store.latent(KeyframeId.parse(key))
            return None if latent is None else self._tools.perception.part(latent, encode_bytes)
        except (ValueError, FloccError):
            return None

    # Effects

    async def _carry_out(self, effects: list[Effect]) -> None:
        """Carry effects out in order: what the robot keeps of its own is on disk before it sends or begins anything."""
        kept: list[Persist] = []
        for effect in effects:
            match effect:
                case PersistRecord(log=log) if log != self.robot.log:
                    self._disk.put(effect)
                case PersistRecord() | PersistTerm() | PersistCorrection() | DropLog():
                    kept.append(effect)
                case Report(fact):
                    self._tell(fact)
                case _:
                    await self._disk.write(kept)
                    self._do(effect)
        await self._disk.write(kept)
        await self._disk.write_full()

    def _tell(self, fact: Fact) -> None:
        """Report what the core tells, and act on what concerns the driver."""
        match fact:
            case PeerRefused():
                self._telemetry.refuse(fact.peer, fact.reason)
                return
            case LogForked() if fact.log == self.robot.log:
                self._end_log(fact.peer)
            case NeighbourDown():
                self._heard_gap.forget(fact.peer)
        self._telemetry.report(fact)

    def _end_log(self, peer: str) -> None:
        """Others hold records of this robot's log that it did not write here: an old disk, or a second writer."""
        logger.error(
            "%s: %s holds records of this robot's log that are not on its disk (an older copy of the disk, a second "
            "robot of this name, or, without keys, a lie): who holds them takes nothing of what it records now; at "
            "its next start it begins a log of its own",
            self.robot.log,
            peer,
        )
        self._tools.store.end_log()

    def _do(self, effect: Broadcast | Unicast | Deliver | Job) -> None:
        match effect:
            case Broadcast(message):
                self._sender.broadcast(message)
            case Unicast(to, message):
                self._sender.unicast(to, message)
            case Deliver(applied, frame_changed):
                self._deliver(self._corrector.correction(applied, frame_changed, self._T_body_camera))
            case Encode() | FetchLatent() | Register() | Optimise() | ChooseClosures() | StepConsensus():
                self._start(effect)
            case _:
                assert_never(effect)

    def _deliver(self, correction: Correction) -> None:
        self.last_correction = correction
        for queue in self._subscribers:
            _put_newest(queue, correction)

    def _start(self, effect: Job) -> None:
        job = asyncio.create_task(job_of(effect, self._tools))
        self._jobs.add(job)
        job.add_done_callback(self._done)

    def _done(self, job: asyncio.Task[Event]) -> None:
        """A job's event goes into the inbox; a job that raised is a bug, and ends the agent."""
        self._jobs.discard(job)
        if job.cancelled():
            return
        if (error := job.exception()) is not None:
            logger.error("%s: a job failed", self.robot.log, exc_info=error)
            self.stop()
            return
        event = job.result()
        if isinstance(event, GraphOptimised):
            self.solved = solver_of(event.solution)
        self.put(event)


def _put_newest(queue: "asyncio.Queue[Correction | None]", item: Correction | None) -> None:
    """Put without waiting; the oldest item makes room."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(item)
