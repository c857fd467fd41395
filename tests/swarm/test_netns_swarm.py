"""Claims on whole agents, each in a network namespace with an address of its own. Needs root; skipped otherwise."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from tests.swarm.namespaces import INTERFACE, Host, hosts, needs_namespaces
from tests.swarm.robots import RobotProcess, agent_configs, frames, leaders, logs_equal, neighbours, reached

from flocc_agent.config import PeerEndpoints, TransportConfig

pytestmark = [pytest.mark.swarm, pytest.mark.root, pytest.mark.slow]

NAMES = ("r1", "r2", "r3")
CONTROL_PORT, BULK_PORT = 7447, 7448
NEIGHBOUR_TIMEOUT_S = 3.0
OUTAGE_S = 30.0


def namespace_configs(machines: Sequence[Host], multicast: bool = False) -> dict[str, TransportConfig]:
    """Robots that know each other's addresses, and with multicast also find each other elsewhere."""
    roster = {
        name: PeerEndpoints(control=(f"tcp/{host.address}:{CONTROL_PORT}",), bulk=(f"tcp/{host.address}:{BULK_PORT}",))
        for name, host in zip(NAMES, machines, strict=False)
    }
    return {
        name: TransportConfig(
            control_listen=peer.control,
            bulk_listen=peer.bulk,
            roster=roster,
            multicast=multicast,
            gossip=multicast,
            interface=INTERFACE,
        )
        for name, peer in roster.items()
    }


@asynccontextmanager
async def running(folder: Path, machines: Sequence[Host], multicast: bool = False) -> AsyncIterator[list[RobotProcess]]:
    """Three robots on three hosts that follow one leader in one frame, with everything known to all."""
    configs = agent_configs(namespace_configs(machines, multicast), folder)
    robots = [
        RobotProcess(configs[name], folder / "logs", host.prefix) for name, host in zip(NAMES, machines, strict=False)
    ]
    try:
        await asyncio.gather(*(robot.start(15, phase_rad=0.6 * i) for i, robot in enumerate(robots)))
        await reached(robots, lambda: frames(robots) == {"map/r1"} and leaders(robots) == {"r1"}, 90.0, "one frame")
        yield robots
    finally:
        await asyncio.gather(*(robot.close() for robot in robots))


def all_hear_all(robots: Sequence[RobotProcess]) -> bool:
    return all(neighbours(robot) == {*NAMES} - {robot.config.name} for robot in robots)


async def hear_each_other(robots: Sequence[RobotProcess], duration_s: float) -> None:
    """Robots hear each other all the time; closing the links to a robot that is gone must not silence the others."""
    names = {robot.config.name for robot in robots}
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(duration_s):
            while True:
                for robot in robots:
                    assert neighbours(robot) == names - {robot.config.name}, robot.status
                await asyncio.sleep(0.02)


async def test_a_cable_pulled_for_30_s_splits_the_swarm_and_heals(tmp_path: Path) -> None:
    needs_namespaces()
    with hosts(3) as machines:
        async with running(tmp_path, machines) as robots:
            first, *rest = robots
            machines[0].pull_cable()
            noticed_s = await reached(
                robots,
                lambda: neighbours(first) == set() and all("r1" not in neighbours(robot) for robot in rest),
                3 * NEIGHBOUR_TIMEOUT_S,
                "both sides notice by heartbeats",
            )
            await reached(robots, lambda: leaders(rest) == {"r2"} and leaders([first]) == {"r1"}, 10.0, "two leaders")
            await hear_each_other(rest, OUTAGE_S - noticed_s)
            machines[0].plug_cable()
            await reached(robots, lambda: all_hear_all(robots), 10.0, "all hear all again")
            await reached(
                robots, lambda: leaders(robots) == {"r1"} and logs_equal(robots), 10.0, "one leader, equal logs"
            )
            assert frames(robots) == {"map/r1"}


@pytest.mark.beside
async def test_20_percent_packet_loss_loses_no_record(tmp_path: Path) -> None:
    needs_namespaces("iptables")
    with hosts(3) as machines:
        for machine in machines:
            machine.lose(0.2)
        async with running(tmp_path, machines) as robots:
            await reached(
                robots,
                lambda: (
                    logs_equal(robots)
                    and all(robot.status["keyframes"] == 15 and not robot.status["busy"] for robot in robots)
                ),
                60.0,
                "all know all",
            )
            assert leaders(robots) == {"r1"}


@pytest.mark.beside
async def test_a_one_way_link_is_survived(tmp_path: Path) -> None:
    """r2 no longer hears r3; both still hear r1, through which records keep flowing."""
    needs_namespaces("iptables")
    with hosts(3) as machines:
        async with running(tmp_path, machines) as robots:
            machines[1].deafen(machines[2].address)
            await reached(robots, lambda: "r3" not in neighbours(robots[1]), 15.0, "r2 lost r3")
            await reached(
                robots,
                lambda: logs_equal(robots) and all(robot.status["keyframes"] == 15 for robot in robots),
                30.0,
                "all know all through r1",
            )
            assert leaders(robots) == {"r1"}


@pytest.mark.beside
async def test_a_robot_moves_to_another_host(tmp_path: Path) -> None:
    """r1, whom everybody dials, comes back from its disk at an address that nobody has on the roster."""
    needs_namespaces()
    with hosts(4) as machines:
        async with running(tmp_path, machines, multicast=True) as robots:
            first = robots[0]
            known = first.status["logs"]["r1"][0]
            await first.kill()
            await reached(robots[1:], lambda: leaders(robots[1:]) == {"r2"}, 10.0, "r2 leads")
            moved = first.config.transport.model_copy(
                update={
                    "control_listen": (f"tcp/{machines[3].address}:{CONTROL_PORT}",),
                    "bulk_listen": (f"tcp/{machines[3].address}:{BULK_PORT}",),
                }
            )
            config = first.config.model_copy(update={"transport": moved})
            robots[0] = RobotProcess(config, tmp_path / "logs", machines[3].prefix)
            await robots[0].start(5, phase_rad=2.0)
            await reached(robots, lambda: all_hear_all(robots) and leaders(robots) == {"r1"}, 30.0, "all hear r1 again")
            await reached(
                robots,
                lambda: logs_equal(robots) and robots[0].status["logs"]["r1"][0] >= known + 5,
                30.0,
                "its log goes on",
            )
            assert set(robots[0].status["logs"]) == set(NAMES)
