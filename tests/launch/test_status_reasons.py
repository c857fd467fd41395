"""Why a swarm is silent, over real zenoh: it is late, it wants an operator's keys, or nobody is there."""

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.agent.runtime.loopback import free_ports, loopback_configs

from flocc_agent.config import TlsConfig, TransportConfig
from flocc_agent.runtime.zenoh_transport import ZenohTransport
from flocc_launch.dashboard.status_table import NO_ANSWER, RobotStatus, StatusError, status_of_swarm
from flocc_launch.doctor.live import diagnose_live
from flocc_launch.setup.credentials import make_keys
from flocc_protocol.keys import Admin

pytestmark = [pytest.mark.swarm, pytest.mark.beside]


def agent(config: TransportConfig, robot: str = "r1", answer: bytes = b'{"keyframes": 7}') -> ZenohTransport:
    transport = ZenohTransport("test", robot, config)
    transport.serve_admin(Admin.STATUS, lambda _: answer)
    return transport


async def asked(config: TransportConfig, timeout_s: float = 5.0) -> list[RobotStatus]:
    return await asyncio.to_thread(status_of_swarm, config, "test", timeout_s)


def asked_of_a_blocked_loop(config: TransportConfig, timeout_s: float, blocked_s: float) -> Callable[[], object]:
    """Ask on a thread, and hold up the event loop that should answer; gives what came of it."""
    came: list[object] = []

    def ask() -> None:
        try:
            came.append(status_of_swarm(config, "test", timeout_s))
        except StatusError as error:
            came.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    time.sleep(blocked_s)

    def result() -> object:
        thread.join()
        return came[0]

    return result


async def test_an_agent_that_is_late_is_asked_a_second_time() -> None:
    config = loopback_configs(("r1",))["r1"]
    async with agent(config):
        result = asked_of_a_blocked_loop(config, timeout_s=2.0, blocked_s=2.5)
        found = await asyncio.to_thread(result)
    assert isinstance(found, list), found
    assert [(row.robot, row.keyframes) for row in found] == [("r1", 7)]


async def test_agents_that_are_there_and_never_answer_are_named() -> None:
    config = loopback_configs(("r1",))["r1"]
    async with agent(config):
        found = asked_of_a_blocked_loop(config, timeout_s=0.5, blocked_s=6.0)()
    assert isinstance(found, StatusError), found
    assert "swarm test: r1 is there, but did not answer within 0.5 s, asked twice" in str(found)
    assert "--timeout" in str(found)


async def test_of_two_the_one_that_is_late_stands_in_the_table_and_in_the_doctor() -> None:
    configs = loopback_configs(("r1", "r2"))
    silent = ZenohTransport("test", "r2", configs["r2"])
    async with agent(configs["r1"]), silent:
        rows = await asked(configs["r1"], 0.5)
    assert [(row.robot, row.state) for row in rows] == [("r1", "running"), ("r2", NO_ANSWER)]
    findings = {finding.cause: finding.robots for finding in diagnose_live(rows)}
    assert findings["no-answer"] == ("r2",)
    assert "no-keyframes" not in findings


async def test_a_robot_that_only_a_neighbour_hears_stands_in_the_table() -> None:
    config = loopback_configs(("r1",))["r1"]
    async with agent(config, answer=b'{"neighbours": ["r2"]}'):
        rows = await asked(config, 0.5)
    assert [(row.robot, row.state) for row in rows] == [("r1", "running"), ("r2", NO_ANSWER)]


async def test_an_agent_that_starts_late_is_waited_for() -> None:
    config = loopback_configs(("r1",))["r1"]
    asking = asyncio.create_task(asked(config, 3.0))
    await asyncio.sleep(3.5)  # as long as an interpreter takes to start on a busy machine; the claim is about time
    async with agent(config):
        assert [row.robot for row in await asking] == ["r1"]


async def test_another_swarm_is_named_where_the_one_asked_for_is_not_there() -> None:
    config = loopback_configs(("r1",))["r1"]
    async with agent(config):
        with pytest.raises(StatusError, match=r"swarm tets: nobody is there: .* \(there: swarm test\)"):
            await asyncio.to_thread(status_of_swarm, config, "tets", 0.5)


async def test_a_robots_keys_are_not_an_operators(tmp_path: Path) -> None:
    folders = make_keys(tmp_path / "keys", "test", ("r1", "r2"))
    config = loopback_configs(("r1",), tls=TlsConfig(folder=folders["r1"]))["r1"]
    async with agent(config):
        with pytest.raises(StatusError, match=r"they answer only to operators, and .*/r2 holds a robot's keys"):
            await asked(config.model_copy(update={"tls": TlsConfig(folder=folders["r2"])}), 1.0)
        rows = await asked(config.model_copy(update={"tls": TlsConfig(folder=folders["operator"])}))
    assert [(row.robot, row.keyframes) for row in rows] == [("r1", 7)]


async def test_a_swarm_with_keys_is_recognised_without_any(tmp_path: Path) -> None:
    """By scouting: the group is one of this test alone."""
    folders = make_keys(tmp_path / "keys", "test", ("r1",))
    scouted = {"multicast": True, "multicast_address": f"224.0.0.224:{free_ports(1)[0]}", "interface": "lo"}
    config = loopback_configs(("r1",), tls=TlsConfig(folder=folders["r1"]), **scouted)["r1"]
    async with agent(config):
        bare = TransportConfig(control_listen=("tcp/127.0.0.1:0",), gossip=False, **scouted)
        with pytest.raises(StatusError, match="they answer only to operators, and no keys were given"):
            await asked(bare, 0.5)
