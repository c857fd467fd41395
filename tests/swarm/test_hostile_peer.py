"""A peer that sends mutated wire bytes into a live agent: nothing is raised, nothing grows, no wrong record appears.

FLOCC_FUZZ_MESSAGES sets how many (default 40000); a million was run for docs/reliability.md.
"""

import asyncio
import json
import logging
import os
import random
from pathlib import Path

import numpy as np
import pytest
from tests.agent.runtime.loopback import loopback_configs, until
from tests.swarm.robot_program import CAMERA, T_world_camera_at

from flocc_agent.agent import Agent
from flocc_agent.config import AgentConfig, PerceptionConfig, TransportConfig
from flocc_agent.perception.synthetic import pose_image
from flocc_agent.runtime.zenoh_session import Plane, open_session, session_settings
from flocc_agent.runtime.zenoh_transport import ZenohTransport
from flocc_protocol.messages import MESSAGE_KINDS

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

MESSAGES = int(os.environ.get("FLOCC_FUZZ_MESSAGES", "40000"))
SEED = 20261122
RSS_GROWTH_BYTES_MAX = 60 * 1024 * 1024


def resident_bytes() -> int:
    """Memory of this process that is in use."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def agent_config(name: str, transport: TransportConfig) -> AgentConfig:
    return AgentConfig(
        name=name,
        swarm="test",
        incarnation=0,
        perception=PerceptionConfig(method="synthetic"),
        transport=transport.model_copy(
            update={"peer_messages_per_s": 1e9, "peer_bytes_per_s": 1e12, "inbox_messages_max": 100_000}
        ),
    )


async def overheard(agent: Agent, config: TransportConfig) -> list[tuple[str, bytes]]:
    """Valid messages of a living robot, as material: what it says while it takes a few keyframes."""
    heard: list[tuple[str, bytes]] = []
    listener = ZenohTransport("test", "r3", config)
    listener.set_receiver(lambda sender, kind, payload: heard.append((kind, payload)))
    async with listener:
        for index in range(6):
            T = T_world_camera_at(0.3 * index)
            await agent.add_keyframe(pose_image(T, f"r1/{index}").pixels, T, float(index))
        await until(lambda: {"heartbeat", "records"} <= {kind for kind, _ in heard}, 20.0)
    return heard[:200]


def mutated(message: bytes, rng: random.Random) -> bytes:
    """Flip, cut, repeat, insert or splice."""
    data = bytearray(message)
    for _ in range(rng.randint(1, 4)):
        position = rng.randrange(len(data) + 1)
        match rng.randrange(5):
            case 0 if data:
                data[position % len(data)] = rng.randrange(256)
            case 1:
                del data[position:]
            case 2:
                data[position:position] = data[position : position + rng.randrange(40)]
            case 3:
                data[position:position] = rng.randbytes(rng.randrange(9))
            case _:
                del data[position : position + rng.randrange(9)]
    return bytes(data)


def attack(rng: random.Random, material: list[tuple[str, bytes]]) -> tuple[str, bytes]:
    """One hostile message: a key and a payload."""
    kind, payload = rng.choice(material)
    if rng.random() < 0.2:
        kind = rng.choice(MESSAGE_KINDS)
    sender = "r2" if rng.random() < 0.9 else rng.choice(("r1", "r7", "r1~5", "$", "R"))
    key = f"flocc/v2/test/{sender}/{'to/r1/' if rng.random() < 0.5 else ''}{kind}"
    return (key, mutated(payload, rng)) if rng.random() < 0.95 else (key, payload)


async def test_mutated_bytes_change_nothing(caplog: pytest.LogCaptureFixture) -> None:
    rng = random.Random(SEED)
    configs = loopback_configs(("r1", "r2", "r3"))
    async with Agent(agent_config("r1", configs["r1"]), CAMERA) as agent:
        material = await overheard(agent, configs["r3"])
        await until(lambda: agent.status().keyframes == 6 and not agent.status().busy, 20.0)
        own_log = agent.status().logs["r1"]
        caplog.clear()
        rogue = open_session(session_settings(configs["r2"], "test", "r2", Plane.CONTROL), "rogue")
        try:
            await until(lambda: len(rogue.info.peers_zid()) >= 1, 20.0)
            before = resident_bytes()
            for count in range(MESSAGES):
                key, payload = attack(rng, material)
                if "$" not in key:
                    rogue.put(key, payload)
                if count % 100 == 0:
                    await asyncio.sleep(0)
            await until(lambda: not agent.status().busy, 60.0)
            grown = resident_bytes() - before
        finally:
            rogue.close()
        status = agent.status()
    refused = sum(count for reason, count in status.refused.items() if reason.startswith("refused"))
    figures = {"sent": MESSAGES, "refused": refused, "grown_bytes": grown, "counters": status.refused}
    print(json.dumps(figures))
    assert status.logs["r1"] == own_log
    assert np.isfinite(json.loads(status.model_dump_json())["t"])
    assert refused > MESSAGES // 4
    assert grown < RSS_GROWTH_BYTES_MAX
    errors = [record for record in caplog.records if record.levelno >= logging.ERROR or record.exc_info]
    assert errors == []
    warnings = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) < 60, "a peer's faults are logged once per peer and reason"
