"""`flocc map save --swarm`: one more agent, without a camera, that copies all logs and latents of a running swarm."""

import asyncio
import tempfile
from collections.abc import Callable
from pathlib import Path

from flocc_agent.agent import Agent
from flocc_agent.config import AgentConfig, SourceConfig
from flocc_agent.runtime.map_folder import MapManifest
from flocc_launch.maps.map_saving import save_map
from flocc_launch.maps.writing import check_target
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId
from flocc_protocol.records import KeyframeRecord

HARVESTER = "zz-map-saver"
"""A name that no election prefers."""
FOUND_WITHIN_S = 10.0
QUIET_S = 2.0
"""Logs that did not grow for this long are whole, or as whole as those of robots that go on."""
CAUGHT_UP_WITHIN_S = 120.0
FETCH_S = 20.0
LOOK_S = 0.1
AT_ONCE = 4
"""Fetches at one time."""

Progress = Callable[[int, int], None]


class HarvestFailed(FloccError):
    """A swarm that could not be copied."""


def save_swarm(
    config: AgentConfig,
    out: Path,
    name: str | None = None,
    frame: str | None = None,
    progress: Progress | None = None,
    sees_alike: bool = True,
) -> MapManifest:
    """Copy what a running swarm knows, and save it as a map; the swarm goes on.

    Args:
        config: How to reach it. Where it has keys, the name and keys of a member that does not run now.
        out: Folder of the map.
        name: As of `save_map`.
        frame: As of `save_map`.
        progress: Told of (latents copied, all).
        sees_alike: The configuration's front end is the swarm's; else the map does not say which one made it.

    Raises:
        FloccError: Nobody is there, or there is no map of what they know.
    """
    check_target(out)
    with tempfile.TemporaryDirectory(prefix="flocc-map-", dir=out.resolve().parent) as scratch:
        secured = config.transport.tls is not None
        given = {"folder": Path(scratch), "compute_class": 0, "ros2": None, "map": None, "source": SourceConfig()}
        joining = config.model_copy(update={**given, **({} if secured else {"name": HARVESTER})})
        asyncio.run(_copied(joining, progress or (lambda _, __: None)))
        return save_map(Path(scratch), out, name, frame, sees_alike)


async def _copied(config: AgentConfig, progress: Progress) -> None:
    """Join, catch up, fetch every latent whose owner is there, leave."""
    async with Agent(config) as agent:
        await _until(lambda: bool(agent.status().neighbours), FOUND_WITHIN_S, f"swarm {config.swarm}: nobody is there")
        await _caught_up(agent)
        wanted = [k for k in _described(agent) if k.log.robot in agent.status().neighbours]
        done = 0
        for first in range(0, len(wanted), AT_ONCE):
            part = wanted[first : first + AT_ONCE]
            await asyncio.gather(*(agent.fetch_latent(keyframe, FETCH_S) for keyframe in part))
            done += len(part)
            progress(done, len(wanted))


async def _caught_up(agent: Agent) -> None:
    """Wait until its copies of logs have stopped growing."""
    loop = asyncio.get_running_loop()
    ends_s, since_s = loop.time() + CAUGHT_UP_WITHIN_S, loop.time()
    seen: dict[str, tuple[int, int]] = {}
    while loop.time() < ends_s and loop.time() - since_s < QUIET_S:
        logs = agent.status().logs
        if logs != seen:
            seen, since_s = logs, loop.time()
        await asyncio.sleep(LOOK_S)


async def _until(there: Callable[[], bool], within_s: float, otherwise: str) -> None:
    loop = asyncio.get_running_loop()
    ends_s = loop.time() + within_s
    while not there():
        if loop.time() >= ends_s:
            raise HarvestFailed(otherwise)
        await asyncio.sleep(LOOK_S)


def _described(agent: Agent) -> list[KeyframeId]:
    """Keyframes of all logs; those that were not encoded have no latent, and their fetch says so."""
    return [
        KeyframeId(log, record.index)
        for log, copy in sorted(agent.robot.gossip.logs.items())
        for record in copy.records
        if isinstance(record, KeyframeRecord)
    ]
