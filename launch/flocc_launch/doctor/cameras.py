"""Findings on cameras: what robots' own pictures said against their odometry and calibration."""

from collections.abc import Collection

from flocc_launch.doctor.finding import Finding, Severity
from flocc_launch.runs.camera_doubts import DoubtSentence, camera_doubts
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
}
OTHER_CAUSE = "camera"
"""Of a doubt that this version does not know."""


def doubted_cameras(loaded: LoadedRun) -> list[Finding]:
    """One finding for each robot and doubt; what a robot took care of itself is worth knowing only."""
    return [
        finding_of(doubt, Severity.HINDERS if doubt.matters else Severity.NOTE)
        for doubt in camera_doubts(loaded.events)
    ]


def kept_out(loaded: LoadedRun, robots: Collection[str]) -> list[DoubtSentence]:
    """What keeps the keyframes of any of these robots out of closures."""
    return [doubt for doubt in camera_doubts(loaded.events) if doubt.withheld and doubt.robot in robots]


def finding_of(doubt: DoubtSentence, severity: Severity) -> Finding:
    """The finding that says a doubt."""
    return Finding(CAUSES.get(doubt.doubt, OTHER_CAUSE), severity, doubt.sentence, doubt.advice, (doubt.robot,))
