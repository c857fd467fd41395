"""Two teams on one network segment that configured nothing: neither hears the other. With a name robots meet."""

import asyncio
import logging
from pathlib import Path

import pytest
from tests.agent.runtime.loopback import free_ports
from tests.agent.runtime.test_agent_api import camera

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import PeerEndpoints, PerceptionConfig, TlsConfig, TransportConfig
from flocc_agent.runtime.network_faults import found_by

pytestmark = [pytest.mark.swarm, pytest.mark.beside]

MEETING_S = 15.0


def config(name: str, group: int, **swarm: str) -> AgentConfig:
    """Of a group of this test alone, since other tests look for swarms, too."""
    transport = TransportConfig(interface="lo", multicast_address=f"224.0.0.224:{group}")
    return AgentConfig(name=name, transport=transport, perception=PerceptionConfig(method="synthetic"), **swarm)


async def meeting_takes_s(one: AgentConfig, other: AgentConfig, at_most_s: float) -> float | None:
    """How long two robots take to hear each other; None where they do not."""
    async with Agent(one, camera()) as first, Agent(other, camera()) as second:
        began_s = asyncio.get_running_loop().time()
        while asyncio.get_running_loop().time() < began_s + at_most_s:
            if first.robot.neighbours.names() and second.robot.neighbours.names():
                return asyncio.get_running_loop().time() - began_s
            await asyncio.sleep(0.1)
        assert not first.robot.neighbours.names()
        assert list(first.robot.gossip.logs) == [first.log]
        return None


async def test_two_teams_that_nobody_configured_stay_two() -> None:
    (group,) = free_ports(1)
    named = await meeting_takes_s(config("r1", group, swarm="yard"), config("r2", group, swarm="yard"), MEETING_S)
    assert named is not None
    assert await meeting_takes_s(config("r1", group), config("r2", group), 3.0 * named) is None


async def test_the_first_line_of_the_log_says_how_others_are_found(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):  # what a program without logging shows
        async with Agent(config("r1", 7999), camera()):
            pass
    assert caplog.messages[0] == (
        'robot r1: swarm swarm: waits for others to dial it; the swarm has no name (swarm = "..."), '
        "so that it looks for nobody by multicast"
    )


def test_a_roster_and_keys_need_no_name() -> None:
    peer = PeerEndpoints(control=("tcp/10.0.0.1:7450",), bulk=("tcp/10.0.0.1:7451",))
    listed = TransportConfig(roster={"r1": peer}, multicast=False)
    assert found_by(listed, "swarm") == "swarm swarm: others are found at the addresses of 1 robots (transport.roster)"
    secured = TransportConfig(tls=TlsConfig(folder=Path("keys")))
    assert found_by(secured, "swarm") == "swarm swarm: others are found by multicast (224.0.0.224:7446)"
