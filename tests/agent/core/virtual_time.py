"""A few cores on virtual time, joined by links that a test cuts and mends; no codec, no workers, no chance."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from flocc_agent.core.effects import (
    Broadcast,
    Deliver,
    Effect,
    Encode,
    FetchLatent,
    Optimise,
    Register,
    Report,
    Unicast,
)
from flocc_agent.core.events import (
    Event,
    GraphOptimised,
    KeyframeCaptured,
    KeyframeEncoded,
    LatentFetched,
    MessageReceived,
    PairRegistered,
)
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.registration import Registration
from flocc_agent.core.restored import Restored
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import pose, pose7
from flocc_launch.simulation.rigid_alignment import align
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import Envelope, Message

F = TypeVar("F")

LATENCY_S = 0.01
WORK_S = 0.1

Work = Callable[["Robots", str, Effect], Event | None]


@dataclass
class Robots:
    """Cores by name, the time, and what they did.

    Attributes:
        hears: Whether the second robot hears the first.
        work: Answers Encode, FetchLatent, Register and Optimise; None never answers.
        drops: Messages that are lost.
    """

    parameters: CoreParameters = field(default_factory=CoreParameters)
    now_s: float = 100.0
    cores: dict[str, Robot] = field(default_factory=dict)
    cut: set[frozenset[str]] = field(default_factory=set)
    done: list[tuple[float, str, Effect]] = field(default_factory=list)
    drops: Callable[[str, str, Message], bool] = lambda sender, receiver, message: False
    work: Work = lambda robots, name, effect: answer(effect)
    _queue: list[tuple[float, int, str, Event]] = field(default_factory=list)
    _count: int = 0

    def add(self, name: str, compute_class: int = 0, restored: Restored | None = None, incarnation: int = 0) -> Robot:
        """Switch a robot on."""
        log = LogId(name, incarnation)
        self.cores[name] = Robot(log, compute_class, 1000 + self._count, self.parameters, self.now_s, restored)
        return self.cores[name]

    def kill(self, name: str) -> None:
        """Switch a robot off."""
        del self.cores[name]

    def separate(self, *groups: str) -> None:
        """Robots of different groups, as in "r1 r2", no longer hear each other."""
        members = [group.split() for group in groups]
        self.cut = {
            frozenset((a, b))
            for i, group in enumerate(members)
            for other in members[i + 1 :]
            for a in group
            for b in other
        }

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end_s = self.now_s + seconds
        while True:
            due = [(core.deadline(), name) for name, core in self.cores.items()]
            tick_s, name = min(due, default=(end_s + 1.0, ""))
            if self._queue and self._queue[0][0] <= min(tick_s, end_s):
                self.now_s, _, receiver, event = self._queue.pop(0)
                if receiver in self.cores:
                    self.put(receiver, event)
            elif tick_s <= end_s:
                self.now_s = max(self.now_s, tick_s)
                self.carry_out(name, self.cores[name].tick(self.now_s))
                assert self.cores[name].deadline() > self.now_s, f"{name} does not move its deadline on"
            else:
                self.now_s = end_s
                return

    def put(self, name: str, event: Event) -> None:
        """Let an event happen to a robot now."""
        self.carry_out(name, self.cores[name].handle(event, self.now_s))

    def carry_out(self, name: str, effects: Iterable[Effect]) -> None:
        """Deliver messages and let workers answer."""
        for effect in effects:
            self.done.append((self.now_s, name, effect))
            match effect:
                case Broadcast(message):
                    for receiver in sorted(self.cores):
                        self._send(name, receiver, message)
                case Unicast(to, message):
                    self._send(name, to, message)
                case Encode() | FetchLatent() | Register() | Optimise():
                    event = self.work(self, name, effect)
                    if event is not None:
                        self.later(WORK_S, name, event)

    def later(self, pause_s: float, name: str, event: Event) -> None:
        """Let an event happen in a while."""
        self._count += 1
        self._queue.append((self.now_s + pause_s, self._count, name, event))
        self._queue.sort(key=lambda entry: entry[:2])

    def capture(self, name: str, x_m: float, look: int) -> None:
        """A keyframe at x on a line, of a place that looks like number `look`."""
        T = pose(np.eye(3), np.array([x_m, 0.0, 0.0]))
        self.put(name, KeyframeCaptured(self.now_s, pose7(T), look))

    def leaders(self) -> dict[str, str]:
        """Robot -> whom it follows or that it leads."""
        return {name: str(core.election.term) for name, core in sorted(self.cores.items())}

    def effects(self, name: str, kind: type[Effect]) -> list[Effect]:
        """What a robot wanted, of one kind."""
        return [effect for _, who, effect in self.done if who == name and isinstance(effect, kind)]

    def facts(self, name: str, kind: type[F]) -> list[F]:
        """What a robot reported, of one kind."""
        told = [effect.fact for _, who, effect in self.done if who == name and isinstance(effect, Report)]
        return [fact for fact in told if isinstance(fact, kind)]

    def frames(self) -> dict[str, str]:
        """Robot -> map frame of its last correction."""
        found: dict[str, str] = {}
        for _, name, effect in self.done:
            if isinstance(effect, Deliver):
                found[name] = map_frame(effect.correction.anchor)
        return {name: found[name] for name in sorted(found) if name in self.cores}

    def _send(self, sender: str, receiver: str, message: Message) -> None:
        if sender == receiver or receiver not in self.cores or frozenset((sender, receiver)) in self.cut:
            return
        if not self.drops(sender, receiver, message):
            envelope = Envelope(self.cores[sender].log, message)
            self.later(LATENCY_S, receiver, MessageReceived(envelope))


def answer(effect: Effect) -> Event | None:
    """Workers that always succeed: places are recognised by their number, and lie where odometry says."""
    match effect:
        case Encode(keyframe, look):
            return KeyframeEncoded(keyframe, descriptor(look))
        case FetchLatent(keyframe, holder):
            return LatentFetched(keyframe, holder)
        case Register(pair):
            return PairRegistered(pair, Registration(np.eye(4), 100, 100, 1.0))
        case Optimise(term, number, graph):
            return GraphOptimised(term, number, align(graph))
        case _:
            return None


def descriptor(look: int) -> Array:
    """One place's descriptor: a unit vector; looks below 0 look like nothing else."""
    values = np.zeros(64)
    values[look % 64] = 1.0
    return Array.of(values, "f4")


def keyframe(text: str) -> KeyframeId:
    """A keyframe by its text, as `r1/3`."""
    return KeyframeId.parse(text)


class EveryoneSigns:
    """A sealer whose signatures are always good: the liar is a member."""

    def seal(self, log: LogId, number: int, record: bytes) -> bytes:
        return record

    def opened(self, log: LogId, number: int, sealed: bytes) -> bytes:
        return sealed

    def sign_correction(self, correction: bytes) -> bytes:
        return bytes(64)

    def check_correction(self, leader: LogId, correction: bytes, signature: bytes) -> None:
        """Nothing to say."""
