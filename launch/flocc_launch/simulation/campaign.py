"""Campaigns: many seeds, each a scenario with faults of its own, checked in every step (safety) and then at rest.

After the faults of a run have stopped, everything must come true within `LIVENESS_S`; a run that is as it should be
ends early. A seed that fails replays exactly; `shrink` looks for fewer faults that still fail.
"""

import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path

from flocc_agent.config import BackendMode, KeyframeConfig
from flocc_agent.perception.backends import build_perception
from flocc_launch.datasets.drift import DriftSpec
from flocc_launch.runs.run_folder import write_json
from flocc_launch.scenarios.scenario import FaultKind, Scenario, SensorsScenario, TracksScenario
from flocc_launch.simulation.coverage import Coverage, CoverageWatch
from flocc_launch.simulation.eyes import ImageEyes
from flocc_launch.simulation.fault_schedule import schedule
from flocc_launch.simulation.generator import FAMILIES, LENGTHS_M, ROBOTS_MAX, WALKS, calm_s, drawn_scenario
from flocc_launch.simulation.hardships import Hardship, HardshipKind, drawn_hardships, endure
from flocc_launch.simulation.invariants import Invariant, InvariantWatch, Violation
from flocc_launch.simulation.rigid_alignment import align
from flocc_launch.simulation.safety import all_invariants
from flocc_launch.simulation.simulate import playbacks_of
from flocc_launch.simulation.swarm import Equipment, Swarm
from flocc_launch.simulation.virtual_playback import Playback

LIVENESS_S = 60.0
LOOK_S = 2.5
SEEDS_PER_TASK = 8
WALKS_KEPT = 4 * WALKS * len(LENGTHS_M)
"""All walks of small swarms, with and without sensors and noise."""
SEPARATING = {FaultKind.PARTITION, FaultKind.BLACKOUT, FaultKind.LOSS, FaultKind.MUTE, FaultKind.LEAVE}


NO_DRIFT = DriftSpec(
    scale_sigma_ratio=0,
    translation_sigma_m_per_sqrt_m=0,
    heading_rate_sigma_rad_per_m=0,
    heading_sigma_rad_per_sqrt_m=0,
)


