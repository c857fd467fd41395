"""Claim: whatever arrives, a robot goes on. Mutated messages never raise, stop its clock or touch its own log.

Three robots talk over a link that damages every second message; what still decodes is handled. Everything that the
robots then want to send must be legal. A failure names the seed.
"""

import math
from collections import deque

import numpy as np
import pytest
from tests.protocol.wire_examples import BOB, ENCODED, ENVELOPES, MESSAGES
from tests.protocol.wire_mutations import flip, noise, rearrange, replace_node

from flocc_agent.core import peer_budgets, pulls
from flocc_agent.core import robot as robot_of_core
from flocc_agent.core.effects import (
    Broadcast,
    Effect,
    Encode,
    FetchLatent,
    Optimise,
    PersistRecord,
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
from flocc_agent.core.parameters import CoreParameters, GossipParameters, LoopClosingParameters, NeighbourParameters
from flocc_agent.core.pose_graph import Component, GraphSolution, PoseGraph, components_of
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.core.robot import Robot
from flocc_protocol.arrays import Array
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Envelope, Message, RecordBatch, Records, decode, encode

NAMES = ("alice", "bob-2", "carol")
PLACES = 4
STEP_S = 0.25
KEYFRAME_PERIOD_S = 2.0
MUTATIONS = (noise, flip, rearrange, replace_node, replace_node, replace_node, replace_node)


class DamagedSwarm:
    """Three robots on virtual time behind links that damage messages."""

    def __init__(self, seed: int, damaged_ratio: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.damaged_ratio = damaged_ratio
        self.now = 0.0
        self.robots = {
            name: Robot(LogId(name), compute_class=k % 2, boot=k, parameters=CoreParameters(), now=0.0)
            for k, name in enumerate(NAMES)
        }
        self.own_records: dict[str, list[bytes]] = {name: [] for name in NAMES}
        self.inbox: deque[tuple[str, Event]] = deque()
        self.damaged_and_valid = 0

    def run(self, duration_s: float) -> None:
        """Let time pass: ticks, keyframes, and now and then a damaged example of any message."""
        steps = round(duration_s / STEP_S)
        for step in range(steps):
            self.now += STEP_S
            for k, (name, robot) in enumerate(self.robots.items()):
                if step % round(KEYFRAME_PERIOD_S / STEP_S) == k:
                    self.inbox.append((name, self.keyframe(step)))
                self.inject(name)
                if robot.deadline() <= self.now:
                    self.carry_out(name, robot.tick(self.now))
                    assert robot.deadline() > self.now, f"{name} would tick for ever"
            self.settle()

    def settle(self) -> None:
        """Handle events until none is left."""
        for _ in range(10_000):
            if not self.inbox:
                return
            name, event = self.inbox.popleft()
            robot = self.robots[name]
            self.carry_out(name, robot.handle(event, self.now))
            assert not math.isnan(robot.deadline())
        raise AssertionError("the robots talk for ever")

    def keyframe(self, step: int) -> KeyframeCaptured:
        return KeyframeCaptured(self.now, (0.1 * step, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), image=step)

    def inject(self, receiver: str) -> None:
        """Send a robot damaged examples of messages in the names of others."""
        for _ in range(4):
            sender = LogId(NAMES[self.rng.integers(len(NAMES))], int(self.rng.integers(2)))
            self.deliver(Envelope(sender, ENVELOPES[self.rng.integers(len(ENVELOPES))].message), receiver, 1.0)

    def deliver(self, envelope: Envelope, receiver: str, damaged_ratio: float) -> None:
        """Encode, perhaps damage, decode; what is a message is handled."""
        data = encode(envelope)
        damaged = self.rng.random() < damaged_ratio
        if damaged:
            data = MUTATIONS[self.rng.integers(len(MUTATIONS))](self.rng, data)
        try:
            received = decode(data)
        except DecodeError:
            return
        self.damaged_and_valid += damaged
        self.inbox.append((receiver, MessageReceived(received)))

    def send(self, sender: str, receivers: tuple[str, ...], message: Message) -> None:
        for receiver in receivers:
            if receiver != sender:
                self.deliver(Envelope(self.robots[sender].log, message), receiver, self.damaged_ratio)

    def carry_out(self, name: str, effects: list[Effect]) -> None:
        """Do what a driver does, with stand-ins for perception and the back end."""
        for effect in effects:
            match effect:
                case Broadcast(message):
                    self.send(name, NAMES, message)
                case Unicast(to, message):
                    self.send(name, (to,) if to in self.robots else (), message)
                case Encode(keyframe, image):
                    values = np.eye(PLACES)[image % PLACES] + 0.1 * self.rng.normal(size=PLACES)
                    self.inbox.append((name, KeyframeEncoded(keyframe, Array.int8(values))))
                case FetchLatent(keyframe, holder):
                    self.inbox.append((name, LatentFetched(keyframe, holder)))
                case Register(pair):
                    self.inbox.append((name, PairRegistered(pair, self.registration())))
                case Optimise(term, number, graph):
                    self.inbox.append((name, GraphOptimised(term, number, odometry_only(graph))))
                case PersistRecord(log, number, data) if log == self.robots[name].log:
                    assert number == len(self.own_records[name])
                    self.own_records[name].append(data)
                case _:
                    pass

    def registration(self) -> Registration | RegistrationFailed:
        if self.rng.random() < 0.2:
            return RegistrationFailed(RegistrationFailure.FEW_CORRESPONDENCES, "", 3, 100)
        return Registration(np.eye(4), int(self.rng.integers(0, 200)), 100, 1.0)


def odometry_only(graph: PoseGraph) -> GraphSolution:
    """A solution that leaves every trajectory where odometry has it."""
    components = []
    for logs in components_of(list(graph.trajectories), graph.closures):
        poses = {log: np.asarray(graph.trajectories[log].T_odom_keyframe) for log in logs}
        components.append(Component(logs, poses, {log: np.eye(4) for log in logs}, {log: np.eye(6) for log in logs}))
    return GraphSolution(tuple(components), ())


@pytest.mark.parametrize("seed", range(4))
def test_mutated_messages_never_raise_and_never_touch_an_own_log(seed: int) -> None:
    swarm = DamagedSwarm(seed, damaged_ratio=0.5)
    swarm.run(60.0)
    assert swarm.damaged_and_valid > 200
    for name, robot in swarm.robots.items():
        own = robot.gossip.logs[robot.log]
        assert own.encoded == swarm.own_records[name]
        assert own.keyframes >= 28


def test_undamaged_messages_close_loops_in_this_very_swarm() -> None:
    swarm = DamagedSwarm(0, damaged_ratio=0.0)
    swarm.inject = lambda receiver: None  # type: ignore[method-assign]
    swarm.run(60.0)
    logs = [{log: tuple(copy.encoded) for log, copy in robot.gossip.logs.items()} for robot in swarm.robots.values()]
    assert logs[0] == logs[1] == logs[2]
    assert {robot.election.term for robot in swarm.robots.values()} == {swarm.robots["bob-2"].election.term}
    assert swarm.robots["alice"].assembly.closures > 5
    assert all(robot.corrections.applied is not None for robot in swarm.robots.values())


SMALL = CoreParameters(
    neighbours=NeighbourParameters(neighbours_max=8),
    gossip=GossipParameters(logs_max=8),
    loop_closing=LoopClosingParameters(candidates_max=16),
)
HOSTILE_REGISTRATIONS = (
    Registration(np.full((4, 4), np.nan), 100, 100, 1.0),
    Registration(np.zeros((4, 4)), 100, 100, 1.0),
    Registration(1e9 * np.eye(4), 100, 100, 1.0),
    Registration(np.eye(4), 100, 100, 1e-15),
    Registration(np.eye(4), 100, 100, 1e15),
    Registration(np.eye(4), 100, 100, np.nan),
    Registration(np.eye(4), 100, 100, 0.0),
    Registration(np.eye(4), 10**9, 0, 1.0),
    Registration(np.eye(4), 100, 100, 1.0, np.full((6, 6), np.inf)),
    Registration(np.eye(4), 100, 100, 1.0, 1e300 * np.eye(6)),
)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("result", HOSTILE_REGISTRATIONS, ids=range(len(HOSTILE_REGISTRATIONS)))
def test_a_registration_that_makes_no_sense_is_a_rejection(result: Registration) -> None:
    swarm = DamagedSwarm(0, damaged_ratio=0.0)
    swarm.inject = lambda receiver: None  # type: ignore[method-assign]
    swarm.registration = lambda: result  # type: ignore[method-assign]
    swarm.run(20.0)
    assert any(len(copy) > copy.keyframes for copy in swarm.robots["alice"].gossip.logs.values())


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e8])
def test_a_solution_that_leaves_the_map_is_not_published(value: float) -> None:
    swarm = DamagedSwarm(0, damaged_ratio=0.0)
    swarm.inject = lambda receiver: None  # type: ignore[method-assign]
    swarm.run(20.0)
    (leader,) = (robot for robot in swarm.robots.values() if robot.election.leading)
    assert leader.election.term is not None
    applied = leader.corrections.applied
    poses = np.full((leader.gossip.logs[leader.log].keyframes, 4, 4), value)
    broken = Component((leader.log,), {leader.log: poses}, {leader.log: poses[0]}, {leader.log: None})
    effects = leader.corrections.publish(leader.election.term, 1000, GraphSolution((broken,), ()))
    assert [type(effect) for effect in effects] == [Report]
    assert leader.corrections.applied is applied


