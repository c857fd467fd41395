"""Robot processes of swarm tests: start, watch, kill, wait; on loopback or each in a network namespace."""

import asyncio
import json
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from flocc_agent.config import AgentConfig, PerceptionConfig, TransportConfig

PROGRAM = Path(__file__).with_name("robot_program.py")
CLOSE_TIMEOUT_S = 15.0


class RobotProcess:
    """One robot's process and the state that it told last."""

    def __init__(self, config: AgentConfig, folder: Path, prefix: tuple[str, ...] = ()) -> None:
        self.config = config
        self.status: dict[str, Any] = {}
        self.heard_s = 0.0
        self._folder = folder
        self._prefix = prefix
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None

    async def start(self, keyframes: int = 40, period_s: float = 0.25, phase_rad: float = 0.0) -> None:
        """Start, or start again after a kill."""
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / f"{self.config.name}.json"
        path.write_text(self.config.model_dump_json(exclude_unset=True), encoding="utf-8")
        with (self._folder / f"{self.config.name}.log").open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                *self._prefix,
                sys.executable,
                str(PROGRAM),
                str(path),
                str(keyframes),
                str(period_s),
                str(phase_rad),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
            )
        self.status = {}
        self._reader = asyncio.create_task(self._read(self._process))

    async def _read(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None
        while line := await process.stdout.readline():
            self.status, self.heard_s = json.loads(line), time.monotonic()

    async def kill(self) -> None:
        """End it with SIGKILL."""
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
            await self._process.wait()

    async def close(self) -> int | None:
        """Let it end in order, and give its exit status; None when it had to be killed."""
        if self._process is None or self._reader is None:
            return None
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await self._process.wait()
        except TimeoutError:
            await self.kill()
            return None
        await self._reader
        return self._process.returncode

    def log(self) -> str:
        """What it wrote to standard error."""
        return (self._folder / f"{self.config.name}.log").read_text(encoding="utf-8")


def agent_configs(transports: dict[str, TransportConfig], folder: Path, **options: Any) -> dict[str, AgentConfig]:
    """Configurations for robots with synthetic perception, each with a store."""
    return {
        name: AgentConfig(
            name=name,
            swarm="test",
            incarnation=0,
            folder=folder / name,
            perception=PerceptionConfig(method="synthetic"),
            transport=transport,
            **options,
        )
        for name, transport in transports.items()
    }


async def reached(robots: Iterable[RobotProcess], is_true: Callable[[], bool], timeout_s: float, what: str) -> float:
    """Wait until something is true, and give the seconds that it took; the robots' states are told when it is not."""
    began_s = time.monotonic()
    try:
        async with asyncio.timeout(timeout_s):
            while not is_true():
                await asyncio.sleep(0.02)
    except TimeoutError:
        states = "\n".join(f"{robot.config.name}: {robot.status}" for robot in robots)
        raise AssertionError(f"not within {timeout_s} s: {what}\n{states}") from None
    return time.monotonic() - began_s


def leaders(robots: Iterable[RobotProcess]) -> set[object]:
    """Whom the robots follow."""
    return {robot.status.get("leader") for robot in robots}


def frames(robots: Iterable[RobotProcess]) -> set[object]:
    """The robots' map frames."""
    return {robot.status.get("map_frame") for robot in robots}


def logs_equal(robots: Iterable[RobotProcess]) -> bool:
    """Whether all robots hold the same logs."""
    held = [robot.status.get("logs") for robot in robots]
    return held[0] is not None and all(logs == held[0] for logs in held)


def neighbours(robot: RobotProcess) -> set[str]:
    """Whom a robot hears."""
    return set(robot.status.get("neighbours") or ())
