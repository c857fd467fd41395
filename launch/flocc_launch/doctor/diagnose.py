"""Why the maps of a run have or have not merged, and what to change.

Two robots merge when a chain of steps holds: both take keyframes, their records meet, places look alike, latents
arrive, registrations are accepted, a leader optimises, its corrections arrive. For every two groups of robots that
did not merge, the pair that came furthest is looked at, and the first step that failed is named.
"""

from collections.abc import Iterable, Sequence

from flocc_agent.runtime.facts import AgentDied
from flocc_launch.doctor.cameras import finding_of, kept_out, merged_doubtfully
from flocc_launch.doctor.finding import Finding, Severity, together
from flocc_launch.doctor.general import GENERAL
from flocc_launch.doctor.merge_evidence import named
from flocc_launch.doctor.steps import STEPS
from flocc_launch.runs.alike_places import ADVICE, alike_places
from flocc_launch.runs.loaded_run import LoadedRun, load
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.timeline import ends


def diagnose(folder: RunFolder) -> list[Finding]:
    """Say why the maps of a run have or have not merged, what blocks first.

    Raises:
        RunFolderError: The folder is cut off or damaged.
    """
    return diagnose_loaded(load(folder))


def diagnose_loaded(loaded: LoadedRun) -> list[Finding]:
    """As `diagnose`, of a run that was read already."""
    findings = [*merging(loaded), *(finding for look in GENERAL for finding in look(loaded))]
    order = list(Severity)
    return sorted(together(findings), key=lambda finding: order.index(finding.severity))


def merging(loaded: LoadedRun) -> list[Finding]:
    """One finding for every two groups of living robots that are in different maps; or that all is well."""
    groups = groups_of(loaded)
    if sum(len(group) for group in groups) < 2:
        return []
    if len(groups) == 1 and loaded.tracks[groups[0][0]].map_frame is not None:
        frame = loaded.tracks[groups[0][0]].map_frame
        sentence = f"All {len(groups[0])} robots{living(loaded, groups[0])} are in {frame}."
        misplaced = kept_out(loaded, groups[0])
        if misplaced:
            return [merged_doubtfully(sentence, misplaced)]
        alike = alike_places(loaded)
        if alike:
            who = tuple(each.robot for each in alike)
            why = " ".join(each.headline for each in alike)
            return [Finding("places-alike", Severity.HINDERS, f"{why} {sentence}", ADVICE, who)]
        return [Finding("merged", Severity.GOOD, sentence, robots=groups[0])]
    return [furthest(loaded, first, second) for k, first in enumerate(groups) for second in groups[k + 1 :]]


def living(loaded: LoadedRun, group: Sequence[str]) -> str:
    """That others do not count, where there are any."""
    others = [robot for robot in loaded.robots if robot not in group and robot not in loaded.run.servers]
    return f" that lived to the end (without {named(others)})" if others else ""


def groups_of(loaded: LoadedRun) -> list[tuple[str, ...]]:
    """Living robots with a camera by their map frame at the end; a robot without a frame is a group of its own."""
    died = {robot for robot, end in ends(loaded.events).items() if isinstance(end.fact, AgentDied)}
    groups: dict[str, list[str]] = {}
    for robot in loaded.robots:
        if robot not in died and robot not in loaded.run.servers:
            frame = loaded.tracks[robot].map_frame
            groups.setdefault(frame if frame is not None else f"none of {robot}", []).append(robot)
    return [tuple(group) for _, group in sorted(groups.items())]


def furthest(loaded: LoadedRun, first: Iterable[str], second: Iterable[str]) -> Finding:
    """What stopped the pair of robots that came furthest towards merging two groups."""
    stopped = [stop(loaded, a, b) for a in first for b in second]
    return max(stopped, key=lambda found: found[0])[1]


def stop(loaded: LoadedRun, a: str, b: str) -> tuple[int, Finding]:
    """The first step that failed between two robots, with its number."""
    misplaced = kept_out(loaded, (a, b))
    if misplaced:
        return -1, finding_of(misplaced[0], Severity.BLOCKS)
    for number_of, step in enumerate(STEPS):
        found = step(loaded, a, b)
        if found is not None:
            return number_of, found
    sentence = f"{a} and {b} have closures and corrections, and yet two maps."
    return len(STEPS), Finding("unknown", Severity.BLOCKS, sentence, "Please report this run.", (a, b))
