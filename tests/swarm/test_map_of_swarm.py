"""A running swarm is copied into a map by one more agent, and goes on."""

import asyncio
from pathlib import Path

import pytest
from tests.agent.runtime.test_agent_api import camera
from tests.agent.runtime.test_journeys import until, walk

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import PerceptionConfig, TransportConfig
from flocc_agent.runtime.map_folder import MapFolder
from flocc_launch.swarm.harvest import HarvestFailed, save_swarm

pytestmark = [pytest.mark.swarm, pytest.mark.beside]


def config(name: str, swarm: str) -> AgentConfig:
    transport = TransportConfig(interface="lo", multicast_address="224.0.0.224:7913")
    return AgentConfig(name=name, swarm=swarm, transport=transport, perception=PerceptionConfig(method="synthetic"))


async def test_a_running_swarm_gives_a_map_and_goes_on(tmp_path: Path) -> None:
    async with Agent(config("r1", "copied"), camera()) as r1, Agent(config("r2", "copied"), camera()) as r2:
        await walk(r1, range(12), 0, 1.0, "a")
        await walk(r2, range(2, 10), 2, 1.0, "b")
        frame = f"map/{min(r1.log, r2.log)}"
        await until(r2, lambda c: c.map_frame == frame and len(c.own) == 8)
        manifest = await asyncio.to_thread(save_swarm, config("saver", "copied"), tmp_path / "map")
        assert (manifest.frame, manifest.poses, manifest.latents) == (frame, 2, 20)
        assert len(MapFolder.open(tmp_path / "map").latent_keyframes()) == 20
        await walk(r1, range(12, 14), 0, 60.0, "a")
        await until(r1, lambda c: c.map_frame == frame and len(c.own) == 14)
    assert list(tmp_path.iterdir()) == [tmp_path / "map"], "nothing else is left"


def test_nobody_there_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flocc_launch.swarm.harvest.FOUND_WITHIN_S", 1.0)
    with pytest.raises(HarvestFailed, match="swarm empty: nobody is there"):
        save_swarm(config("saver", "empty"), tmp_path / "map")
