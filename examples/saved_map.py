"""A map saved and reopened: one robot's day, and another robot that finds itself in it the next day.

    python examples/saved_map.py FOLDER

Both see a made-up place through synthetic perception, so that it runs anywhere in seconds; with a camera, leave out
`perception` and give `add_frame` its images. Everything else is what a program on a robot does.
"""

import asyncio
import sys
from pathlib import Path

import numpy as np

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import PerceptionConfig, TransportConfig
from flocc_agent.geometry import between, pose, so3_exp
from flocc_agent.perception.synthetic import pose_image
from flocc_launch.maps.map_saving import save_map

ALONE = TransportConfig(
    control_listen=("tcp/127.0.0.1:0",), bulk_listen=("tcp/127.0.0.1:0",), multicast=False, gossip=False
)
CAMERA = pose_image(np.eye(4), "any").camera


def way(k: int) -> np.ndarray:
    """Where a robot truly is at its step k: around a bend, (4, 4)."""
    return pose(so3_exp(np.array([0.0, 0.0, 0.06 * k])), np.array([0.7 * k, 0.02 * k * k, 0.0]))


async def walk(agent: Agent, steps: range, day: str) -> None:
    """Give what the robot sees; its odometry begins at the identity, wherever it starts."""
    for n, k in enumerate(steps):
        pixels = pose_image(way(k), f"{day}/{k}").pixels  # (1, 128, 3) uint8; yours are a camera's
        await agent.add_frame(pixels, between(way(steps[0]), way(k)), stamp_s=float(n))


def config(name: str, **given: object) -> AgentConfig:
    """One robot without others in range."""
    return AgentConfig(name=name, transport=ALONE, perception=PerceptionConfig(method="synthetic"), **given)


async def monday(folder: Path) -> None:
    """A robot walks, and its folder keeps everything."""
    async with Agent(config("r1", folder=folder, incarnation=0), CAMERA) as agent:
        await walk(agent, range(16), "monday")
        async for correction in agent.corrections():
            if len(correction.own) == 16:
                return


async def tuesday(town: Path) -> None:
    """Another robot starts somewhere in that map, and says where it is."""
    async with Agent(config("r2", map=town), CAMERA, map_fixed=True) as agent:
        await walk(agent, range(5, 15), "tuesday")
        async for correction in agent.corrections():
            print(f"in {correction.map_frame} after {len(correction.own)} keyframes")  # noqa: T201
            if correction.map_frame == "map/r1":
                apart_m = np.linalg.norm((correction.T_map_odom - way(5))[:3, 3])  # way(5) is where its odometry began
                print(f"it started {apart_m:.2f} m from where it truly did")  # noqa: T201
                assert apart_m < 0.5
                return


def main(folder: Path) -> None:
    """Both days, and the map between them."""
    asyncio.run(monday(folder / "r1"))
    manifest = save_map(folder / "r1", folder / "town")
    print(f"saved {manifest.frame}: {manifest.latents} places in {folder / 'town'}")  # noqa: T201
    asyncio.run(tuesday(folder / "town"))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/saved_map.py FOLDER")
    main(Path(sys.argv[1]))
