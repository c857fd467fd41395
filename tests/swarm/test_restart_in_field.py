"""A robot of a running team is carried and started again where nobody told it: it is found in the team's map again."""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from tests.agent.runtime.test_agent_api import camera
from tests.agent.runtime.test_journeys import until, walk, world
from tests.swarm.test_map_of_swarm import config

from flocc_agent import Agent

pytestmark = [pytest.mark.swarm, pytest.mark.beside]


async def test_a_robot_that_starts_elsewhere_is_found_in_its_teams_map_again(tmp_path: Path) -> None:
    """No folder is emptied and nothing is told: its odometry begins at its origin, where it was not before."""
    carried = config("r2", "carried").model_copy(update={"folder": tmp_path / "r2", "incarnation": 0})
    async with Agent(config("r1", "carried"), camera()) as r1:
        async with Agent(carried, camera()) as r2:
            first = r2.log
            await walk(r1, range(12), 0, 1.0, "a")
            await walk(r2, range(2, 10), 2, 1.0, "b")
            await until(r2, lambda c: c.map_frame == f"map/{r1.log}" and len(c.own) == 8)
        async with Agent(carried, camera()) as r2:
            await walk(r2, range(4, 13), 4, 100.0, "c")
            assert r2.log.robot == first.robot
            assert r2.log != first
            found = await until(r2, lambda c: c.map_frame == f"map/{r1.log}" and len(c.own) == 9)
            np.testing.assert_allclose(found.T_map_odom, world(4), atol=0.3)
            told = asyncio.create_task(until(r1, lambda c: "r2" in c.others))
            await walk(r1, range(12, 14), 0, 200.0, "a")
            other = (await told).others["r2"].last()
            assert other is not None
            np.testing.assert_allclose(other, world(12), atol=0.3)
