"""N agent processes on this machine: start, watch, give orders, stop in order, leave none behind."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from flocc_agent.config import AgentConfig, PeerEndpoints, TlsConfig, TransportConfig
from flocc_agent.runtime.status import AgentStatus

STOP_TIMEOUT_S = 20.0
LOG_TAIL_LINES = 5


@dataclass(slots=True)
class AgentProcess:
    """One agent's process and what it said last.

    Attributes:
        config: Its configuration.
        map_fixed: The map in which it works does not move.
        folder: Where its files are.
        process: The process, None before it was started.
        status: Its last state, None before the first.
        heard_s: When that came, on the monotonic clock.
        asked: Whether it was told to stop or killed on purpose.
        exit_code: How it ended; negative for a signal.
    """

    config: AgentConfig
    folder: Path
    process: asyncio.subprocess.Process | None = None
    status: AgentStatus | None = None
    heard_s: float = 0.0
    asked: bool = False
    exit_code: int | None = None
    reader: asyncio.Task[None] | None = None
    map_fixed: bool = False

    @property
    def name(self) -> str:
        """The robot's name."""
        return self.config.name

    @property
    def said(self) -> AgentStatus:
        """Its last state; before the first one, that it holds nothing."""
        return self.status or AgentStatus(robot=self.name)

    @property
    def running(self) -> bool:
        """Whether the process lives."""
        return self.process is not None and self.exit_code is None

    async def start(self, epoch_s: float) -> None:
        """Start the process; its log goes to `agent.log` in its folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / "config.json"
        path.write_text(self.config.model_dump_json(indent=1), encoding="utf-8")
        command = [sys.executable, "-m", "flocc_launch.swarm.agent_process", str(path), "--epoch-s", repr(epoch_s)]
        command += ["--map-fixed"] if self.map_fixed else []
        with (self.folder / "agent.log").open("ab") as log:
            self.process = await asyncio.create_subprocess_exec(
                *command,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                start_new_session=True,
                limit=4 * 1024 * 1024,
            )
        self.exit_code, self.asked, self.status = None, False, None
        self.reader = asyncio.create_task(self._read())

    async def order(self, order: dict[str, Any]) -> None:
        """Send an order; an agent that is gone does not mind."""
        if self.running and self.process is not None and self.process.stdin is not None:
            with contextlib.suppress(ConnectionError, BrokenPipeError):
                self.process.stdin.write(json.dumps(order).encode() + b"\n")
                await self.process.stdin.drain()

    def kill(self) -> None:
        """SIGKILL, as a power cut would."""
        if self.running and self.process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)

    async def stop(self) -> None:
        """Stop in order; kill what does not stop in time."""
        self.asked = True
        await self.order({"stop": True})
        await self.wait(STOP_TIMEOUT_S)

    async def wait(self, timeout_s: float) -> None:
        """Wait for the end; kill after the timeout."""
        if self.reader is None:
            return
        try:
            await asyncio.wait_for(asyncio.shield(self.reader), timeout_s)
        except TimeoutError:
            self.kill()
            await self.reader

    def last_words(self) -> str:
        """The end of the agent's log, for a report of its death."""
        path = self.folder / "agent.log"
        if not path.exists():
            return ""
        return "\n".join(path.read_text(encoding="utf-8", errors="replace").splitlines()[-LOG_TAIL_LINES:])

    async def _read(self) -> None:
        """Take in states until the process ends; take its children with it."""
        assert self.process is not None
        assert self.process.stdout is not None
        async for line in self.process.stdout:
            with contextlib.suppress(ValidationError):
                self.status = AgentStatus.model_validate_json(line)
                self.heard_s = time.monotonic()
        self.exit_code = await self.process.wait()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)


def loopback_transports(names: list[str], keys: Mapping[str, Path] | None = None) -> dict[str, TransportConfig]:
    """Explicit endpoints on this machine for all robots, on ports that are free now; with keys over mutual TLS."""
    ports = free_ports(2 * len(names))
    protocol = "tcp" if keys is None else "tls"
    roster = {
        name: PeerEndpoints(
            control=(f"{protocol}/127.0.0.1:{ports[2 * i]}",),
            bulk=(f"{protocol}/127.0.0.1:{ports[2 * i + 1]}",),
        )
        for i, name in enumerate(names)
    }
    return {
        name: TransportConfig(
            control_listen=roster[name].control,
            bulk_listen=roster[name].bulk,
            roster={other: peer for other, peer in roster.items() if other != name},
            multicast=False,
            gossip=False,
            chaos=True,
            tls=None if keys is None else TlsConfig(folder=keys[name].resolve()),
        )
        for name in names
    }


def free_ports(count: int) -> list[int]:
    """Ports of the loopback interface that nobody uses now."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]
