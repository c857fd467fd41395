"""`flocc launch`: a scenario with N agent processes over real zenoh, watched until it is done.

A run without a duration ends when every recording is played, nothing is under way, all logs are equal and nothing
changed for `settle_s`.
"""

import asyncio
import json
import logging
import shutil
import signal
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, assert_never

from flocc_agent.config import MetricsConfig, RadioConfig, SourceConfig
from flocc_agent.perception.backends import check_perception
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.facts import AgentDied
from flocc_agent.runtime.network_faults import loopback_fault
from flocc_launch.maps.opening import MapUse
from flocc_launch.report.finish import finish
from flocc_launch.report.model import RunReport
from flocc_launch.runs.run_folder import Run, RunFolder
from flocc_launch.scenarios.expectations import check_measurable
from flocc_launch.scenarios.leader_faults import placed_fault
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Fault, FaultKind, LinkFault, Scenario, agent_config
from flocc_launch.setup.credentials import make_keys
from flocc_launch.swarm.agent_process import Lines, ending_signals, recover_result
from flocc_launch.swarm.fresh_folder import LAUNCHER_EVENTS, fresh_folder
from flocc_launch.swarm.processes import AgentProcess, loopback_transports
from flocc_protocol.errors import FloccError

logger = logging.getLogger(__name__)

Seen = tuple[dict[str, tuple[int, int]], str | None, int | None, str | None, bool]
"""Logs, map frame, round, leader, and whether it plays: a run goes on while they change."""
PERIOD_S = 0.25
UNSETTLED_MAX_S = 120.0
STOP_NOW_S = 5.0
START_S = 20.0


class LaunchError(FloccError):
    """A launch that cannot go on: no agent could be started."""


@dataclass(slots=True)
class Watch:
    """What the launcher shows while a run goes on.

    Attributes:
        scenario: What runs.
        agents: All agents.
        elapsed_s: Seconds since the start of the run.
        notes: Sentences about faults and deaths, newest last.
    """

    scenario: Scenario
    agents: list[AgentProcess]
    elapsed_s: float = 0.0
    notes: list[str] = field(default_factory=list)


OnWatch = Callable[[Watch], None]


def launch(
    scenario: Scenario,
    out: Path,
    on_watch: OnWatch | None = None,
    progress: Callable[[int, int], None] | None = None,
    secure: bool = False,
    metrics: str | None = None,
    paths: dict[str, Path] | None = None,
    use: MapUse | None = None,
) -> RunReport:
    """Run a scenario and write its run folder.

    Args:
        scenario: What to run.
        out: Run folder; an earlier run in it is replaced.
        on_watch: Called four times a second.
        progress: Called while data is generated, with (done, all).
        secure: Make keys for this run, and let agents trust those who have them only.
        paths: Recordings by robot, where they were made already.
        metrics: [HOST:]PORT of the first robot's metrics, by name; each further robot has the next port.
        use: The map in which the robots are to find themselves; None: there is none.

    Raises:
        FloccError: The data cannot be used, a fault or expectation is not for real processes, or no agent could start.
    """
    check_network()
    check_faults(scenario)
    check_perception(scenario.perception)
    names = scenario.names()
    lives = {} if use is None else use.checked(scenario)
    served = {} if metrics is None else dict(zip(names, MetricsConfig.at(metrics, len(names)), strict=True))
    paths = recordings(scenario, progress) if paths is None else paths
    check_measurable(scenario, paths)
    if use is not None:
        use.check_fully(scenario)  # before the earlier run goes
    given = on_watch or (lambda _: None)
    with fresh_folder(out, scenario.name, use) as folder:
        return asyncio.run(_Launch(scenario, folder, paths, given, secure, served, use, lives).run())


def check_network() -> None:
    """See that agents on this machine will reach each other, before minutes are spent on data.

    Raises:
        LaunchError: They will not.
    """
    fault = loopback_fault()
    if fault is not None:
        raise LaunchError(
            f"the agents of a launch talk over 127.0.0.1, which cannot be reached ({fault}): bring the machine's own "
            "interface up (ip link set lo up); flocc simulate needs no network"
        )


def check_faults(scenario: Scenario) -> None:
    """Say which fault processes over real zenoh cannot have.

    Raises:
        LaunchError: There is one.
    """
    simulated = {FaultKind.MUTE, FaultKind.CALM} & {fault.kind for fault in scenario.faults}
    if simulated:
        raise LaunchError(f"{scenario.name}: a fault '{min(simulated).value}' exists on virtual time only")


