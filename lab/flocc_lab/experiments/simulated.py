"""One simulated run as an experiment's cell: nothing of it stays but what is measured."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from flocc_agent.core.reports import Fact
from flocc_agent.runtime.event_lines import Reported
from flocc_launch.report.finish import finish
from flocc_launch.report.model import RunReport
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import playbacks_of, run, swarm_of, write


@dataclass(frozen=True, slots=True)
class Simulated:
    """What a run left.

    Attributes:
        report: As in its folder.
        events: All of them.
        latent_bytes: Latents on all robots' disks at the end.
        record_bytes: Records on all robots' disks at the end, every robot's copy counted.
    """

    report: RunReport
    events: list[Reported[Fact]]
    latent_bytes: int
    record_bytes: int


def simulated(
    scenario: Scenario, seed: int, recordings: Mapping[str, Path] | None = None, cache: Path | None = None
) -> Simulated:
    """Run a scenario on virtual time; as `flocc simulate`."""
    swarm = swarm_of(scenario, playbacks_of(scenario, recordings or {}), seed, cache)
    end_s = run(swarm)
    with TemporaryDirectory(prefix="flocc-experiment-") as parent:
        folder = RunFolder.create(Path(parent) / "run")
        write(folder, swarm, seed, end_s)
        report, events = finish(folder), folder.events()
    disks = [station.disk for station in swarm.stations.values()]
    records = sum(len(data) for disk in disks for log in disk.records.values() for data in log)
    return Simulated(report, events, sum(disk.latent_bytes for disk in disks), records)
