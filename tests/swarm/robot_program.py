"""A robot's own program on the public API: synthetic images along a circle, its state as JSON lines on stdout.

Usage: CONFIG.json KEYFRAMES PERIOD_S PHASE_RAD. Runs until its standard input ends. Robots of one circle meet.
"""

import asyncio
import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.agent import Agent
from flocc_agent.config import AgentConfig
from flocc_agent.core.interfaces import Camera
from flocc_agent.perception.synthetic import pose_image

RADIUS_M = 6.0
STEP_RAD = 0.12
STATUS_PERIOD_S = 0.1
ORIGIN_RAD = -0.5
"""Before all phases (modulo a turn): odometry that were at its origin after a restart would be a new journey."""
ORIGINS_APART_RAD = 0.35
CAMERA = Camera(128, 1, 100.0, 100.0, 64.0, 0.5)


def T_world_camera_at(angle_rad: float) -> NDArray[np.float64]:
    """Camera on the circle, looking ahead; z forward, y down."""
    forward = np.array([-math.sin(angle_rad), math.cos(angle_rad), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([np.cross(down, forward), down, forward])
    T[:3, 3] = RADIUS_M * np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
    return T


async def drive(agent: Agent, name: str, keyframes: int, period_s: float, phase_rad: float) -> None:
    """Give the agent its keyframes; its odometry goes on over restarts, in a frame of this robot's own."""
    origin_rad = ORIGIN_RAD - ORIGINS_APART_RAD * (sum(name.encode()) % 5)
    T_odom_world = np.linalg.inv(T_world_camera_at(origin_rad))
    for index in range(keyframes):
        T_world_camera = T_world_camera_at(phase_rad + STEP_RAD * index)
        image = pose_image(T_world_camera, f"{name}/{index}")
        await agent.add_keyframe(image.pixels, T_odom_world @ T_world_camera, index * period_s)
        await asyncio.sleep(period_s)


async def tell(agent: Agent) -> None:
    """Print the agent's state again and again."""
    while True:
        print(agent.status().model_dump_json(), flush=True)
        await asyncio.sleep(STATUS_PERIOD_S)


async def main(path: Path, keyframes: int, period_s: float, phase_rad: float) -> None:
    """Be a robot."""
    config = AgentConfig.model_validate_json(path.read_text(encoding="utf-8"))
    async with Agent(config, CAMERA) as agent:
        tasks = [
            asyncio.create_task(drive(agent, config.name, keyframes, period_s, phase_rad)),
            asyncio.create_task(tell(agent)),
        ]
        await asyncio.to_thread(sys.stdin.read)
        for task in tasks:
            task.cancel()


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])))
