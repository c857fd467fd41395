"""Claims over zenoh: unknown kinds of records harm nobody; another version of messages is named at both ends."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.agent.runtime.loopback import loopback_configs
from tests.protocol.wire_examples import ALICE
from tests.swarm.robot_program import CAMERA, T_world_camera_at

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import PerceptionConfig, TransportConfig
from flocc_agent.core.effects import Effect
from flocc_agent.core.events import Event
from flocc_agent.core.reports import Fact, PeerRefused
from flocc_agent.perception.synthetic import pose_image
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.zenoh_transport import ZenohTransport
from flocc_protocol.codec import to_bytes
from flocc_protocol.ids import LogId
from flocc_protocol.messages import PROTOCOL_VERSION, decode
from flocc_protocol.records import UnknownRecord

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

NAMES = ("r1", "r2", "r3")
KEYFRAMES = 12


def config_of(name: str, transport: TransportConfig, folder: Path | None = None) -> AgentConfig:
    return AgentConfig(
        name=name,
        swarm="test",
        incarnation=0,
        folder=folder,
        perception=PerceptionConfig(method="synthetic"),
        transport=transport,
    )


async def reached(is_true: Callable[[], bool], what: Callable[[], object]) -> None:
    try:
        async with asyncio.timeout(60.0):
            while not is_true():
                await asyncio.sleep(0.05)
    except TimeoutError:
        raise AssertionError(str(what())) from None


async def write(agent: Agent, number: int) -> None:
    """Let a robot append a record as a later version would: with the next event that it handles, in its own order."""
    robot = agent.robot
    record = UnknownRecord(77, to_bytes([77, {"a kind of": "a later version", "number": number}]))

    def handle(event: Event, now: float) -> list[Effect]:
        del vars(robot)["handle"]
        return [*robot.own_log.append(record, now), *robot.handle(event, now)]

    vars(robot)["handle"] = handle
    await reached(lambda: "handle" not in vars(robot), agent.status)


def logs(agents: list[Agent]) -> list[Any]:
    return [agent.status().logs for agent in agents]


async def test_one_robot_writes_records_that_the_others_do_not_know(tmp_path: Path) -> None:
    configs = {name: config_of(name, transport, tmp_path / name) for name, transport in loopback_configs(NAMES).items()}
    async with (
        Agent(configs["r1"], CAMERA) as r1,
        Agent(configs["r2"], CAMERA) as r2,
        Agent(configs["r3"], CAMERA) as r3,
    ):
        agents = [r1, r2, r3]
        for k in range(KEYFRAMES):
            for phase_rad, agent in zip((0.0, 0.3, 0.6), agents, strict=True):
                T = T_world_camera_at(phase_rad + 0.12 * k)
                await agent.add_keyframe(pose_image(T, f"{agent.config.name}/{k}").pixels, T, float(k))
            await write(r3, k)
            await asyncio.sleep(0.1)

        def settled() -> bool:
            held = logs(agents)
            equal = held[0] == held[1] == held[2] and len(held[0]) == 3
            corrected = all(agent.status().map_frame is not None for agent in agents)
            return equal and corrected and not any(agent.status().busy for agent in agents)

        await reached(settled, lambda: [agent.status() for agent in agents])
        theirs = r1.robot.gossip.logs[LogId("r3")]
        unread = [record for record in theirs.records if isinstance(record, UnknownRecord)]
        assert len(unread) == KEYFRAMES
        assert theirs.encoded == r3.robot.gossip.logs[LogId("r3")].encoded
        closures = [agent.status().closures for agent in agents]
        assert closures[0] == closures[1] == closures[2] >= KEYFRAMES
        assert {agent.status().map_frame for agent in agents} == {"map/r1"}
        assert all(agent.status().refused == {} for agent in agents)
    async with Agent(configs["r3"], CAMERA) as again:
        assert again.status().keyframes == KEYFRAMES, "it starts on its own store with its own unknown records"


def refusals(told: list[Reported[Fact]]) -> list[Fact]:
    """Who was refused, and why."""
    return [each.fact for each in told if isinstance(each.fact, PeerRefused)]


async def test_another_version_of_the_messages_is_named_at_both_ends() -> None:
    """A peer of version 2, whose heartbeats are those of commit 04961b5; what it hears, it would refuse in turn."""
    transports = loopback_configs(("r1", "alice"))
    told: list[Reported[Fact]] = []
    heard: list[bytes] = []
    wire = (Path(__file__).parents[1] / "protocol" / "wire_v2.txt").read_text().splitlines()
    old = bytes.fromhex(next(line.split()[1] for line in wire if line.startswith("heartbeat ")))
    peer = ZenohTransport("test", ALICE.robot, transports["alice"])
    peer.set_receiver(lambda sender, kind, payload: heard.append(payload))
    async with peer, Agent(config_of("r1", transports["r1"]), CAMERA, on_report=told.append) as agent:
        await agent.add_keyframe(pose_image(np.eye(4), "r1/0").pixels, np.eye(4), 0.0)

        def refused() -> bool:
            peer.broadcast("heartbeat", old)
            return bool(refusals(told)) and bool(heard)

        await reached(refused, agent.status)
        assert agent.status().neighbours == ()
    reason = f"protocol version 2, this robot speaks {PROTOCOL_VERSION}"
    assert refusals(told) == [PeerRefused(peer="alice", reason=reason)]
    assert heard[0][1] == PROTOCOL_VERSION != 2, "the other end reads the version in the same byte, and says the same"
    decode(heard[0])
