"""The Python API: bad keyframes and fixes are refused with one sentence, and the agent goes on."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from flocc_agent import Agent, AgentConfig
from flocc_agent.agent import BadFix, BadKeyframe
from flocc_agent.config import PerceptionConfig, TransportConfig
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.interfaces import Camera
from flocc_agent.geometry import Float, pose
from flocc_agent.perception.synthetic import pose_image
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Envelope, Heartbeat, LogDigest

ALONE = TransportConfig(
    control_listen=("tcp/127.0.0.1:0",), bulk_listen=("tcp/127.0.0.1:0",), multicast=False, gossip=False
)
CONFIG = AgentConfig(name="r1", transport=ALONE, perception=PerceptionConfig(method="synthetic"))


def camera() -> Camera:
    return pose_image(np.eye(4), "r1/0").camera


def bad_poses() -> list[Float]:
    reflection, stretched, endless = np.eye(4), 2.0 * np.eye(4), np.eye(4)
    reflection[0, 0], endless[0, 3], stretched[3, 3] = -1.0, np.nan, 1.0
    return [reflection, stretched, endless, np.eye(3)]


async def test_what_cannot_be_used_is_refused_and_the_agent_goes_on() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        for T in bad_poses():
            with pytest.raises(BadKeyframe, match="robot r1: keyframe at"):
                await agent.add_keyframe(pixels, T, 1.0)
        with pytest.raises(BadKeyframe, match="its camera says"):
            await agent.add_keyframe(np.zeros((7, 5, 3), np.uint8), np.eye(4), 1.0)
        with pytest.raises(BadFix, match="no position"):
            agent.add_fix(np.array([np.nan, 0.0, 0.0]), np.eye(3))
        with pytest.raises(BadFix, match="not positive definite"):
            agent.add_fix(np.zeros(3), -np.eye(3))
        await agent.add_keyframe(pixels, np.eye(4), 1.0)
        async for correction in agent.corrections():
            assert correction.map_frame == f"map/{agent.log}"
            assert not correction.frame_changed
            break


async def test_a_robot_whose_disk_is_behind_what_it_published_begins_another_log(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"folder": tmp_path, "incarnation": 0})
    async with Agent(config, camera()) as agent:
        old = agent.log
        ahead = Heartbeat(1, 7, 0, None, 0, 0, (LogDigest(old, 5, 77),))
        assert agent._driver is not None
        agent._driver.put(MessageReceived(Envelope(LogId("r2"), ahead)))
        while "ended" not in _log_state(agent):
            await asyncio.sleep(0.01)
    async with Agent(config, camera()) as agent:
        assert agent.log.robot == "r1"
        assert agent.log != old


def _log_state(agent: Agent) -> str:
    """Whether the robot's log is to be continued after a restart."""
    assert agent.config.folder is not None
    return "continued" if (agent.config.folder / "store" / "intact").exists() else "ended"


async def test_a_frame_becomes_a_keyframe_when_the_robot_moved_enough() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        steps_m = [0.0, 0.1, 0.49, 0.51, 0.6, 1.02]
        took = [await agent.add_frame(pixels, pose(np.eye(3), np.array([x, 0.0, 0.0])), x) for x in steps_m]
    assert took == [True, False, False, True, False, True]


async def test_an_agent_without_a_camera_says_so() -> None:
    async with Agent(CONFIG) as agent:
        with pytest.raises(BadKeyframe, match="has no camera"):
            await agent.add_keyframe(np.zeros((1, 1, 3), np.uint8), np.eye(4), 0.0)
