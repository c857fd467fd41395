"""Findings on cameras: what robots' own pictures said against their odometry and calibration."""

from collections.abc import Collection, Iterable, Sequence

from flocc_agent.core.reports import CameraDoubted
from flocc_launch.dashboard.status_table import RobotStatus
from flocc_launch.doctor.finding import Finding, Severity
from flocc_launch.doctor.merge_evidence import named
from flocc_launch.runs.camera_doubts import DoubtSentence, camera_doubts, doubt_of
from flocc_launch.runs.loaded_run import LoadedRun

CAUSES = {
    "focal length": "focal-length",
    "mounting": "camera-turned",
    "focal length and mounting": "focal-length",
    "mirrored": "mirrored",
    "inverted poses": "inverted-poses",
    "mixed frames": "mixed-frames",
    "overlay": "overlay",
    "frozen": "frozen-pictures",
    "standing": "stands-still",
}
OTHER_CAUSE = "camera"
"""Of a doubt that this version does not know."""


def doubted_cameras(loaded: LoadedRun) -> list[Finding]:
    """One finding for each robot and doubt; what a robot took care of itself is worth knowing only."""
    return findings_of(camera_doubts(loaded.events))


def doubts_told(rows: Iterable[RobotStatus]) -> list[DoubtSentence]:
    """What the robots of a running swarm say of their cameras."""
    return [doubt_of(row.robot, CameraDoubted(**told.model_dump())) for row in rows for told in row.camera]


def findings_of(doubts: Iterable[DoubtSentence]) -> list[Finding]:
    """A finding for each doubt: does somebody have to do something?"""
    return [finding_of(doubt, Severity.HINDERS if doubt.matters else Severity.NOTE) for doubt in doubts]


def merged_doubtfully(sentence: str, misplaced: Sequence[DoubtSentence]) -> Finding:
    """One map, with robots in it whose cameras' axes are not their odometry's: closures from before that was known."""
    who = tuple(sorted({doubt.robot for doubt in misplaced}))
    why = " ".join(doubt.headline for doubt in misplaced)
    doubtful = f"{why} Do not believe where {named(who)} {'is' if len(who) == 1 else 'are'}. {sentence}"
    return Finding("merged-doubtfully", Severity.HINDERS, doubtful, misplaced[0].advice, who)


def kept_out(loaded: LoadedRun, robots: Collection[str]) -> list[DoubtSentence]:
    """What keeps the keyframes of any of these robots out of closures."""
    return [doubt for doubt in camera_doubts(loaded.events) if doubt.withheld and doubt.robot in robots]


def finding_of(doubt: DoubtSentence, severity: Severity) -> Finding:
    """The finding that says a doubt."""
    return Finding(CAUSES.get(doubt.doubt, OTHER_CAUSE), severity, doubt.sentence, doubt.advice, (doubt.robot,))