@dataclass(frozen=True, slots=True)
class SeedOutcome:
    """One seed's run.

    Attributes:
        seed: It.
        violations: What did not hold.
        settled_after_s: Time from the end of the faults until everything was as it must be, None if never.
        coverage: Which messages arrived while something was wrong.
    """

    seed: int
    violations: tuple[Violation, ...]
    settled_after_s: float | None
    coverage: Coverage = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Campaign:
    """All runs of a campaign."""

    outcomes: tuple[SeedOutcome, ...]

    def coverage(self) -> Coverage:
        """Of all runs together."""
        return sum((Counter(outcome.coverage) for outcome in self.outcomes), Counter())

    def as_json(self) -> dict[str, object]:
        """What `campaign.json` holds."""
        settled = sorted(o.settled_after_s for o in self.outcomes if o.settled_after_s is not None)
        return {
            "runs": len(self.outcomes),
            "violations": [{"seed": o.seed, **asdict(violation)} for o in self.outcomes for violation in o.violations],
            "coverage": [{"message": m, "fault": f, "count": n} for (m, f), n in sorted(self.coverage().items())],
            "settled_after_s": {"median": settled[len(settled) // 2], "max": settled[-1]} if settled else None,
        }


def campaign(
    seeds: Iterable[int],
    processes: int = 2,
    on_outcome: Callable[[SeedOutcome], None] | None = None,
    family: str = "small",
) -> Campaign:
    """Run every seed, in several processes; `on_outcome` hears of each run in the order of the seeds."""
    outcomes: list[SeedOutcome] = []
    for outcome in _outcomes(list(seeds), processes, family):
        if on_outcome is not None:
            on_outcome(outcome)
        outcomes.append(outcome)
    return Campaign(tuple(outcomes))


def write_campaign(result: Campaign, path: Path) -> None:
    """Write `campaign.json`."""
    write_json(path, result.as_json())


def _outcomes(seeds: list[int], processes: int, family: str) -> Iterator[SeedOutcome]:
    run_one = partial(run_seed, family=family)
    if processes == 1:
        yield from map(run_one, seeds)
        return
    with ProcessPoolExecutor(processes) as pool:
        yield from pool.map(run_one, seeds, chunksize=SEEDS_PER_TASK if family in ("small", "distributed") else 1)


def run_seed(seed: int, family: str = "small") -> SeedOutcome:
    """One seed of a campaign."""
    drawn = FAMILIES[family]
    scenario = drawn_scenario(seed, drawn)
    return run_checked(scenario, drawn_hardships(seed, scenario.names(), drawn.faults_end_s))


def run_checked(scenario: Scenario, hardships: Sequence[Hardship] = ()) -> SeedOutcome:
    """Run a scenario under all checkers; a crash of the core is a violation like any other."""
    swarm = prepared(scenario, hardships)
    watch = InvariantWatch(swarm, invariants_of(scenario, hardships))
    seen = CoverageWatch(swarm, scenario, hardships)
    try:
        settled_after_s = _run(swarm, watch, calm_s(scenario))
    except Exception:  # noqa: BLE001 - whatever the core throws is what the campaign looks for
        last = traceback.format_exc().strip().splitlines()[-8:]
        crash = Violation("no crash", swarm.agenda.now_s, " | ".join(line.strip() for line in last))
        return SeedOutcome(scenario.seed, (crash, *watch.violations), None, seen.counts)
    lacking = watch.lacking() if settled_after_s is None else []
    first = {violation.invariant: violation for violation in reversed([*watch.violations, *lacking])}
    return SeedOutcome(scenario.seed, tuple(first[name] for name in sorted(first)), settled_after_s, seen.counts)


def invariants_of(scenario: Scenario, hardships: Sequence[Hardship] = ()) -> list[Invariant]:
    """All invariants; two robots may register one pair only where they could not hear each other for a while.

    Nobody counts on a name under which two robots run. A robot that an older disk makes number keyframes twice has
    others register images of one with the place of the other, until it is told: then the truth is not asked for. Where
    closures are wrong for a while, robots that know of it and robots that do not doubt each other.
    """
    separating = any(fault.kind in SEPARATING for fault in scenario.faults)
    links = [scenario.radio, *scenario.radio.overrides]
    lossy = any(link.loss_ratio or link.burst_ratio or link.bandwidth_bytes_s for link in links)
    separated = separating or lossy or scenario.radio.range_m is not None or bool(hardships)
    doubles = {hardship.robot for hardship in hardships if hardship.kind is HardshipKind.TWIN}
    classes = {name: -1 if name in doubles else scenario.robot(name).compute_class for name in scenario.names()}
    told_twice = any(hardship.kind is HardshipKind.OLDER for hardship in hardships)
    honest = all(hardship.kind not in (HardshipKind.LIAR, HardshipKind.OVERLAY) for hardship in hardships)
    distributed = scenario.backend.mode is BackendMode.DISTRIBUTED
    return all_invariants(separated, is_noiseless(scenario) and not told_twice, classes, honest, distributed)


def is_noiseless(scenario: Scenario) -> bool:
    """Whether registrations are without noise; then odometry is, too."""
    synthetic = scenario.perception.synthetic
    return synthetic.rotation_sigma_rad == synthetic.scale_drift_sigma_ratio == 0.0


def prepared(scenario: Scenario, hardships: Sequence[Hardship] = ()) -> Swarm:
    """A swarm with quick stand-ins for perception and back end, and its faults to come."""
    eyes = ImageEyes(build_perception(scenario.perception, scenario.seed), scenario.perception, None)
    swarm = Swarm(scenario, _playbacks(scenario), Equipment(eyes, align), scenario.seed)
    endure(swarm, hardships)
    schedule(swarm, scenario.faults)
    return swarm


def _playbacks(scenario: Scenario) -> dict[str, Playback]:
    assert scenario.tracks is not None
    tracks = scenario.tracks.model_copy(update={"robots": max(ROBOTS_MAX, scenario.tracks.robots)})
    sensors = None if scenario.sensors is None else scenario.sensors.model_dump_json()
    drawn = _walked(tracks.model_dump_json(), scenario.keyframes.model_dump_json(), sensors, is_noiseless(scenario))
    return {name: drawn[name] for name in scenario.names()}


@lru_cache(maxsize=WALKS_KEPT)
def _walked(tracks: str, keyframes: str, sensors: str | None, noiseless: bool) -> dict[str, Playback]:
    """Playbacks of walks, drawn once for all seeds that share them; the parameters are JSON."""
    scenario = Scenario(
        tracks=TracksScenario.model_validate_json(tracks),
        keyframes=KeyframeConfig.model_validate_json(keyframes),
        sensors=None if sensors is None else SensorsScenario.model_validate_json(sensors),
    )
    return playbacks_of(scenario, {}, NO_DRIFT if noiseless else None)


def shrink(scenario: Scenario, fails: Callable[[Scenario], bool] | None = None) -> Scenario:
    """Leave out faults, one after the other, as long as the rest still fails."""
    still_fails = fails or (lambda smaller: bool(run_checked(smaller).violations))
    k = 0
    while k < len(scenario.faults):
        fewer = scenario.faults[:k] + scenario.faults[k + 1 :]
        smaller = scenario.model_copy(update={"faults": fewer})
        if scenario.faults[k].kind is not FaultKind.CALM and still_fails(smaller):
            scenario = smaller
        else:
            k += 1
    return scenario


def _run(swarm: Swarm, watch: InvariantWatch, faults_end_s: float) -> float | None:
    """Let the faults happen, then wait for peace."""
    swarm.run_until(faults_end_s + LOOK_S)
    while swarm.agenda.now_s <= faults_end_s + LIVENESS_S:
        if watch.is_settled():
            return swarm.agenda.now_s - faults_end_s
        swarm.run_until(swarm.agenda.now_s + LOOK_S)
    return None