class _Launch:
    """One run."""

    def __init__(
        self,
        scenario: Scenario,
        folder: RunFolder,
        paths: dict[str, Path],
        on_watch: OnWatch,
        secure: bool,
        metrics: dict[str, MetricsConfig],
        use: MapUse | None = None,
        lives: dict[str, int] | None = None,
    ) -> None:
        self._scenario = scenario
        self._folder = folder
        self._paths = paths
        self._on_watch = on_watch
        self._secure = secure
        self._metrics = metrics
        self._map = use
        self._lives = lives or {}
        self._epoch_s = time.monotonic()
        self._start = datetime.now(UTC)
        self._lines = Lines(folder.path / LAUNCHER_EVENTS)
        self._radio = scenario.links()
        self._faults = sorted(scenario.faults, key=lambda fault: fault.at_s)
        self._interrupted = False
        self._killed: set[str] = set()
        self._changed_s = 0.0
        self._seen: dict[str, Seen] = {}
        self._watch = Watch(scenario, self._agents())

    async def run(self) -> RunReport:
        """Start, watch, stop, write."""
        self._folder.write_run(self._run_record())
        loop = asyncio.get_running_loop()
        for number in ending_signals():
            loop.add_signal_handler(number, self._interrupt)
        self._epoch_s = time.monotonic()
        try:
            await self._live()
        finally:
            await asyncio.gather(*(agent.stop() for agent in self._watch.agents if agent.running))
            self._on_watch(self._watch)
        self._collect()
        return finish(self._folder)

    def _agents(self) -> list[AgentProcess]:
        names = self._scenario.names()
        classes = {name: self._scenario.robot(name).compute_class for name in names}
        folder = self._folder.path / "keys"
        keys = make_keys(folder, self._scenario.name, names, compute_classes=classes) if self._secure else None
        transports = loopback_transports(names, keys)
        agents = []
        for name in names:
            folder = self._folder.path / "robots" / name
            source = SourceConfig(
                recording=self._paths[name].resolve() if name in self._paths else None,
                rate=self._scenario.rate,
                start_s=self._scenario.robot(name).start_s,
            )
            config = agent_config(
                self._scenario,
                name,
                source=source,
                transport=transports[name],
                folder=folder.resolve(),
                metrics=self._metrics.get(name, MetricsConfig()),
                map=None if self._map is None else self._map.folder.resolve(),
                incarnation=self._lives.get(name, 0),
            )
            agents.append(AgentProcess(config, folder, map_fixed=self._map is not None and self._map.fixed))
        return agents

    async def _live(self) -> None:
        starting = {agent.name: self._scenario.robot(agent.name).start_s for agent in self._watch.agents}
        while not self._interrupted:
            self._watch.elapsed_s = self._now_s()
            for agent in self._watch.agents:
                if agent.name in starting and starting[agent.name] <= self._now_s():
                    del starting[agent.name]
                    await agent.start(self._epoch_s)
            await self._inject()
            self._note_deaths()
            self._on_watch(self._watch)
            if not starting and not self._faults and self._over():
                return
            await asyncio.sleep(PERIOD_S)

    def _over(self) -> bool:
        duration_s = self._scenario.duration_s
        if duration_s is not None:
            return self._now_s() >= duration_s
        alive = [agent for agent in self._watch.agents if agent.running]
        if not alive:
            return True
        self._note_changes(alive)
        quiet_s = self._now_s() - self._changed_s
        if any(agent.status is None or agent.status.playing for agent in alive):
            return False
        settled = _agree(alive) and not any(agent.said.busy for agent in alive)
        return quiet_s >= (self._scenario.settle_s if settled else UNSETTLED_MAX_S)

    def _note_changes(self, alive: Iterable[AgentProcess]) -> None:
        """Remember when any robot's logs, frame or leader changed last."""
        for agent in alive:
            said = agent.said
            seen = (said.logs, said.map_frame, said.round, said.leader, said.playing)
            if seen != self._seen.get(agent.name):
                self._seen[agent.name] = seen
                self._changed_s = self._now_s()

    # Faults

    async def _inject(self) -> None:
        while self._faults and self._faults[0].at_s <= self._now_s():
            followed = (agent.said.leader for agent in self._watch.agents if agent.running)
            fault = placed_fault(self._faults.pop(0), self._scenario.names(), followed)
            self._note(f"{fault.kind.value} {' '.join(fault.robots) or fault.groups or fault.value or ''}".strip())
            await self._do(fault)

    async def _do(self, fault: Fault) -> None:
        concerned = [agent for agent in self._watch.agents if agent.name in fault.robots]
        match fault.kind:
            case FaultKind.KILL:
                for agent in concerned:
                    if agent.running:
                        self._killed.add(agent.name)
                    agent.kill()
                    await agent.wait(STOP_NOW_S)
            case FaultKind.RESTART:
                for agent in concerned:
                    await self._restart(agent, fault.disk_lost)
            case FaultKind.START:
                for agent in concerned:
                    if not agent.running:
                        await agent.start(self._epoch_s)
            case FaultKind.LEAVE:
                await asyncio.gather(*(agent.stop() for agent in concerned))
            case FaultKind.SLOW:
                for agent in concerned:
                    await agent.order({"slow": fault.value})
            case FaultKind.MUTE | FaultKind.CALM:
                raise AssertionError(f"{fault.kind.value} exists on virtual time only: check_faults refuses it")
            case _:
                self._radio = changed_radio(self._radio, fault.kind, fault, self._now_s())
                order = {"radio": json.loads(self._radio.model_dump_json())}
                await asyncio.gather(*(agent.order(order) for agent in self._watch.agents))

    async def _restart(self, agent: AgentProcess, disk_lost: bool) -> None:
        if agent.running:
            agent.kill()
            await agent.wait(STOP_NOW_S)
        if disk_lost:
            shutil.rmtree(agent.folder / "store", ignore_errors=True)
            agent.config = agent.config.model_copy(update={"incarnation": None})
        await agent.start(self._epoch_s)

    def _note_deaths(self) -> None:
        """Report agents that ended without being asked."""
        for agent in self._watch.agents:
            if agent.exit_code is None or agent.asked:
                continue
            agent.asked = True
            code = agent.exit_code
            scripted = agent.name in self._killed
            self._killed.discard(agent.name)
            signal_number, exit_code = (-code, None) if code < 0 else (None, code)
            death = AgentDied(signal=signal_number, exit_code=exit_code, scripted=scripted)
            self._lines.write(Reported(self._now_s(), agent.name, death))
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            self._note(f"{agent.name} died ({how})" + (f": {agent.last_words()}" if code > 0 else ""))
            if code != 0 and not scripted and agent.status is None and self._now_s() < START_S:
                raise LaunchError(f"robot {agent.name} could not start: {_sentence(agent.last_words())}")

    # Files

    def _collect(self) -> None:
        """Merge all robots' events and the launcher's own, in order of time."""
        self._lines.close()
        events = _read_lines(self._folder.path / LAUNCHER_EVENTS)
        for agent in self._watch.agents:
            if agent.exit_code != 0:
                recover_result(agent.config)
            events += _read_lines(agent.folder / "events.jsonl")
        events.sort(key=lambda event: (event["t"], event["robot"]))
        self._folder.write_events(events)
        self._folder.write_run(self._run_record(wall_s=self._now_s()))

    def _run_record(self, wall_s: float | None = None) -> Run:
        scenario = self._scenario
        return Run(
            scenario=scenario.name,
            seed=scenario.seed,
            robots=scenario.names(),
            servers=scenario.servers(),
            start=self._start.isoformat(timespec="seconds"),
            driver="launch",
            recordings={name: str(path.resolve()) for name, path in self._paths.items()},
            radio=json.loads(scenario.links().model_dump_json(), parse_constant=lambda _: None),
            settings={**scenario.settings(), **({} if self._map is None else self._map.settings())},
            perception=scenario.perception.model_dump(mode="json"),
            expectations=scenario.expectations.limits(),
            duration_s=wall_s,
            wall_s=wall_s,
        )

    def _note(self, sentence: str) -> None:
        self._watch.notes.append(f"{self._now_s():7.1f} s  {sentence}")

    def _interrupt(self) -> None:
        self._interrupted = True

    def _now_s(self) -> float:
        return time.monotonic() - self._epoch_s


