"""A robot and another one that runs from a copy of its disk: the doctor of the running swarm names it."""

import asyncio
import shutil
from pathlib import Path

import pytest
from tests.agent.runtime.loopback import free_ports
from tests.agent.runtime.test_agent_api import camera

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import PerceptionConfig, TransportConfig
from flocc_launch.dashboard.status_table import status_of_swarm
from flocc_launch.doctor.live import diagnose_live

pytestmark = [pytest.mark.swarm, pytest.mark.beside]

TOLD_WITHIN_S = 20.0


async def test_the_doctor_of_a_running_swarm_names_a_copied_disk(tmp_path: Path) -> None:
    (group,) = free_ports(1)
    transport = TransportConfig(interface="lo", multicast_address=f"224.0.0.224:{group}")
    synthetic = PerceptionConfig(method="synthetic")

    def config(name: str, folder: str) -> AgentConfig:
        return AgentConfig(
            name=name, swarm="copied", folder=tmp_path / folder, transport=transport, perception=synthetic
        )

    async with Agent(config("r1", "r1"), camera()):
        pass
    shutil.copytree(tmp_path / "r1", tmp_path / "copy")
    r1, copy, r2 = (
        Agent(config(name, folder), camera()) for name, folder in (("r1", "r1"), ("r1", "copy"), ("r2", "r2"))
    )
    async with r1, copy, r2:
        assert r1.log == copy.log
        async with asyncio.timeout(TOLD_WITHIN_S):
            while r2.status().doubles != ("r1",):
                await asyncio.sleep(0.1)
        rows = await asyncio.to_thread(status_of_swarm, transport, "copied", 2.0)
    sentences = [finding.sentence for finding in diagnose_live(rows) if finding.cause == "duplicate-name"]
    assert len(sentences) == 1
    assert sentences[0].startswith("Two agents run with the name r1, as ")
