"""Signatures are looked at in a worker, in turns, each peer within its budget; what is cheap to refuse costs none."""

import asyncio
import threading
from collections.abc import Sequence
from pathlib import Path

from flocc_agent.config import TlsConfig
from flocc_agent.core.claims import Claim
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.gossip import Gossip
from flocc_agent.core.parameters import CoreParameters, GossipParameters
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.security import RecordSealer
from flocc_agent.runtime.signature_queue import CHECKS_BURST, CHECKS_PER_S, PEERS_MAX, WAITING_MAX, SignatureQueue
from flocc_agent.runtime.workers import Workers
from flocc_launch.setup.credentials import make_keys
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Envelope, RecordBatch, Records
from flocc_protocol.records import KeyframeRecord

R1, R2, R3 = LogId("r1"), LogId("r2"), LogId("r3")


class Robots:
    """Members with keys; the first one's queue, and which threads checked signatures for it."""

    def __init__(self, folder: Path) -> None:
        keys = make_keys(folder, "test", ("r1", "r2", "r3"))
        self.sealers = {
            name: RecordSealer.of(TlsConfig(folder=keys[name])) for name in keys if name in ("r1", "r2", "r3")
        }
        self.logs = {log: Gossip(log, GossipParameters(), self.sealers[log.robot]) for log in (R2, R3)}
        judge = self.sealers["r1"]
        self.robot = Robot(R1, 0, 7, CoreParameters(), 0.0, sealer=judge)
        self.now = 0.0
        self.threads: list[str] = []
        verify = judge._verify

        def seen(log: LogId, signature: bytes, text: bytes) -> bool:
            self.threads.append(threading.current_thread().name)
            return verify(log, signature, text)

        judge._verify = seen  # type: ignore[method-assign]
        self._judge = judge
        self._workers = Workers()
        self.queue = SignatureQueue(self.robot.claims, self._check, self._handled)
        self.order: list[str] = []

    async def _check(self, messages: Sequence[Sequence[Claim]]) -> list[int]:
        done = await self._workers.run("check", self._judge.check, messages)
        return done.value  # type: ignore[union-attr]

    def _handled(self, envelope: Envelope) -> None:
        self.order.append(envelope.sender.robot)
        self.robot.handle(MessageReceived(envelope), self.now)
        self.queue.on_handled(envelope)

    def batch(self, log: LogId) -> RecordBatch:
        """The next keyframe of a robot."""
        index = self.logs[log].logs[log].keyframes
        return self.logs[log].append(KeyframeRecord(index, float(index), (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None))[2]

    def forged(self, log: LogId) -> RecordBatch:
        """A first record of a log, signed by nobody."""
        return RecordBatch(log, 0, 0, (self.batch(log).records[0][:-64] + bytes(64),))

    def say(self, sender: LogId, *batches: RecordBatch) -> bool:
        return self.queue.put(Envelope(sender, Records(batches)), self.now)

    async def turns(self, until_s: float) -> None:
        """All turns that are due until then."""
        while (due_s := self.queue.due_s()) <= until_s:
            self.now = max(self.now, due_s)
            await self.queue.run_turn(self.queue.next_turn(self.now), self.now)
        self.now = until_s

    async def close(self) -> None:
        await self._workers.close()


async def test_signatures_are_looked_at_in_a_worker_once_each_and_in_order(tmp_path: Path) -> None:
    robots = Robots(tmp_path)
    for _ in range(70):
        assert robots.say(R2, robots.batch(R2))
    await robots.turns(1.0)
    assert len(robots.robot.gossip.logs[R2]) == 70
    assert len(robots.threads) == 70
    assert {name.split("_")[0] for name in robots.threads} == {"check"}
    assert not robots.queue.is_waiting()
    await robots.close()


async def test_what_is_known_or_cannot_be_taken_costs_no_check(tmp_path: Path) -> None:
    robots = Robots(tmp_path)
    first, second, third = (robots.batch(R2) for _ in range(3))
    robots.say(R2, first)
    robots.say(R3, first)
    robots.say(R3, third)
    await robots.turns(1.0)
    assert len(robots.threads) == 1
    robots.say(R3, RecordBatch(R2, 0, 0, second.records))
    await robots.turns(2.0)
    assert len(robots.threads) == 1
    await robots.close()


async def test_one_wrong_signature_is_looked_at_and_its_sender_not_heard_for_a_while(tmp_path: Path) -> None:
    robots = Robots(tmp_path)
    forged = robots.forged(R3)
    for _ in range(WAITING_MAX):
        robots.say(R2, forged)
    await robots.turns(0.5)
    assert len(robots.threads) == 1
    assert robots.robot.sizes()["muted"][0] == 1
    await robots.close()


async def test_who_sends_more_than_is_checked_delays_only_himself(tmp_path: Path) -> None:
    robots = Robots(tmp_path)
    many = [RecordBatch(R2, 0, 0, tuple(robots.batch(R2).records[0] for _ in range(64)))]
    while len(robots.logs[R2].logs[R2]) < CHECKS_BURST + 3 * CHECKS_PER_S:
        first, before = len(robots.logs[R2].logs[R2]), robots.logs[R2].logs[R2].checksum
        many.append(RecordBatch(R2, first, before, tuple(robots.batch(R2).records[0] for _ in range(64))))
    for batch in many:
        robots.say(R2, batch)
    robots.say(R3, robots.batch(R3))
    await robots.turns(0.0)
    assert robots.order[:2] == ["r2", "r3"]
    held = len(robots.robot.gossip.logs[R2])
    assert CHECKS_BURST <= held <= CHECKS_BURST + 64
    await robots.turns(1.0)
    assert len(robots.robot.gossip.logs[R2]) <= CHECKS_BURST + CHECKS_PER_S + 64
    await robots.turns(10.0)
    assert len(robots.robot.gossip.logs[R2]) == len(robots.logs[R2].logs[R2])
    await robots.close()


async def test_a_queue_that_is_full_takes_no_more_of_that_peer_only(tmp_path: Path) -> None:
    robots = Robots(tmp_path)
    batch = robots.batch(R2)
    assert all(robots.say(R2, batch) for _ in range(WAITING_MAX))
    assert not robots.say(R2, batch)
    assert robots.say(R3, batch)
    assert robots.queue.size() == (WAITING_MAX, WAITING_MAX)
    for k in range(PEERS_MAX - 2):
        assert robots.say(LogId(f"s{k}"), batch)
    assert not robots.say(LogId("one-more"), batch)
    await robots.turns(0.0)
    assert robots.say(LogId("one-more"), batch)
    await robots.close()


async def test_the_next_turn_waits_until_the_robot_has_handled_the_last_one(tmp_path: Path) -> None:
    robots = Robots(tmp_path)
    handed: list[Envelope] = []
    queue = SignatureQueue(robots.robot.claims, robots._check, handed.append)
    for _ in range(2):
        queue.put(Envelope(R2, Records((robots.batch(R2),))), 0.0)
    await queue.run_turn(queue.next_turn(0.0), 0.0)
    assert len(handed) == 1
    assert queue.next_turn(0.0) == []
    assert queue.is_waiting()
    robots.robot.handle(MessageReceived(handed[0]), 0.0)
    queue.on_handled(handed[0])
    await asyncio.wait_for(queue.run_turn(queue.next_turn(0.0), 0.0), 10.0)
    assert len(handed) == 2
    await robots.close()
