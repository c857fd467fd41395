"""A robot's own program: keyframes in, corrections out.

    python examples/robot_program.py --name r1 RECORDING        on one terminal
    python examples/robot_program.py --name r2 RECORDING        on another one

A robot would take images from its camera and poses from its odometry; this program takes both from a recording.
"""

import argparse
import asyncio
from pathlib import Path

import numpy as np

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import TransportConfig
from flocc_agent.runtime.recording import Recording

WAITING_PERIOD_S = 2.0


async def print_corrections(agent: Agent) -> None:
    """Apply corrections as they come; a changed frame means that every pose jumps."""
    async for correction in agent.corrections():
        position_m = np.round(correction.T_map_odom[:3, 3], 3).tolist()
        jump = " (new map frame)" if correction.frame_changed else ""
        print(f"{correction.map_frame}{jump} round {correction.round}: odom is at {position_m} m", flush=True)  # noqa: T201


async def print_waiting(agent: Agent, period_s: float = WAITING_PERIOD_S) -> None:
    """Say now and then how far it is while no correction has come, so that silence is not taken for a fault."""
    while True:
        status = agent.status()
        if status.round is None:
            count = f"{status.keyframes} keyframes, {len(status.neighbours)} neighbours"
            print(f"no correction yet: {count}", flush=True)  # noqa: T201
        await asyncio.sleep(period_s)


async def main() -> None:
    """Feed every frame of a recording to an agent, at the speed it was taken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--name", required=True, help="unique in the swarm")
    parser.add_argument("--rate", type=float, default=1.0, help="speed")
    parser.add_argument("--linger", type=float, default=10.0, help="seconds to stay after the last frame")
    arguments = parser.parse_args()

    recording = Recording.open(arguments.recording)
    config = AgentConfig(name=arguments.name, swarm="team", transport=TransportConfig(interface="lo"))
    async with Agent(config, recording.camera, recording.T_body_camera) as agent:
        printing = [asyncio.create_task(say(agent)) for say in (print_corrections, print_waiting)]
        stamp_s = recording.frames[0].stamp_s
        for frame in recording.frames:
            await asyncio.sleep((frame.stamp_s - stamp_s) / arguments.rate)
            stamp_s = frame.stamp_s
            image = recording.load_image(frame)  # (H, W, 3) uint8, RGB
            await agent.add_frame(image.pixels, frame.T_odom_body, frame.stamp_s)  # (4, 4), metres
        await asyncio.sleep(arguments.linger)
        for task in printing:
            task.cancel()


if __name__ == "__main__":
    asyncio.run(main())
