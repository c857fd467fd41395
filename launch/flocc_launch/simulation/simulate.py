"""`flocc simulate`: run a scenario on virtual time and leave a run folder."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from flocc_agent.backend import build_optimiser
from flocc_agent.core.interfaces import Perception
from flocc_agent.core.reports import (
    CandidateFound,
    ClosureAccepted,
    ClosureRejected,
    CorrectionApplied,
    KeyframeTaken,
    RoundSolved,
)
from flocc_agent.perception.backends import build_perception
from flocc_agent.runtime.event_lines import line_of
from flocc_agent.runtime.facts import AccountKept, AgentStopped, BytesCounted
from flocc_agent.runtime.measurement_file import rows_of
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.reporting import result_of
from flocc_agent.stages import counts_of
from flocc_launch.datasets.drift import DriftSpec
from flocc_launch.maps.opening import MapUse, opened_for
from flocc_launch.report.finish import finish
from flocc_launch.report.model import RunReport
from flocc_launch.runs.ground_truth import truth_path, write_truth
from flocc_launch.runs.plain_numbers import duration
from flocc_launch.runs.run_folder import Run, RunFolder
from flocc_launch.scenarios.expectations import check_measurable
from flocc_launch.scenarios.leader_faults import FaultError
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.scenarios.sensors import sense
from flocc_launch.scenarios.walks import walks
from flocc_launch.simulation.eyes import ImageEyes
from flocc_launch.simulation.fault_schedule import schedule
from flocc_launch.simulation.rigid_alignment import align
from flocc_launch.simulation.stored_stations import write_store
from flocc_launch.simulation.swarm import Equipment, Swarm
from flocc_launch.simulation.virtual_playback import Playback, nothing, of_recording, of_walk
from flocc_launch.simulation.virtual_workers import WorkTimes

LOOK_S = 1.0
LONGEST_AFTER_LAST_S = 300.0
FAULT_AFTER_LAST_S = 3600.0
"""A fault later than that after all was played is a slip of units."""
QUIET_KINDS = (RoundSolved, CorrectionApplied, KeyframeTaken, CandidateFound, ClosureAccepted, ClosureRejected)


def simulate(
    scenario: Scenario,
    out: Path,
    seed: int | None = None,
    recordings: Mapping[str, Path] | None = None,
    cache: Path | None = None,
    use: MapUse | None = None,
) -> RunReport:
    """Run a scenario on virtual time.

    Args:
        scenario: What happens; its seed counts where none is given.
        out: Folder of the run, new.
        seed: Seed of links, boots and workers.
        recordings: Robots' recordings, where the scenario's world or data set was made into some.
        cache: Folder that keeps what perception found out about images, so that a second run is fast.
        use: The map in which the robots are to find themselves; None: there is none.

    Returns:
        The report, which the folder holds as well.

    Raises:
        FloccError: A recording cannot be read, an expectation cannot be measured, or the folder holds a run already.
    """
    check_measurable(scenario, recordings or {})
    chosen = scenario.seed if seed is None else seed
    lives = {} if use is None else use.checked(scenario)
    folder = RunFolder.create(out)
    playbacks = playbacks_of(scenario, recordings or {})
    perception = build_perception(scenario.perception, chosen)
    swarm = swarm_of(scenario, playbacks, chosen, cache, use, lives, perception)
    end_s = run(swarm)
    write(folder, swarm, chosen, end_s, recordings, use)
    for name, station in swarm.stations.items():
        source = (recordings or {}).get(name) or scenario.robot(name).recording
        write_store(folder.path / "robots" / name / "store", station, scenario, perception, source)
    return finish(folder)


def swarm_of(
    scenario: Scenario,
    playbacks: Mapping[str, Playback],
    seed: int,
    cache: Path | None = None,
    use: MapUse | None = None,
    lives: Mapping[str, int] = MappingProxyType({}),
    perception: Perception | None = None,
) -> Swarm:
    """Put the robots of a scenario on virtual time, with their faults to come, and the map that they open."""
    perception = perception or build_perception(scenario.perception, seed)
    opened = None if use is None else opened_for(use, scenario, perception)
    eyes = ImageEyes(perception, scenario.perception, cache)
    given = scenario.simulation
    optimiser = align if given.optimiser == "quick" else build_optimiser(scenario.backend)
    times = WorkTimes(given.encode_s, given.register_s, given.optimise_s)
    fixed = use is not None and use.fixed
    swarm = Swarm(scenario, playbacks, Equipment(eyes, optimiser, times, opened, fixed, lives), seed)
    schedule(swarm, scenario.faults)
    return swarm


def playbacks_of(
    scenario: Scenario, recordings: Mapping[str, Path], drift: DriftSpec | None = None
) -> dict[str, Playback]:
    """What each robot of a scenario sees; walks drift as given, or as usual."""
    drawn = walks(scenario.tracks, drift) if scenario.tracks else []
    walked = {f"r{k + 1}": walk for k, walk in enumerate(drawn)}
    measured = sense(scenario.sensors, {name: walk.truth for name, walk in walked.items()}) if scenario.sensors else {}
    playbacks = {}
    for name in scenario.names():
        path = recordings.get(name) or scenario.robot(name).recording
        if path is not None:
            playbacks[name] = of_recording(Recording.open(path), scenario.keyframes)
        elif name in walked:
            walk = walked[name]
            seen = rows_of(measured.get(name, ()), walk.truth.stamps_s.tolist(), f"[sensors] of {name}")
            playbacks[name] = of_walk(walk, name, scenario.keyframes, seen)
        else:
            playbacks[name] = nothing()
    return playbacks


def run(swarm: Swarm) -> float:
    """Let time pass to the scenario's end, or until everything has settled; gives the end, seconds.

    Raises:
        FaultError: A fault lies far beyond all that is played.
    """
    scenario = swarm.scenario
    if scenario.duration_s is not None:
        swarm.run_until(scenario.duration_s)
        return scenario.duration_s
    played_s = max(_last_capture_s(swarm, name) for name in swarm.stations)
    last_s = max([played_s] + [fault.at_s for fault in scenario.faults])
    if last_s > played_s + FAULT_AFTER_LAST_S:
        raise FaultError(
            f"{scenario.name}: a fault at {last_s:g} s comes over {duration(FAULT_AFTER_LAST_S)} after the end of all "
            f"that is played ({played_s:.1f} s); give the scenario a duration_s if that is meant"
        )
    swarm.run_until(last_s)
    while swarm.agenda.now_s < last_s + LONGEST_AFTER_LAST_S and not _is_quiet(swarm, last_s):
        swarm.run_until(swarm.agenda.now_s + LOOK_S)
    return swarm.agenda.now_s


def write(
    folder: RunFolder,
    swarm: Swarm,
    seed: int,
    end_s: float,
    recordings: Mapping[str, Path] | None = None,
    use: MapUse | None = None,
) -> None:
    """Write what happened, what every robot knew at the end, and where its images are."""
    scenario = swarm.scenario
    given = {name: (recordings or {}).get(name) or scenario.robot(name).recording for name in swarm.stations}
    for name, station in swarm.stations.items():
        _write_robot(folder, swarm, name)
        if station.playback.truth is not None:
            write_truth(truth_path(folder, name), station.playback.truth)
    folder.write_events(line_of(told) for told in swarm.told)
    folder.write_run(
        Run(
            scenario=scenario.name,
            seed=seed,
            robots=list(swarm.stations),
            servers=scenario.servers(),
            driver="simulate",
            recordings={name: str(path.resolve()) for name, path in given.items() if path is not None},
            radio=scenario.links().model_dump(mode="json", exclude_defaults=True),
            settings={**scenario.settings(), **({} if use is None else use.settings())},
            perception=scenario.perception.model_dump(mode="json"),
            expectations=scenario.expectations.limits(),
            duration_s=end_s,
        )
    )


def _write_robot(folder: RunFolder, swarm: Swarm, name: str) -> None:
    station, traffic = swarm.stations[name], swarm.network.traffic.get(name)
    if traffic is not None:
        sent, received = dict(sorted(traffic.sent.items())), dict(sorted(traffic.received.items()))
        swarm.report(name, BytesCounted(sent=sent, received=received))
    links, stages = swarm.network.links.tables(name), counts_of(station.workers.stages.snapshot())
    swarm.report(name, AccountKept(since_s=0.0, **links, stages=stages))
    core = station.known(swarm.scenario.core)
    if core is not None:
        folder.write_result(result_of(core, station.playback.T_body_camera, station.solution))
    if station.running:
        swarm.report(name, AgentStopped())


def _last_capture_s(swarm: Swarm, name: str) -> float:
    playback, start_s = swarm.stations[name].playback, swarm.scenario.robot(name).start_s
    if not playback.captures:
        return start_s
    return start_s + (playback.captures[-1].stamp_s - playback.first_stamp_s) / swarm.scenario.rate


def _is_quiet(swarm: Swarm, last_s: float) -> bool:
    """Whether nothing of interest happened for the scenario's settling time."""
    if any(s.core.closing.load for s in swarm.running() if s.core):
        return False
    latest_s = next((told.t for told in reversed(swarm.told) if isinstance(told.fact, QUIET_KINDS)), 0.0)
    return swarm.agenda.now_s >= max(latest_s, last_s) + swarm.scenario.settle_s
