"""One simulated robot: the unchanged core between a simulated clock, disk, network and workers.

A station is one running copy of a robot's software; it has its own clock, which may be wrong. When it is killed its
memory is gone: answers of workers and links that belong to an earlier life are not delivered.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import assert_never

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
from flocc_agent.core.events import Event, GraphOptimised, KeyframeCaptured, LatentFetched, Measured, MessageReceived
from flocc_agent.core.measurements import BadMeasurement
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.pose_graph import GraphSolution
from flocc_agent.core.reports import SolutionIgnored
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import pose7
from flocc_agent.runtime.given_keyframes import GivenKeyframes
from flocc_agent.runtime.measurement_file import Stamped
from flocc_agent.runtime.page_file import PageFile
from flocc_launch.simulation.agenda import Agenda
from flocc_launch.simulation.disk import Disk
from flocc_launch.simulation.virtual_playback import Capture, Playback
from flocc_launch.simulation.virtual_workers import VirtualWorkers
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import CorrectionBatch, Envelope, LogCorrection, Message

LIE_M = 1e6
"""How far from where they are a robot that lies puts others."""


@dataclass(frozen=True, slots=True)
class Clock:
    """A robot's clock against the true one: `local = offset_s + (1 + drift_ratio) * true`."""

    offset_s: float = 0.0
    drift_ratio: float = 0.0

    def local_s(self, true_s: float) -> float:
        """What the robot's clock shows."""
        return self.offset_s + (1.0 + self.drift_ratio) * true_s

    def true_s(self, local_s: float) -> float:
        """When the robot's clock shows this."""
        return (local_s - self.offset_s) / (1.0 + self.drift_ratio)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a station may do to the world.

    Attributes:
        broadcast: Send to every station in range.
        unicast: Send to the stations of one robot name.
        fetch: Start to fetch a latent.
        observe: Told of every step: station, event (None for a tick) and effects.
        died: Told that a station's power was cut in the middle of a step.
    """

    broadcast: Callable[["Station", Message], None]
    unicast: Callable[["Station", str, Message], None]
    fetch: Callable[["Station", FetchLatent], None]
    observe: Callable[["Station", Event | None, list[Effect]], None]
    died: Callable[["Station"], None]


class Station:
    """One running robot.

    Attributes:
        name: Unique in the simulation; the robot's name, but for a second robot that took the same name.
        compute_class: 0 (small) to 9.
        core: The robot's behaviour, None while it is switched off.
        life: Counts starts.
        solution: The last solution it made as a leader, and that counted.
        unheard: Latents that it holds already, and whose news waits for its disk.
        lies: As a leader it tells others that they are far away.
        dies_after: The power is cut when so many effects of a step with more are carried out; None: it is not.
    """

    def __init__(
        self,
        name: str,
        log: LogId,
        compute_class: int,
        playback: Playback,
        workers: VirtualWorkers,
        disk: Disk,
        clock: Clock,
        agenda: Agenda,
        around: Surroundings,
    ) -> None:
        self.name = name
        self.log = log
        self.playback = playback
        self.workers = workers
        self.disk = disk
        self.clock = clock
        self.core: Robot | None = None
        self.life = 0
        self.solution: GraphSolution | None = None
        self.unheard: set[KeyframeId] = set()
        self.lies = False
        self.dies_after: int | None = None
        self.compute_class = compute_class
        self._agenda = agenda
        self._around = around
        self._images: dict[int, Capture] = {}
        self._given = GivenKeyframes()
        self._tick_s = float("inf")
        self._due_s = float("inf")
        self._blocked_until_s = float("-inf")

    @property
    def running(self) -> bool:
        """Whether it is switched on."""
        return self.core is not None

    def now_s(self) -> float:
        """What its own clock shows."""
        return self.clock.local_s(self._agenda.now_s)

    def start(self, boot: int, parameters: CoreParameters, distributed: bool = False) -> None:
        """Switch on, with what the disk holds."""
        assert self.core is None
        self.life += 1
        self.workers.restart()
        self.unheard.clear()
        restored = self.disk.restored()
        self.core = Robot(
            self.log,
            self.compute_class,
            boot,
            parameters,
            self.now_s(),
            restored,
            distributed=distributed,
            cold=PageFile(),
        )
        self._given = GivenKeyframes.of(self.core)
        self._tick_s = self._due_s = float("inf")
        self._arm()

    def known(self, parameters: CoreParameters) -> Robot | None:
        """The core at the end; of a dead robot as its disk would bring it back, None where the disk holds nothing."""
        if self.core is not None or not self.disk.records.get(self.log):
            return self.core
        return Robot(self.log, self.compute_class, 0, parameters, self.now_s(), self.disk.restored())

    def kill(self) -> None:
        """Lose everything but the disk."""
        self.core = None
        self.dies_after = None
        self.life += 1
        self.disk.lose_unwritten()
        self._blocked_until_s = float("-inf")
        self._images.clear()

    def capture(self, number: int) -> None:
        """The camera took keyframe `number` of the playback."""
        if self.core is None:
            return
        capture = self.playback.captures[number]
        self._images[number] = capture
        T_odom_camera = capture.T_odom_body @ self.playback.T_body_camera
        self._given.add(capture.stamp_s)
        self.handle(KeyframeCaptured(capture.stamp_s, pose7(T_odom_camera), number))
        for stamped in capture.measured:
            self._measure(stamped, capture.stamp_s)

    def _measure(self, stamped: Stamped, stamp_s: float) -> None:
        """Hand the core what was measured at a keyframe; what belongs to one that a crash lost is lost as well."""
        try:
            measurement = stamped.made(lambda match_s: KeyframeId(self.log, self._given.at("closure", match_s)))
            index = self._given.index_of(measurement, stamp_s)
        except BadMeasurement:
            return
        if self.running:
            self.handle(Measured(measurement.in_camera(self.playback.T_body_camera), index))

    def receive(self, envelope: Envelope) -> bool:
        """A message arrived; whether the robot was switched on."""
        if self.core is None:
            return False
        self.handle(MessageReceived(envelope))
        return True

    def handle(self, event: Event) -> None:
        """Let the core know, and carry out what it wants; while it waits for its disk, later."""
        assert self.core is not None
        if self._agenda.now_s < self._blocked_until_s:
            if isinstance(event, LatentFetched):
                self.unheard.add(event.keyframe)
            self.later(self._blocked_until_s, lambda: event)
            return
        if isinstance(event, LatentFetched):
            self.unheard.discard(event.keyframe)
        effects = self.core.handle(event, self.now_s())
        if isinstance(event, GraphOptimised) and not _came_late(effects):
            self.solution = event.solution
        self._carry_out(event, effects)

    def later(self, time_s: float, event: Callable[[], Event]) -> None:
        """Hand an event to the core at a true time, unless the robot died in between."""
        life = self.life

        def happen() -> None:
            if self.life == life and self.core is not None:
                self.handle(event())

        self._agenda.at(time_s, happen)

    def step_clock(self, by_s: float) -> None:
        """The robot's clock shows a later time from now on: its computer slept."""
        self.clock = replace(self.clock, offset_s=self.clock.offset_s + by_s)
        self._due_s = float("inf")
        self._tick_s = self._agenda.now_s
        self._agenda.at(self._agenda.now_s, self._tick)

    def _tick(self) -> None:
        """Wake up; deadlines that moved on since are waited for again."""
        self._tick_s = self._due_s = float("inf")
        if self.core is None:
            return
        if self._agenda.now_s < self._blocked_until_s:
            self._agenda.at(self._blocked_until_s, self._tick)
            return
        now_s = self.now_s()
        if self.core.deadline() <= now_s:
            effects = self.core.tick(now_s)
            assert self.core.deadline() > now_s, f"{self.name} spins: its deadline stays at {self.core.deadline()} s"
            self._carry_out(None, effects)
        else:
            self._arm()

    def _arm(self) -> None:
        """See to it that the core is woken at its deadline, on its own clock."""
        assert self.core is not None
        due_s = self.core.deadline()
        if due_s >= self._due_s:
            return
        self._due_s = due_s
        wake_s = self.clock.true_s(due_s)
        while self.clock.local_s(wake_s) < due_s:
            wake_s += max(abs(wake_s), 1.0) * 1e-15
        if wake_s >= self._tick_s:
            return
        self._tick_s = wake_s
        life = self.life

        def wake() -> None:
            if self.life == life and self._tick_s == wake_s:
                self._tick()

        self._agenda.at(wake_s, wake)

    def _carry_out(self, event: Event | None, effects: list[Effect]) -> None:
        """Do what the core wants, in its order, as far as the power lasts."""
        dies = self.dies_after is not None and len(effects) > self.dies_after
        done = effects[: self.dies_after] if dies else effects
        self._around.observe(self, event, done)
        written = self._written(done)
        for effect in done[:written]:
            self._do(effect)
        if written < len(done):
            self._wait_for_disk(done[written:])
        if dies:
            self._around.died(self)
        else:
            self._arm()

    def _written(self, effects: list[Effect]) -> int:
        """How many of the effects are done at once: on a slow disk those up to the first own thing that is written."""
        if self.disk.slow_s == 0.0:
            return len(effects)
        own = (k for k, effect in enumerate(effects) if self._is_own_write(effect))
        return next((k + 1 for k in own), len(effects))

    def _is_own_write(self, effect: Effect) -> bool:
        if isinstance(effect, PersistRecord):
            return effect.log == self.log
        return isinstance(effect, PersistTerm | PersistCorrection | DropLog)

    def _wait_for_disk(self, effects: list[Effect]) -> None:
        """What follows a write happens when it is done, and so does whatever else comes meanwhile."""
        life, self._blocked_until_s = self.life, self._agenda.now_s + self.disk.slow_s

        def go_on() -> None:
            if self.life == life:
                for effect in effects:
                    self._do(effect)

        self._agenda.at(self._blocked_until_s, go_on)

    def _do(self, effect: Effect) -> None:
        now_s = self._agenda.now_s
        match effect:
            case PersistRecord(log, number, data):
                self.disk.put_record(log, number, data, now_s)
            case Broadcast(message):
                self._around.broadcast(self, self._told(message))
            case Unicast(to, message):
                self._around.unicast(self, to, self._told(message))
            case Encode(keyframe, image, T_odom_camera):
                capture = self._images.pop(image)
                done_s = self.workers.encoded_at_s(now_s)
                self.later(done_s, lambda: self.workers.encode(keyframe, capture, T_odom_camera, self.disk))
            case FetchLatent():
                self._around.fetch(self, effect)
            case Register():
                self.later(self.workers.registered_at_s(now_s), lambda: self.workers.register(effect, self.disk))
            case Optimise():
                self.later(self.workers.optimised_at_s(now_s), lambda: self.workers.optimise(effect))
            case ChooseClosures():
                self.later(self.workers.optimised_at_s(now_s), lambda: self.workers.choose(effect))
            case StepConsensus():
                self.later(self.workers.stepped_at_s(now_s), lambda: self.workers.step(effect))
            case PersistTerm(counter):
                self.disk.term_counter = max(self.disk.term_counter, counter)
            case DropLog(log):
                self.disk.drop_log(log)
            case PersistCorrection(correction, frame_changed):
                self.disk.correction, self.disk.frame_changed = correction, frame_changed
            case Deliver() | Report():
                pass
            case _:
                assert_never(effect)

    def _told(self, message: Message) -> Message:
        """What it says instead, where it lies."""
        if not self.lies or not isinstance(message, CorrectionBatch):
            return message
        return CorrectionBatch(tuple(_far_away(c) if c.term.leader == self.log else c for c in message.corrections))


def _came_late(effects: list[Effect]) -> bool:
    """Whether a solution was ignored."""
    return any(isinstance(effect, Report) and isinstance(effect.fact, SolutionIgnored) for effect in effects)


def _far_away(correction: LogCorrection) -> LogCorrection:
    x_m, *rest = correction.T_map_odom
    y_m, z_m, *q = rest
    return replace(correction, T_map_odom=(x_m + LIE_M, y_m, z_m, q[0], q[1], q[2], q[3]))
