"""Claims on whole agents in processes of their own, over real zenoh on loopback."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from tests.agent.runtime.loopback import loopback_configs
from tests.swarm.robots import RobotProcess, agent_configs, frames, leaders, logs_equal, neighbours, reached

from flocc_launch.swarm.chaos_orders import disturb, parse_order

pytestmark = [pytest.mark.swarm, pytest.mark.slow]

NAMES = ("r1", "r2", "r3")
LEADER_TIMEOUT_S = 3.0
START_S = 60.0


@asynccontextmanager
async def running(folder: Path, **options: object) -> AsyncIterator[list[RobotProcess]]:
    """Three robots that follow one leader in one frame."""
    configs = agent_configs(loopback_configs(NAMES, **options), folder)
    robots = [RobotProcess(config, folder / "logs") for config in configs.values()]
    try:
        await asyncio.gather(*(robot.start(phase_rad=0.6 * i) for i, robot in enumerate(robots)))
        await reached(robots, lambda: leaders(robots) == {"r1"}, START_S, "all follow r1")
        await reached(robots, lambda: frames(robots) == {"map/r1"}, 60.0, "one frame")
        yield robots
    finally:
        await asyncio.gather(*(robot.close() for robot in robots))


@pytest.mark.beside
async def test_a_killed_leader_is_replaced_and_comes_back_with_its_log_and_all_end_in_order(tmp_path: Path) -> None:
    async with running(tmp_path) as robots:
        first, *rest = robots
        before = first.status["logs"]["r1"][0]
        round_before = max(robot.status["round"] for robot in rest)
        await first.kill()
        await reached(rest, lambda: leaders(rest) == {"r2"}, 2 * LEADER_TIMEOUT_S, "r2 leads")
        await reached(
            rest,
            lambda: all((robot.status["term"], robot.status["round"]) > (1, 0) for robot in rest),
            20.0,
            "new term",
        )
        assert round_before >= 1
        assert all("r1" not in neighbours(robot) for robot in rest)
        await first.start(keyframes=10, phase_rad=3.0)
        await reached(
            robots, lambda: first.status.get("logs", {}).get("r1", [0])[0] >= before, START_S, "its log is back"
        )
        await reached(robots, lambda: leaders(robots) == {"r1"}, START_S, "r1 leads again")
        await reached(
            robots,
            lambda: logs_equal(robots) and first.status["logs"]["r1"][0] >= before + 10 and not first.status["busy"],
            30.0,
            "all logs equal, with the new keyframes under the old numbering",
        )
        assert set(first.status["logs"]) == set(NAMES)
        assert all(robot.status["refused"] == {} for robot in rest)
        assert await asyncio.gather(*(robot.close() for robot in robots)) == [0, 0, 0]
        said = "".join(robot.log() for robot in robots)
        assert [bad for bad in ("Traceback", "never retrieved") if bad in said] == []


async def test_an_operator_partitions_heals_and_kills(tmp_path: Path) -> None:
    async with running(tmp_path, chaos=True) as robots:
        operator = robots[0].config.transport

        async def order(words: str) -> dict[str, str]:
            return await asyncio.to_thread(disturb, operator, "test", parse_order(words))

        assert await order("partition r1 | r2,r3") == dict.fromkeys(NAMES, "done")
        await reached(robots, lambda: leaders(robots[1:]) == {"r2"} and neighbours(robots[0]) == set(), 15.0, "parted")
        assert await order("heal") == dict.fromkeys(NAMES, "done")
        await reached(robots, lambda: leaders(robots) == {"r1"} and logs_equal(robots), 15.0, "healed")
        assert await order("kill r3") == {"r1": "not concerned", "r2": "not concerned", "r3": "done"}
        await reached(robots, lambda: "r3" not in neighbours(robots[0]), 15.0, "r3 is gone")
