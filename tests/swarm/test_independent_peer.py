"""A peer that was written from protocol/README.md alone takes part in a swarm of flocc's agents."""

import asyncio
import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tests.agent.runtime.loopback import loopback_configs
from tests.agent.runtime.test_agent_api import camera

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import PerceptionConfig
from flocc_agent.geometry import pose
from flocc_agent.perception.synthetic import pose_image

pytestmark = [pytest.mark.swarm, pytest.mark.beside]

PEER = Path(__file__).parents[2] / "examples/independent_peer.py"
WAIT_S = 60.0
AHEAD_M = 2.0


async def drive(agent: Agent) -> None:
    """Drive beside the peer, at its speed, until nobody waits any more."""
    for k in range(int(2 * WAIT_S)):
        T = pose(np.eye(3), np.array([0.5 * k, 0.0, 0.0]))
        await agent.add_keyframe(pose_image(T, f"r1/{k}").pixels, T, time.time())
        await asyncio.sleep(0.5)


async def one_map(process: asyncio.subprocess.Process, name: str) -> list[float]:
    """Where the peer hears that the odometry of a robot is in the peer's own map, once it is told so."""
    assert process.stdout is not None
    while line := await process.stdout.readline():
        told = json.loads(line)
        if told["log"][0] == name and told["map"][0] == "other":
            return list(told["odom_at_m"])
    raise AssertionError(f"the peer ended before it heard of {name} in its map")


async def test_a_peer_written_from_the_page_shares_logs_and_hears_corrections() -> None:
    transport = loopback_configs(["r1"])["r1"]
    config = AgentConfig(name="r1", swarm="team", transport=transport, perception=PerceptionConfig(method="synthetic"))
    async with Agent(config, camera()) as agent:
        driving = asyncio.create_task(drive(agent))
        words = ("--connect", transport.control_listen[0], "--sees", "r1", "--seconds", str(WAIT_S))
        process = await asyncio.create_subprocess_exec(
            sys.executable, str(PEER), *words, stdout=asyncio.subprocess.PIPE
        )
        try:
            at_m = await asyncio.wait_for(one_map(process, "r1"), WAIT_S)
            refused = agent.status().refused
        finally:
            process.kill()
            await process.wait()
            driving.cancel()
    assert refused == {}
    assert at_m[2] == pytest.approx(AHEAD_M, abs=0.2)
