"""A run, read once: what the report is computed from."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from flocc_agent.core.reports import Fact
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.robot_result import RobotResult
from flocc_launch.runs.closure_table import Pair, pairs_of
from flocc_launch.runs.ground_truth import ground_truth
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.run_records import Run
from flocc_launch.runs.timeline import Following, Link, end_s, followings, links
from flocc_launch.runs.tracks import RobotTrack, tracks_of


@dataclass(frozen=True, slots=True, eq=False)
class LoadedRun:
    """Everything that a run folder holds, and what follows from it over time."""

    run: Run
    robots: tuple[str, ...]
    events: tuple[Reported[Fact], ...]
    results: Mapping[str, RobotResult]
    tracks: Mapping[str, RobotTrack]
    pairs: tuple[Pair, ...]
    followings: tuple[Following, ...]
    links: tuple[Link, ...]
    end_s: float
    barred: Mapping[str, Path]
    """Recordings that this user may not read, by robot."""


def load(folder: RunFolder) -> LoadedRun:
    """Read a run folder.

    Raises:
        RunFolderError: Something in it is missing, cut off or of another type.
        RecordingError: Its ground truth is.
    """
    run, events, results = folder.run(), tuple(folder.events()), folder.results()
    end = end_s(events, run.duration_s)
    return LoadedRun(
        run=run,
        robots=tuple(sorted(run.robots)),
        events=events,
        results=results,
        tracks=tracks_of({robot: ground_truth(folder, robot) for robot in run.robots}, results, events),
        pairs=tuple(pairs_of(events, results.values())),
        followings=tuple(followings(events, end)),
        links=tuple(links(events, end)),
        end_s=end,
        barred=folder.barred(),
    )
