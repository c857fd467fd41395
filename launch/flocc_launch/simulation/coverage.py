"""Which messages a campaign saw arrive while something was wrong: message kind times fault kind."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flocc_agent.core.effects import Effect
from flocc_agent.core.events import Event, MessageReceived
from flocc_launch.scenarios.scenario import FaultKind, Scenario
from flocc_launch.simulation.hardships import Hardship, HardshipKind
from flocc_launch.simulation.swarm import Swarm
from flocc_launch.simulation.virtual_robot import Station
from flocc_protocol.messages import kind_of

AFTERMATH_S = 10.0
"""For so long after a robot died, came back or lost something messages count as of that time."""
PEACE = "peace"
LASTING = (FaultKind.PARTITION, FaultKind.BLACKOUT, FaultKind.LOSS, FaultKind.MUTE, FaultKind.SLOW)
HEALED = (FaultKind.PARTITION, FaultKind.BLACKOUT)
POINTS = (HardshipKind.OLDER, HardshipKind.FLIPPED, HardshipKind.TORN, HardshipKind.CLOCK)

Coverage = Mapping[tuple[str, str], int]
"""(message kind, what was wrong) -> messages that arrived."""


@dataclass(frozen=True, slots=True)
class _Window:
    name: str
    from_s: float
    to_s: float


class CoverageWatch:
    """Counts what arrives in one run."""

    def __init__(self, swarm: Swarm, scenario: Scenario, hardships: Sequence[Hardship]) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._swarm = swarm
        self._always = _of_links(scenario)
        self._windows = [*_of_faults(scenario), *map(_of_hardship, hardships)]
        swarm.observers.append(self._step)

    def _step(self, station: Station, event: Event | None, effects: list[Effect]) -> None:  # noqa: ARG002
        if not isinstance(event, MessageReceived):
            return
        now_s, kind = self._swarm.agenda.now_s, kind_of(event.envelope.message)
        active = {window.name for window in self._windows if window.from_s <= now_s < window.to_s}
        self.counts.update((kind, name) for name in ({*active, *self._always} or {PEACE}))


def _of_faults(scenario: Scenario) -> list[_Window]:
    windows = []
    for fault in scenario.faults:
        if fault.kind in (FaultKind.HEAL, FaultKind.CALM, FaultKind.START):
            continue
        ends = (FaultKind.HEAL, FaultKind.CALM) if fault.kind in HEALED else (FaultKind.CALM,)
        after = [each.at_s for each in scenario.faults if each.kind in ends and each.at_s > fault.at_s]
        end_s = min(after, default=float("inf")) if fault.kind in LASTING else fault.at_s + AFTERMATH_S
        windows.append(_Window("disk lost" if fault.disk_lost else fault.kind.value, fault.at_s, end_s))
    return windows


def _of_hardship(hardship: Hardship) -> _Window:
    if hardship.kind in POINTS:
        return _Window(hardship.kind.value, hardship.to_s, hardship.to_s + AFTERMATH_S)
    return _Window(hardship.kind.value, hardship.from_s, hardship.to_s)


def _of_links(scenario: Scenario) -> frozenset[str]:
    """What is wrong all the time."""
    links = [scenario.radio, *scenario.radio.overrides]
    found = {
        "lossy links": any(0.0 < link.loss_ratio < 1.0 or link.burst_ratio for link in links),
        "one-way links": any(link.loss_ratio == 1.0 for link in scenario.radio.overrides),
        "late messages": any(link.latency_s or link.jitter_s for link in links),
        "repeated messages": any(link.duplicate_ratio for link in links),
        "reordered messages": any(link.reorder_ratio for link in links),
        "narrow links": any(link.bandwidth_bytes_s is not None for link in links),
        "short range": scenario.radio.range_m is not None,
        "drifting clocks": any(scenario.robot(name).clock_drift_ratio for name in scenario.names()),
    }
    return frozenset(name for name, holds in found.items() if holds)


def table(coverage: Coverage) -> str:
    """A row for each message kind, a column for each fault kind, in thousands; a dot where nothing arrived."""
    kinds, faults = sorted({kind for kind, _ in coverage}), sorted({fault for _, fault in coverage})
    width = max(map(len, kinds), default=0)
    lines = [f"{number:2}: {fault}" for number, fault in enumerate(faults, 1)]
    lines.append(" " * width + "".join(f"{number:>7}" for number in range(1, len(faults) + 1)))
    lines += [kind.ljust(width) + "".join(_cell(coverage.get((kind, fault), 0)) for fault in faults) for kind in kinds]
    return "\n".join(lines)


def _cell(count: int) -> str:
    return f"{'.' if not count else count if count < 10_000 else f'{count // 1000}k':>7}"
