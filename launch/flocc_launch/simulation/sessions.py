"""`flocc map sessions`: recordings of different times, one after the other, each in the map of those before it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from flocc_agent.runtime.map_folder import BadMap, MapFolder, MapManifest
from flocc_launch.maps.map_saving import copy_map, save_map
from flocc_launch.maps.opening import MapUse
from flocc_launch.maps.solving import NotSolved
from flocc_launch.maps.writing import check_target
from flocc_launch.report.model import RunReport
from flocc_launch.scenarios.scenario import Expectations, RobotScenario, Scenario
from flocc_launch.simulation.simulate import simulate


@dataclass(frozen=True, slots=True)
class Session:
    """One recording: its run's report, and why it is not in the map, None where it is."""

    name: str
    report: RunReport
    left_out: str | None


def map_of_sessions(
    scenario: Scenario,
    recordings: Mapping[str, Path],
    out: Path,
    runs: Path,
    begin: Path | None = None,
    cache: Path | None = None,
    tell: Callable[[Session], None] = lambda _: None,
) -> MapManifest:
    """Run one recording after the other on virtual time, and save the map of all that found each other.

    Args:
        scenario: Perception, keyframes and whatever else is the same for all.
        recordings: By name; their names sorted are the order of the sessions.
        out: Folder of the map.
        runs: Folder for the run and the map of each session.
        begin: A map to begin with; None: the first session begins one.
        cache: As of `simulate`.
        tell: Told of each session as soon as it is over.

    Raises:
        FloccError: A session cannot be run, no session gives a map, or a folder cannot be written.
    """
    check_target(out, *([] if begin is None else [begin]))
    if runs.exists() and any(runs.iterdir()):
        raise BadMap(f"{runs}: is not empty; choose another --runs")
    latest = begin
    for number, name in enumerate(sorted(recordings), start=1):
        run = runs / f"{number:02d}-{name}"
        use = None if latest is None else MapUse(latest)
        report = simulate(
            alone(scenario, name, recordings[name]), run, recordings=dict(recordings), cache=cache, use=use
        )
        try:
            save_map(run, run / "map", name=out.name)
        except NotSolved as error:
            tell(Session(name, report, str(error)))
            continue
        latest = run / "map"
        tell(Session(name, report, None))
    if latest is None or latest == begin:
        raise BadMap(f"{runs}: no session gave a map, or found itself in the one that was given")
    return copy_map(MapFolder.open(latest), out)


def alone(scenario: Scenario, name: str, recording: Path) -> Scenario:
    """A scenario with one of its robots, whatever made its recording; without faults and hopes."""
    sources = dict.fromkeys(("world", "dataset", "tracks", "sensors"))
    only = {"robots": {name: RobotScenario(recording=recording)}, "faults": (), "rendezvous": ()}
    return scenario.model_copy(update={**sources, **only, "expectations": Expectations()})
