"""Claims over real zenoh: robots that share no view end in one frame by a tag, and by having seen each other."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest
from tests.agent.runtime.loopback import loopback_configs

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import PerceptionConfig
from flocc_agent.core.measurements import Measurement, RobotSighting, TagSighting
from flocc_agent.geometry import Float, inverse, pose, so3_exp
from flocc_agent.perception.synthetic import pose_image

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

KEYFRAMES = 8
TIGHT = 1e-4 * np.eye(6)
T_WORLD_TAG = pose(so3_exp(np.array([0.0, 0.3, 1.0])), np.array([4.0, 2.5, 1.0]))
ELSEWHERE_M = 1000.0
"""How far apart the places are that the robots' images show: nothing is recognised."""


def T_world_body(robot: int, k: int) -> Float:
    """Two robots pass each other in parallel streets."""
    if robot == 0:
        return pose(np.eye(3), np.array([1.0 * k, 0.0, 0.0]))
    return pose(so3_exp(np.array([0.0, 0.0, np.pi])), np.array([8.0 - 1.0 * k, 5.0, 0.0]))


def image_of(robot: int, k: int) -> Any:
    shown = T_world_body(robot, k) @ pose(np.eye(3), np.array([ELSEWHERE_M * robot, 0.0, 0.0]))
    return pose_image(shown, f"r{robot + 1}/{k}").pixels


@asynccontextmanager
async def team() -> AsyncIterator[list[Agent]]:
    camera = pose_image(np.eye(4), "x").camera
    configs = {
        name: AgentConfig(
            name=name, swarm="test", incarnation=0, perception=PerceptionConfig(method="synthetic"), transport=transport
        )
        for name, transport in loopback_configs(("r1", "r2")).items()
    }
    async with Agent(configs["r1"], camera) as r1, Agent(configs["r2"], camera) as r2:
        yield [r1, r2]


async def reached(is_true: Callable[[], bool], agents: list[Agent], timeout_s: float = 60.0) -> None:
    try:
        async with asyncio.timeout(timeout_s):
            while not is_true():
                await asyncio.sleep(0.05)
    except TimeoutError:
        raise AssertionError("\n".join(str(agent.status()) for agent in agents)) from None


async def walked(agents: list[Agent], seen: Callable[[int, int], Measurement | None]) -> None:
    """Both walk; whoever sees something says so."""
    for k in range(KEYFRAMES):
        for robot, agent in enumerate(agents):
            T_odom_body = inverse(T_world_body(robot, 0)) @ T_world_body(robot, k)
            await agent.add_keyframe(image_of(robot, k), T_odom_body, 10.0 + k)
            measurement = seen(robot, k)
            if measurement is not None:
                agent.add_measurement(measurement)
        await asyncio.sleep(0.1)


def frames(agents: list[Agent]) -> list[object]:
    return [agent.status().map_frame for agent in agents]


def T_map_bodies(agent: Agent) -> Float:
    assert agent._driver is not None
    return agent._driver.corrected_bodies()[1]


def error_m(agents: list[Agent]) -> float:
    """Largest distance of r2's corrected poses from the truth, in the map of r1."""
    truth = np.array([inverse(T_world_body(0, 0)) @ T_world_body(1, k) for k in range(KEYFRAMES)])
    found = T_map_bodies(agents[1])
    return float(np.linalg.norm((found - truth[: len(found)])[:, :3, 3], axis=1).max())


def sees_the_tag(robot: int, k: int) -> Measurement | None:
    if k != 4 - robot:
        return None
    return TagSighting("7", inverse(T_world_body(robot, k)) @ T_WORLD_TAG, TIGHT)


def sees_the_other(robot: int, k: int) -> Measurement | None:
    if robot != 0 or k not in (3, 4):
        return None
    return RobotSighting("r2", inverse(T_world_body(0, k)) @ T_world_body(1, k), TIGHT)


@pytest.mark.parametrize("seen", [sees_the_tag, sees_the_other])
async def test_two_robots_without_a_common_view_end_in_one_frame(
    seen: Callable[[int, int], Measurement | None],
) -> None:
    async with team() as agents:
        await walked(agents, seen)
        await reached(lambda: frames(agents) == ["map/r1", "map/r1"], agents)
        await reached(lambda: len(T_map_bodies(agents[1])) == KEYFRAMES and error_m(agents) < 0.05, agents)
        assert [agent.status().closures for agent in agents] == [0, 0]
        assert agents[0].status().logs == agents[1].status().logs


async def test_without_it_they_stay_apart() -> None:
    async with team() as agents:
        await walked(agents, lambda robot, k: None)
        await reached(lambda: frames(agents) == ["map/r1", "map/r2"], agents)
        await reached(lambda: not any(agent.status().busy for agent in agents), agents)
        assert frames(agents) == ["map/r1", "map/r2"]
