"""Makes the store beside it: two robots of commit 04961b5 that merged their maps; r2's store is kept.

git worktree add /tmp/old 04961b5 && cd /tmp/old
PYTHONPATH=.:protocol:agent:launch python .../store_04961b5/make.py FOLDER     # then FOLDER/r2/store/robot.sqlite
"""

import asyncio
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tests.agent.runtime.loopback import loopback_configs
from tests.swarm.robots import agent_configs

from flocc_agent import Agent
from flocc_agent.geometry import pose
from flocc_agent.perception.synthetic import pose_image

KEYFRAMES = 12


def T_on_circle(k: int, phase_rad: float) -> NDArray[np.float64]:
    """Pose on a circle of 4 m."""
    a = 2 * np.pi * k / 20 + phase_rad
    R = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
    return pose(R, np.array([4 * np.cos(a), 4 * np.sin(a), 0.0]))


async def main(folder: Path) -> None:
    """Run both until their maps are one."""
    configs = agent_configs(loopback_configs(("r1", "r2")), folder)
    camera = pose_image(np.eye(4), "x").camera
    async with Agent(configs["r1"], camera) as a, Agent(configs["r2"], camera) as b:
        for k in range(KEYFRAMES):
            for name, agent, phase_rad in (("r1", a, 0.0), ("r2", b, 0.3)):
                T_world = T_on_circle(k, phase_rad)
                T_odom = np.linalg.inv(T_on_circle(0, phase_rad)) @ T_world
                await agent.add_keyframe(pose_image(T_world, f"{name}/{k}").pixels, T_odom, 10.0 + k)
            a.add_fix(np.array([float(k), 0, 0]), np.eye(3))
            await asyncio.sleep(0.25)
        async with asyncio.timeout(60.0):
            while not _is_merged(a, b):
                await asyncio.sleep(0.1)


def _is_merged(a: Agent, b: Agent) -> bool:
    first: Any = a.status()  # a dictionary in that commit
    second: Any = b.status()
    idle = not first["busy"] and not second["busy"]
    return bool(first["map_frame"] == second["map_frame"] == "map/r1" and first["logs"] == second["logs"] and idle)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1])))