def changed_radio(radio: RadioConfig, kind: LinkFault, fault: Fault, now_s: float) -> RadioConfig:
    """The radio after a fault that concerns links."""
    match kind:
        case FaultKind.PARTITION:
            partition = {"groups": fault.groups, "from_s": now_s}
            return radio.model_validate({**radio.model_dump(), "partitions": [*radio.partitions, partition]})
        case FaultKind.BLACKOUT:
            blackout = {"robots": fault.robots, "from_s": now_s}
            return radio.model_validate({**radio.model_dump(), "blackouts": [*radio.blackouts, blackout]})
        case FaultKind.HEAL:
            return radio.model_copy(update={"partitions": (), "blackouts": ()})
        case FaultKind.LOSS:
            return radio.model_validate({**radio.model_dump(), "loss_ratio": fault.value})
        case FaultKind.LATENCY:
            return radio.model_validate({**radio.model_dump(), "latency_s": fault.value})
        case FaultKind.RANGE:
            return radio.model_validate({**radio.model_dump(), "range_m": fault.value})
        case _:
            assert_never(kind)


def _agree(alive: list[AgentProcess]) -> bool:
    """Whether all running robots hold the same logs."""
    logs = [agent.said.logs for agent in alive]
    return all(log == logs[0] for log in logs)


def _read_lines(path: Path) -> list[dict[str, Any]]:
    """Lines of one robot's events; a last line that a kill cut off is left out."""
    if not path.exists():
        return []
    events = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            events.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return events


def _sentence(words: str) -> str:
    """The error's own sentence out of the end of a log."""
    lines = [line for line in words.splitlines() if line.strip()]
    return next((line for line in reversed(lines) if line.startswith("error: ")), lines[-1] if lines else "no message")
