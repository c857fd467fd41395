"""Claims over zenoh: one robot of a team goes to the next version and back, with its store, while the other stays.

The version before is taken from this repository's history; without it (a cut-off clone) the test is skipped.
"""

import asyncio
import io
import subprocess
import tarfile
from functools import partial
from pathlib import Path

import pytest
from tests.agent.runtime.loopback import loopback_configs
from tests.swarm.robots import RobotProcess, agent_configs, frames, logs_equal, neighbours, reached

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

BEFORE = "4849a15"
"""The first state with protocol 5, which the next one must go on with; older ones speak 4, and robots of two protocols
name each other and exchange nothing (`test_mixed_versions.py`)."""
PACKAGES = ("protocol", "agent", "launch")
ROOT = Path(__file__).parents[2]
SETTLED_S = 60.0


def version_before(folder: Path) -> tuple[str, ...]:
    """What to write before a command so that it runs the version before."""
    command = ["git", "-C", str(ROOT), "archive", "--format=tar", BEFORE, *PACKAGES]
    archived = subprocess.run(command, capture_output=True, check=False)
    if archived.returncode:
        pytest.skip(f"the version before is not in this clone: {archived.stderr.decode().strip()}")
    with tarfile.open(fileobj=io.BytesIO(archived.stdout)) as archive:
        archive.extractall(folder, filter="data")
    return ("env", "PYTHONPATH=" + ":".join(str(folder / package) for package in PACKAGES))


def settled(robots: list[RobotProcess], keyframes: int) -> bool:
    """Both hear each other, hold the same logs with so many keyframes of r2, and are in one map."""
    hear = all(len(neighbours(robot)) == 1 for robot in robots)
    busy = any(robot.status.get("busy", True) for robot in robots)
    done = robots[1].status.get("keyframes") == keyframes and not busy
    return hear and done and logs_equal(robots) and frames(robots) == {"map/r1"}


async def test_a_robot_is_upgraded_and_downgraded_with_its_store(tmp_path: Path) -> None:
    before = version_before(tmp_path / "before")
    configs = agent_configs(loopback_configs(("r1", "r2")), tmp_path / "agents")
    stays = RobotProcess(configs["r1"], tmp_path / "logs", before)
    robots = [stays]
    try:
        await stays.start(15)
        for lived, prefix in enumerate((before, (), before)):
            changes = RobotProcess(configs["r2"], tmp_path / "logs", prefix)
            robots = [stays, changes]
            await changes.start(8, phase_rad=0.6 + 0.5 * lived)
            is_settled = partial(settled, robots, 8 * (lived + 1))
            await reached(robots, is_settled, SETTLED_S, f"life {lived + 1}")
            assert set(changes.status["logs"]) == {"r1", "r2"}, "it goes on with its log"
            assert await changes.close() == 0
    finally:
        await asyncio.gather(*(robot.close() for robot in robots))
