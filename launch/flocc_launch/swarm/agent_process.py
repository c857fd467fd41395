"""One agent process: plays its recording, writes its events and its result, tells its state once a second.

`flocc agent` and `flocc launch` both run this. A launched agent speaks JSON lines: states on standard output,
orders (`{"stop": true}`, `{"radio": {...}}`) on standard input.
"""

import argparse
import asyncio
import errno
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flocc_agent.config import AgentConfig, RadioConfig, validated
from flocc_agent.core.reports import Fact, LogForked
from flocc_agent.runtime.event_lines import Reported, line_of
from flocc_agent.runtime.facts import AgentStopped, JourneyEnded
from flocc_agent.runtime.freed_memory import have_one_heap
from flocc_agent.runtime.robot_result import RobotResult, write_result
from flocc_agent.runtime.status import AgentStatus
from flocc_launch.setup.world_faults import sentence_of

if TYPE_CHECKING:
    from flocc_agent.agent import Agent
    from flocc_launch.dashboard.own import AgentSource

logger = logging.getLogger(__name__)

STATUS_PERIOD_S = 0.5
RETRY_S = 5.0
"""A disk that took no event is tried again so often."""
LOOK_PERIOD_S = 5.0
"""How often it is asked whether the file of events is still where it was."""
EXIT_BAD_INPUT = 2


@dataclass(frozen=True, slots=True)
class Beginning:
    """How an agent begins.

    Attributes:
        map_fixed: The map that it opens does not move.
        new_journey: Its odometry began anew since it ran last.
    """

    map_fixed: bool = False
    new_journey: bool = False


