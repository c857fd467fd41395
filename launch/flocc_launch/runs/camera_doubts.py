"""What robots told of their own cameras, in sentences: one for each robot and doubt, the latest."""

from collections.abc import Iterable
from dataclasses import dataclass

from flocc_agent.core.reports import CameraDoubted, Fact
from flocc_agent.runtime.event_lines import Reported, of_kind

AXES_TURN_MIN_DEG = 60.0
"""A mounting off by so much is no screw that came loose."""
HARMLESS = frozenset({"overlay"})
"""Doubts of which the robot took care itself."""

AXES = (
    "The axes seem to be another convention's: T_body_camera is missing, or odometry is of the body (x forward, z up) "
    "where the camera's is meant (z forward), or the camera hangs upside down; who moves in a plane sees mirrored "
    "pictures (selfie mode, a flip in the driver) as such a one does."
)
KEPT_OUT = "As long as its pictures say so its keyframes are kept out of closures."
ADVICE = {
    "focal length": (
        "Calibrate at the size in which the pictures arrive, or multiply fx and fy by that; a zoom, a crop or a "
        "stabiliser does this."
    ),
    "mounting": "Correct T_body_camera, or fasten the camera.",
    "focal length and mounting": "Calibrate the camera at the size in which its pictures arrive, and T_body_camera.",
    "mirrored": "Turn mirroring (selfie mode, a flip in the driver) off.",
    "inverted poses": "Invert the poses: odometry is T_odom_body, where the body is, not where the world is from it.",
    "mixed frames": (
        "Look at how the trajectory was converted: its positions and orientations are of different frames (ENU and "
        "NED, or body and camera)."
    ),
    "overlay": (
        "It was left out once it was found; a mask.png in the robot's folder, as large as the images and black where "
        "they show it, leaves it out from the first."
    ),
    "frozen": (
        "They were not used. Look at the camera, its cable and its driver. Only where pictures have no noise, in a "
        "simulator, does a robot that stands still see the very same."
    ),
    "standing": (
        "They were not used. Look at what drives it and at odometry: wheels that slip or are blocked turn on. If it "
        "did move, look at the camera's stream, which then repeats a picture and codes it anew."
    ),
}


@dataclass(frozen=True, slots=True)
class DoubtSentence:
    """What is to be said of a camera.

    Attributes:
        robot: Whose.
        doubt: As in `CameraDoubted`.
        sentence: What was found.
        advice: What to change.
        withheld: As in `CameraDoubted`.
    """

    robot: str
    doubt: str
    sentence: str
    advice: str
    withheld: bool

    @property
    def headline(self) -> str:
        """The first clause of the sentence: robot, and figure."""
        return f"{self.sentence.partition(': ')[0].partition('. ')[0].rstrip('.')}."

    @property
    def matters(self) -> bool:
        """Whether somebody has to do something."""
        return self.doubt not in HARMLESS


def camera_doubts(events: Iterable[Reported[Fact]]) -> list[DoubtSentence]:
    """Every robot's doubts, by name."""
    latest = {(told.robot, told.fact.doubt): told.fact for told in of_kind(events, CameraDoubted)}
    return [doubt_of(robot, fact) for (robot, _), fact in sorted(latest.items())]


def doubt_of(robot: str, fact: CameraDoubted) -> DoubtSentence:
    """What is to be said of one doubt."""
    return DoubtSentence(robot, fact.doubt, _sentence(robot, fact), _advice(fact), fact.withheld)


def _sentence(robot: str, fact: CameraDoubted) -> str:
    pairs = f"{fact.pairs} pairs of consecutive keyframes"
    inverted = "odometry gives the world from the camera, not the camera in the world"
    share = f"{100 * fact.amount:.0f} %"
    off = f"{fact.amount:.2f} times ({100 * (fact.amount - 1):+.0f} %) what is configured"
    sentences = {
        "focal length": f"{robot}'s focal length is {off}, say {pairs} against its odometry.",
        "mounting": f"{robot}'s camera is turned by {fact.amount:.1f} degrees against its odometry: {fact.where}.",
        "focal length and mounting": f"{robot}'s focal length is {off}, and its camera turned: {fact.where}.",
        "mirrored": f"{robot}'s pictures are mirrored, say {pairs} against its odometry.",
        "inverted poses": f"{robot}'s {inverted}, say {pairs}.",
        "mixed frames": f"{robot}'s odometry moves in other directions than its pictures, though both turn alike.",
        "overlay": f"{share} of {robot}'s pictures ({fact.where}) move with the camera: {_guess(fact)}.",
        "frozen": f"{fact.amount:.0f} or more pictures of {robot} are ones that it took before, though it had moved.",
        "standing": (
            f"{fact.amount:.0f} or more pictures of {robot} show what one before did, but for the camera's noise: it "
            "stood still while its odometry went on."
        ),
    }
    said = sentences.get(fact.doubt, f"{robot}'s camera: {fact.doubt} {fact.amount:g} {fact.where}".rstrip() + ".")
    return f"{said} {KEPT_OUT}" if fact.withheld else said


def _guess(fact: CameraDoubted) -> str:
    return "its own body or bumper" if fact.amount > 0.08 else "a logo, a burnt-in clock, dirt or a part of the robot"


def _advice(fact: CameraDoubted) -> str:
    if fact.doubt == "mounting" and fact.amount >= AXES_TURN_MIN_DEG:
        return AXES
    return ADVICE.get(fact.doubt, "Update flocc here: what this robot tells is newer.")