def items_held(value: object, seen: set[int] | None = None) -> int:
    """Number of entries in all containers that an object's state reaches; an identifier or a digest is one thing.

    What several machines refer to counts once.
    """
    seen = set() if seen is None else seen
    if (isinstance(value, tuple) and type(value) is not tuple) or id(value) in seen:
        return 0
    if isinstance(value, dict):
        return sum(1 + items_held(entry, seen) for entry in value.values())
    if isinstance(value, list | tuple | set | frozenset | deque):
        return sum(1 + items_held(entry, seen) for entry in value)
    if not type(value).__module__.startswith("flocc_agent.core"):
        return 0
    seen.add(id(value))
    slots = [name for cls in type(value).__mro__ for name in getattr(cls, "__slots__", ()) if name in dir(value)]
    return sum(items_held(getattr(value, name), seen) for name in [*getattr(value, "__dict__", ()), *slots])


def test_strangers_cannot_grow_a_robot_without_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every message comes from a robot that was never heard of, or speaks of logs that nobody knows."""
    monkeypatch.setattr(pulls.remember, "__defaults__", (16,))
    monkeypatch.setattr(peer_budgets, "PEERS_MAX", 16)
    monkeypatch.setattr(robot_of_core, "OTHER_MODE_MAX", 16)
    robot = Robot(LogId("alice"), 0, 0, SMALL, 0.0)
    carol = [Envelope(LogId("carol"), message) for message in (*MESSAGES, Records((RecordBatch(BOB, 3, 0, ENCODED),)))]
    examples = [encode(envelope) for envelope in (*ENVELOPES, *carol)]
    held = []
    for number in range(300):
        now = 0.05 * number
        for data in examples:
            stranger = data.replace(b"\xa5bob-2", b"\xa5" + f"r{number:04d}".encode())
            robot.handle(MessageReceived(decode(stranger)), now)
        robot.tick(now)
        held.append(items_held(robot))
    assert max(held[150:]) < 1.1 * max(held[:150])
    assert max(held) < 1100