class ToldOfMap:
    """Logs whether a robot has found itself in the map that it opened, whenever that changes."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._said: str | None = None

    def tell(self, status: AgentStatus) -> None:
        """Look at a state."""
        if status.in_map not in (None, self._said):
            self._said = status.in_map
            logger.info("%s: %s", self._robot, status.in_map)


class Lines:
    """The agent's own `events.jsonl`, written line by line so that a kill loses nothing that was reported.

    A disk that fails costs lines, not the robot. It is said once; every `RETRY_S` the file is tried again. A file that
    was moved away or removed is begun anew.
    """

    def __init__(self, path: Path | None, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._path = path
        self._clock_s = clock_s
        self._file: FileIO | None = None
        self._lost = 0
        self._retry_s = self._look_s = float("-inf")

    def write(self, event: Reported[Fact]) -> None:
        """Append one event, or count it as lost."""
        if self._path is None:
            return
        if self._file is None and self._clock_s() < self._retry_s:
            self._lost += 1
            return
        try:
            self._append(self._path, json.dumps(line_of(event), separators=(",", ":"), allow_nan=False))
        except OSError as error:
            if not self._lost:
                logger.error("%s: %s; events are not written meanwhile", self._path, error.strerror or error)
            self._lost += 1
            self._retry_s = self._clock_s() + RETRY_S
            self.close()
        else:
            if self._lost:
                logger.warning("%s: events are written again; %d were lost", self._path, self._lost)
            self._lost = 0

    def _append(self, path: Path, line: str) -> None:
        """Write a line whole or not at all."""
        if self._file is not None and self._is_elsewhere(path):
            self.close()
        if self._file is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab", buffering=0)
            self._look_s = self._clock_s() + LOOK_PERIOD_S
        data = line.encode() + b"\n"
        written = self._file.write(data)
        if written != len(data):
            self._file.truncate(self._file.tell() - written)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _is_elsewhere(self, path: Path) -> bool:
        """Whether somebody moved the file away (logrotate does) or removed it; asked now and then."""
        if self._file is None or self._clock_s() < self._look_s:
            return False
        self._look_s = self._clock_s() + LOOK_PERIOD_S
        try:
            return not os.path.samestat(path.stat(), os.fstat(self._file.fileno()))
        except FileNotFoundError:
            return True

    def close(self) -> None:
        """Close the file."""
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):
                file.close()


async def run_agent(
    config: AgentConfig,
    epoch_s: float,
    on_status: Callable[[AgentStatus], None],
    orders: asyncio.StreamReader | None = None,
    dashboard: str | None = None,
    beginning: Beginning | None = None,
    ros_args: Sequence[str] = (),
) -> None:
    """Run one agent until it is told to stop, by a signal or an order.

    Args:
        config: The agent's configuration; with `folder`, its events and result are written there.
        epoch_s: Start of the run on this machine's monotonic clock.
        on_status: Takes a state, twice a second.
        orders: JSON lines from the launcher.
        dashboard: [HOST:]PORT of a page that shows this agent's own view of its swarm.
        beginning: How it begins; None: as always.
        ros_args: What ROS 2 is started with.

    Raises:
        FloccError: The configuration, the recording or the network cannot be used.
    """
    lines = Lines(config.folder / "events.jsonl" if config.folder else None)
    with _page(config, dashboard, lambda: time.monotonic() - epoch_s) as source:
        life = _Life(config, epoch_s, lines, source, beginning or Beginning(), ros_args)
        await _run(life, config, epoch_s, on_status, orders, lines)


async def _run(
    life: "_Life",
    config: AgentConfig,
    epoch_s: float,
    on_status: Callable[[AgentStatus], None],
    orders: asyncio.StreamReader | None,
    lines: Lines,
) -> None:
    """Live; where the robot's own log turns out to be lost, live once more, with another log.

    Once at most, since without keys anybody can end a log; and not under a launcher, which expects one life. A journey
    that the robot's ROS ended is followed by another one, each time.
    """
    try:
        await life.live(on_status, orders)
        while life.begins_anew() and not life.stopped and orders is None:
            logger.warning("%s: begins anew, with another log", config.name)
            await life.live(on_status, orders)
    finally:
        lines.write(Reported(time.monotonic() - epoch_s, config.name, AgentStopped()))
        lines.close()


def ending_signals() -> list[signal.Signals]:
    """Signals that end a run in order: also that of a closed terminal, unless `nohup` has it ignored."""
    ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return [signal.SIGINT, signal.SIGTERM, *([] if ignored else [signal.SIGHUP])]


class _Life:
    """One agent from its start to its end.

    Attributes:
        log_ended: Others hold records of this robot's log that it did not write.
        stopped: A signal ended it.
    """

    def __init__(
        self,
        config: AgentConfig,
        epoch_s: float,
        lines: Lines,
        source: "AgentSource | None",
        beginning: Beginning,
        ros_args: Sequence[str] = (),
    ) -> None:
        self.log_ended = self.stopped = False
        self._renewed = self._journey_ended = False
        self._ros_args = ros_args
        self._config = config
        self._epoch_s = epoch_s
        self._lines = lines
        self._source = source
        self._beginning = beginning
        self._agent: Agent | None = None

    async def live(self, on_status: Callable[[AgentStatus], None], orders: asyncio.StreamReader | None) -> None:
        """Run an agent until it is told to stop, or its log ended."""
        from flocc_agent.agent import Agent

        may_renew = orders is None and not self.log_ended
        on_report = self._ends_with_its_log if may_renew else self._report
        agent = Agent(
            self._config,
            on_report=on_report,
            clock_s=lambda: time.monotonic() - self._epoch_s,
            map_fixed=self._beginning.map_fixed,
            new_journey=self._beginning.new_journey,
            ros_args=self._ros_args,
        )
        self._agent = agent
        for number in ending_signals():
            asyncio.get_running_loop().add_signal_handler(number, self._stop)
        background: list[asyncio.Task[None]] = []
        try:
            async with agent:
                if self._source is not None:
                    self._source.attach(agent)
                background = [asyncio.create_task(_tell(agent, on_status))]
                if orders is not None:
                    background.append(asyncio.create_task(_obey(agent, orders)))
                await agent.finished()
        finally:
            for task in background:
                task.cancel()
            _keep_result(self._config, agent.result())

    def begins_anew(self) -> bool:
        """Whether another life follows the one that ended."""
        lost = self.log_ended and not self._renewed
        self._renewed = self._renewed or lost
        journey, self._journey_ended = self._journey_ended, False
        return lost or journey

    def _stop(self) -> None:
        self.stopped = True
        if self._agent is not None:
            self._agent.stop()

    def _report(self, event: Reported[Fact]) -> None:
        self._journey_ended |= isinstance(event.fact, JourneyEnded)
        self._lines.write(event)
        if self._source is not None:
            self._source.take(event)

    def _ends_with_its_log(self, event: Reported[Fact]) -> None:
        self._report(event)
        if self._agent is not None and isinstance(event.fact, LogForked) and event.fact.log == self._agent.log:
            self.log_ended = True
            self._agent.stop()


@contextmanager
def _page(config: AgentConfig, where: str | None, clock_s: Callable[[], float]) -> "Iterator[AgentSource | None]":
    """The page of one agent, where somebody wants one.

    Raises:
        DashboardError: Its address is none, or in use.
    """
    if where is None:
        yield None
        return
    from flocc_launch.dashboard import Dashboard, address
    from flocc_launch.dashboard.own import AgentSource

    host, port = address(where)
    source = AgentSource(config.swarm, config.name, config.backend.steepness, clock_s)
    with Dashboard(source, port, host) as page:
        logger.info("%s: dashboard at %s", config.name, page.url)
        yield source


def recover_result(config: AgentConfig) -> None:
    """Write the result of an agent that was killed, from what its store holds."""
    from flocc_agent.composition import stored_result

    if config.folder is not None and (config.folder / "store").exists():
        write_result(config.folder, stored_result(config))


def _keep_result(config: AgentConfig, result: RobotResult | None) -> None:
    """Write the result, unless the disk does not take it."""
    if config.folder is None or result is None:
        return
    try:
        write_result(config.folder, result)
    except OSError as error:
        logger.error("%s: the result is not written: %s", config.name, error.strerror or error)


async def _tell(agent: Any, on_status: Callable[[AgentStatus], None]) -> None:
    while True:
        on_status(agent.status())
        await asyncio.sleep(STATUS_PERIOD_S)


async def _obey(agent: Any, orders: asyncio.StreamReader) -> None:
    """Carry out the launcher's orders; its end is an order to stop, so that no agent is left behind."""
    while line := await orders.readline():
        order = json.loads(line)
        if "radio" in order:
            agent.set_radio(validated(RadioConfig, order["radio"], "order"))
        if "slow" in order:
            agent.set_slowness(float(order["slow"]))
        if order.get("stop"):
            agent.stop()
            return
    agent.stop()


async def _standard_input() -> asyncio.StreamReader:
    reader = asyncio.StreamReader()
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    return reader


def _print_status(status: AgentStatus) -> None:
    sys.stdout.write(status.model_dump_json() + "\n")
    sys.stdout.flush()


async def _run_launched(config: AgentConfig, epoch_s: float, beginning: Beginning) -> None:
    await run_agent(config, epoch_s, _print_status, await _standard_input(), beginning=beginning)


def main() -> None:
    """Entry point of a launched agent."""
    parser = argparse.ArgumentParser()
    parser.add_argument("config", type=Path)
    parser.add_argument("--epoch-s", type=float, required=True)
    parser.add_argument("--map-fixed", action="store_true")
    arguments = parser.parse_args()
    have_one_heap()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    try:
        config = validated(AgentConfig, json.loads(arguments.config.read_text(encoding="utf-8")), str(arguments.config))
        asyncio.run(_run_launched(config, arguments.epoch_s, Beginning(map_fixed=arguments.map_fixed)))
    except Exception as error:
        sentence = sentence_of(error)
        if sentence is None:
            raise
        sys.stderr.write(f"error: {sentence}\n")
        sys.exit(EXIT_BAD_INPUT)


if __name__ == "__main__":
    main()
