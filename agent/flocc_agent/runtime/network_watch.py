"""What an agent says of its network while it runs: how others are found, what is not there, when nobody is heard."""

import asyncio
import logging
from collections.abc import Callable, Collection

from flocc_agent.config import AgentConfig
from flocc_agent.runtime.certificate_faults import certificate_faults
from flocc_agent.runtime.network_faults import found_by, lacks_name, network_faults

logger = logging.getLogger(__name__)

SILENCE_S = 60.0
"""How often an agent looks whether it hears anybody."""


def say_how_others_are_found(config: AgentConfig) -> None:
    """A robot that nobody can find is no mere information: a program without logging shows warnings alone."""
    transport, swarm = config.transport, config.swarm
    level = logging.WARNING if lacks_name(transport, swarm) and not transport.roster else logging.INFO
    logger.log(level, "robot %s: %s", config.name, found_by(transport, swarm))


async def look_at_network(config: AgentConfig, heard: Callable[[], Collection[str]]) -> None:
    """Say once what of the configured network is not there, and when nobody is heard; the agent goes on trying.

    Args:
        config: The agent's.
        heard: The robots in range now.
    """
    for fault in await asyncio.to_thread(network_faults, config.transport, config.name):
        logger.warning("%s: %s", config.name, fault)
    is_silent = False
    while True:
        await asyncio.sleep(SILENCE_S)
        was_silent, is_silent = is_silent, not heard()
        if is_silent and not was_silent:
            logger.warning("%s: hears nobody; 'flocc doctor' looks at the network", config.name)
            if lacks_name(config.transport, config.swarm):
                say_how_others_are_found(config)
            for fault in await asyncio.to_thread(lambda: [*certificate_faults(config.transport.tls)]):
                logger.warning("%s: %s", config.name, fault)
