"""A ROS 2 robot in a process of its own that speaks only rmw_zenoh's documented form, and `flocc agent` beside it."""

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from tests.agent.runtime.loopback import free_ports, until

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
CONFIG = """
name = "r1"
folder = "r1"

[keyframes]
distance_m = 0.25

[transport]
control_listen = ["tcp/127.0.0.1:0"]
bulk_listen = ["tcp/127.0.0.1:0"]
multicast = false
gossip = false

[ros2]
router = "tcp/127.0.0.1:PORT"
"""


class Robot:
    """The process, and what it told last."""

    def __init__(self) -> None:
        self.heard: dict[str, Any] = {}


@asynccontextmanager
async def robot(port: int) -> AsyncIterator[Robot]:
    """A robot that drives; nothing of flocc is in its process."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.swarm.ros2_robot", str(port)),
        cwd=ROOT,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        limit=2**20,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    told = Robot()

    async def read(lines: asyncio.StreamReader) -> None:
        while line := await lines.readline():
            told.heard = json.loads(line)

    reading = asyncio.create_task(read(process.stdout))
    try:
        yield told
    finally:
        process.stdin.close()
        assert await asyncio.wait_for(process.wait(), 15.0) == 0
        await reading


def has_seen_enough(heard: dict[str, Any]) -> bool:
    """Whether a path of some length came, and transforms for a while."""
    return len(heard.get("path", ())) >= 8 and heard["transforms"] > 20


async def test_a_robot_without_flocc_code_gets_transform_pose_and_path(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    config = tmp_path / "r1.toml"
    config.write_text(CONFIG.replace("PORT", str(port)))
    command = [sys.executable, "-m", "flocc_launch.commands.main", "agent", "--config", str(config)]
    with (tmp_path / "agent.log").open("wb") as log:
        agent = subprocess.Popen(command, stderr=log)
        try:
            async with robot(port) as driving:
                await until(lambda: has_seen_enough(driving.heard), 60.0)
                heard = driving.heard
        finally:
            agent.send_signal(signal.SIGTERM)
            status = await asyncio.to_thread(agent.wait, 20.0)
    said = (tmp_path / "agent.log").read_text()
    assert status == 0, said
    assert "Traceback" not in said
    assert heard["nodes"] == ["driver", "flocc_r1"]
    assert heard["frames"] == [["map", "odom"]]
    assert heard["numbers_in_order"]
    assert heard["gids_are_of_tokens"]
    assert heard["T_map_odom"] == pytest.approx([0, 0, 0, 0, 0, 0, 1], abs=1e-6)
    assert heard["position"][0] == pytest.approx(heard["x_m"], abs=0.5)
    steps_m = [b[0] - a[0] for a, b in zip(heard["path"], heard["path"][1:], strict=False)]
    assert all(0.2 < step_m < 0.45 for step_m in steps_m), heard["path"]
    aside_m = [abs(value) for _, y, z in heard["path"] for value in (y, z)]
    assert max(aside_m) < 1e-5
    assert len(heard["map_frames"]) >= 1
    assert heard["map_frames"][0].startswith("map/r1")
    events = [json.loads(line) for line in (tmp_path / "r1" / "events.jsonl").read_text().splitlines()]
    assert [e["connected"] for e in events if e["event"] == "ros2_router"][:1] == [True]
    assert [e["sentence"] for e in events if e["event"] == "ros2_problem"] == []
    keyframes = json.loads((tmp_path / "r1" / "result.json").read_text())["keyframes"]
    assert len(keyframes) >= len(heard["path"])
    assert keyframes[0]["T_odom_body"][1:] == pytest.approx([0, 0, 1, 0, 0, 0], abs=1e-5)
