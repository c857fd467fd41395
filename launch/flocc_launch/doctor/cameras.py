"""Findings on cameras: what robots' own pictures said against their odometry and calibration."""

from flocc_launch.doctor.finding import Finding, Severity
from flocc_launch.runs.camera_doubts import camera_doubts
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
        Finding(
            CAUSES.get(doubt.doubt, OTHER_CAUSE),
            Severity.HINDERS if doubt.matters else Severity.NOTE,
            doubt.sentence,
            doubt.advice,
            (doubt.robot,),
        )
        for doubt in camera_doubts(loaded.events)
    ]
