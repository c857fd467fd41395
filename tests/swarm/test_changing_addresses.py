"""Claims on robots whose network comes late, or changes: interfaces that are up after the agent, other addresses.

Each in a network namespace. Needs root; skipped otherwise.
"""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from tests.swarm.namespaces import INTERFACE, Host, hosts, needs_namespaces
from tests.swarm.robots import RobotProcess, agent_configs, neighbours, reached

from flocc_agent.config import TransportConfig

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.root, pytest.mark.slow]

NAMES = ("r1", "r2")
MEET_S = 25.0
OTHER_NUMBER = 77


@asynccontextmanager
async def running(folder: Path, machines: Sequence[Host], interface: str) -> AsyncIterator[list[RobotProcess]]:
    transports = dict.fromkeys(NAMES, TransportConfig(interface=interface))
    configs = agent_configs(transports, folder)
    robots = [
        RobotProcess(configs[name], folder / "logs", host.prefix) for name, host in zip(NAMES, machines, strict=True)
    ]
    try:
        await asyncio.gather(*(robot.start(5) for robot in robots))
        await reached(robots, lambda: all(robot.status.get("keyframes") == 5 for robot in robots), 60.0, "both run")
        yield robots
    finally:
        await asyncio.gather(*(robot.close() for robot in robots))


def meet(robots: Sequence[RobotProcess]) -> bool:
    return neighbours(robots[0]) == {"r2"} and neighbours(robots[1]) == {"r1"}


@pytest.mark.parametrize("interface", ["auto", INTERFACE])
async def test_an_interface_that_comes_up_after_the_agent_is_used(tmp_path: Path, interface: str) -> None:
    needs_namespaces()
    with hosts(2) as machines:
        machines[1].lose_address()
        async with running(tmp_path, machines, interface) as robots:
            assert not neighbours(robots[1])
            machines[1].get_address(2)
            await reached(robots, lambda: meet(robots), MEET_S, "both hear each other")


async def test_robots_with_addresses_of_their_link_meet_and_again_once_they_get_others(tmp_path: Path) -> None:
    """As where no DHCP server answers at first."""
    needs_namespaces()
    with hosts(2) as machines:
        for number, host in enumerate(machines, 1):
            host.lose_address()
            host.get_address(number, "169.254.7", 16)
        async with running(tmp_path, machines, "auto") as robots:
            await reached(robots, lambda: meet(robots), MEET_S, "both hear each other")
            for host in machines:
                host.lose_address()
            await reached(robots, lambda: not meet(robots), MEET_S, "they are apart")
            for number, host in enumerate(machines, 1):
                host.get_address(number)
            await reached(robots, lambda: meet(robots), MEET_S, "both hear each other again")


@pytest.mark.parametrize("interface", ["auto", INTERFACE])
async def test_a_robot_whose_address_changes_is_found_again(tmp_path: Path, interface: str) -> None:
    needs_namespaces()
    with hosts(2) as machines:
        async with running(tmp_path, machines, interface) as robots:
            await reached(robots, lambda: meet(robots), MEET_S, "both hear each other")
            machines[1].lose_address()
            await reached(robots, lambda: not neighbours(robots[0]), MEET_S, "r2 is gone")
            machines[1].get_address(OTHER_NUMBER)
            await reached(robots, lambda: meet(robots), MEET_S, "both hear each other again")
