"""An agent killed with SIGKILL at random moments, judged by what another robot has already received of its log."""

import asyncio
import random
import sqlite3
from pathlib import Path

import pytest
from tests.agent.runtime.loopback import loopback_configs
from tests.swarm.robots import RobotProcess, agent_configs, logs_equal, reached

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

KILLS = 4
SEED = 20261122


def own_records(folder: Path) -> list[bytes]:
    """r1's own log as its disk holds it."""
    with sqlite3.connect(folder / "r1/store/robot.sqlite") as database:
        rows = database.execute("SELECT number, data FROM records WHERE log = 'r1' ORDER BY number").fetchall()
    assert [number for number, _ in rows] == list(range(len(rows)))
    return [data for _, data in rows]


async def test_comes_back_with_all_it_had_published_and_never_uses_a_number_twice(tmp_path: Path) -> None:
    rng = random.Random(SEED)
    configs = agent_configs(loopback_configs(("r1", "r2")), tmp_path)
    victim, observer = (RobotProcess(config, tmp_path / "logs") for config in configs.values())
    before: list[bytes] = []
    try:
        await observer.start(12, 0.2, phase_rad=0.6)
        for kill in range(KILLS):
            await victim.start(200, 0.05, phase_rad=1.1 * kill)
            published = len(before)
            await reached(
                [victim, observer],
                lambda published=published: observer.status.get("logs", {}).get("r1", [0])[0] > published + 5,  # type: ignore[misc]
                30.0,
                "the observer has new records",
            )
            await asyncio.sleep(rng.uniform(0.0, 0.5))
            await victim.kill()
            after = own_records(tmp_path)
            assert after[: len(before)] == before, "a record changed"
            assert len(after) >= observer.status["logs"]["r1"][0], "a published record is missing"
            before = after
        await victim.start(5, 0.1, phase_rad=9.0)
        await reached(
            [victim, observer],
            lambda: logs_equal([victim, observer]) and not victim.status["busy"] and victim.status["keyframes"] >= 5,
            60.0,
            "equal logs",
        )
        assert set(observer.status["logs"]) == {"r1", "r2"}, "it came back as itself"
        await asyncio.gather(victim.close(), observer.close())
        assert "log_forked" not in observer.log() + victim.log()
    finally:
        await asyncio.gather(victim.close(), observer.close())
