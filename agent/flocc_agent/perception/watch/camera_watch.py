"""Watches one robot's camera while its keyframes are encoded: what it tells is said once, by name and figure.

Three looks. Does the picture show what one before did, though the robot moved? Then it is not encoded: it would be a
place where the robot is not. Does part of it stay while the robot turns? Then features and place descriptor leave that
part out from now on. Do motions between consecutive keyframes agree with odometry's? The first ones are all looked at,
later ones now and then, since a camera can be knocked, or zoomed, on the way. As long as they say that its axes are
others than odometry's, its keyframes carry odometry only: closures with them would put the robot where it is not.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Image, KeyframeLook, Perception
from flocc_agent.core.reports import WITHHELD, CameraDoubted
from flocc_agent.geometry import so3_log
from flocc_agent.perception.watch.camera_verdict import (
    CameraFault,
    CameraVerdict,
    WatchedPair,
    camera_verdict,
    shows_camera,
)
from flocc_agent.perception.watch.overlay import OverlayFinder, Repeat, place_of
from flocc_agent.perception.watch.seen_motion import Flow
from flocc_agent.stages import stage

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

PAIRS_MAX = 30
"""Pairs that a verdict rests on; the latest ones."""
JUDGED_AT = (5, 6, 7, 8, 10, 12, 15, 18, 20, 25, 30)
"""Numbers of pairs at which the camera is judged."""
EVERY_LATER = 4
"""Of later pairs every fourth is looked at, and every fourth of these is judged."""
WITHDRAWN_MAX = PAIRS_MAX * EVERY_LATER
"""Keyframes that a verdict takes back: those whose pairs it rests on."""
REPEATS_TOLD = (2, 10, 50, 250)
"""A single repeated picture is a hiccup."""
OVERLAY_MIN_RATIO = 0.004
OVERLAY_STEP_RATIO = 0.1
"""An overlay is told again when it turns out larger by so much."""
FOCAL_STEP_RATIO = 0.04
"""A focal length is told again when it turns out to be off from what was told by so much."""
REPEATED = {
    Repeat.SAME_PICTURE: ("frozen", "the picture is one that was taken before, though the robot moved"),
    Repeat.SAME_VIEW: ("standing", "the picture shows what one before did, though by odometry the robot moved"),
}
"""What is doubted of a picture that repeats, and why it is not encoded."""
TOLD_MAX = 16
"""Doubts that one start of an agent tells."""


@runtime_checkable
class SeesFlow(Protocol):
    """A registrar that can say which points moved from where to where between two own pictures."""

    def flow(self, before: bytes, now: bytes, T_odom_before: Float, T_odom_now: Float) -> Flow | None:
        """Verified matches of two latents, or None where they are few; (4, 4) camera poses by odometry, metres."""
        ...


class CameraWatch:
    """What is known of one robot's camera."""

    def __init__(self, hidden: Mask | None = None, up_odom: Sequence[float] | None = None) -> None:
        """Start without suspicion.

        Args:
            hidden: (H, W) pixels that the user says move with the camera.
            up_odom: (3,) direction against gravity in the odometry frame, where odometry keeps roll and pitch.
        """
        self._given = hidden
        self._up_odom = None if up_odom is None else np.array(up_odom) / np.linalg.norm(up_odom)
        self._finder: OverlayFinder | None = None
        self._before: tuple[bytes, Float] | None = None
        self._pairs: deque[WatchedPair] = deque(maxlen=PAIRS_MAX)
        self._seen = 0
        self._repeats = Counter[Repeat]()
        self._told: list[CameraDoubted] = []
        self._withheld: CameraFault | None = None
        self._looked = 0

    def look(self, perception: Perception, image: Image, T_odom_camera: Float) -> KeyframeLook:
        """Describe and encode the next keyframe's image as far as it shows the scene, and tell what is odd about it.

        Args:
            perception: What describes and encodes.
            image: Of the keyframe.
            T_odom_camera: (4, 4) by odometry, metres.
        """
        doubts = []
        earlier, was_withheld = min(self._looked, WITHDRAWN_MAX), self._withheld is not None
        self._looked += 1
        if isinstance(perception.registrar, SeesFlow):
            with stage("watch"):
                repeat = self._look_at(image, T_odom_camera)
                doubts += self._overlay() if repeat is None else self._repeated(repeat)
            if repeat is not None:
                return KeyframeLook(None, None, REPEATED[repeat][1], tuple(doubts))
        told = any(doubt.doubt == "overlay" for doubt in doubts)
        image = self._upright(self._without_hidden(image), T_odom_camera)
        with stage("describe"):
            descriptor = perception.describe(image)
        with stage("encode"):
            latent = perception.encode(image)
        if isinstance(perception.registrar, SeesFlow):
            with stage("watch"):
                doubts += self._motion(perception.registrar, latent, T_odom_camera)
        if self._withheld is not None:
            return KeyframeLook(None, None, WITHHELD, tuple(doubts), withdrawn=0 if was_withheld else earlier)
        hidden = image.hidden if told else None
        return KeyframeLook(descriptor, latent, "", tuple(doubts), hidden, 0 if hidden is None else earlier)

    def _look_at(self, image: Image, T_odom_camera: Float) -> Repeat | None:
        """Take the picture in; how it repeats an earlier one."""
        if self._finder is None:
            self._finder = OverlayFinder(image.camera)
        grey = np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY), np.uint8)
        return self._finder.add(grey, T_odom_camera)

    def _without_hidden(self, image: Image) -> Image:
        """The image with what moves with the camera marked."""
        size = image.camera.width, image.camera.height
        found = None if self._finder is None or not self._finder.cells().any() else self._finder.mask(size)
        given = self._given if self._given is not None and self._given.shape == size[::-1] else None
        masks = [mask for mask in (found, given) if mask is not None]
        return replace(image, hidden=np.logical_or.reduce(masks)) if masks else image

    def _upright(self, image: Image, T_odom_camera: Float) -> Image:
        """The image with the direction against gravity, where odometry knows it."""
        return image if self._up_odom is None else replace(image, up=T_odom_camera[:3, :3].T @ self._up_odom)

    def _repeated(self, repeat: Repeat) -> list[CameraDoubted]:
        self._repeats[repeat] += 1
        count = self._repeats[repeat]
        if count not in REPEATS_TOLD:
            return []
        return self._tell(CameraDoubted(doubt=REPEATED[repeat][0], amount=count, where="", pairs=count))

    def _overlay(self) -> list[CameraDoubted]:
        """Tell of cells that stay, the first time and when they turn out to be many more."""
        assert self._finder is not None
        cells = self._finder.cells()
        ratio = float(np.mean(cells))
        known = max((told.amount for told in self._told if told.doubt == "overlay"), default=-OVERLAY_STEP_RATIO)
        if ratio < max(OVERLAY_MIN_RATIO, known + OVERLAY_STEP_RATIO):
            return []
        return self._tell(
            CameraDoubted(doubt="overlay", amount=round(ratio, 3), where=place_of(cells), pairs=self._seen)
        )

    def _motion(self, registrar: SeesFlow, latent: bytes, T_odom_camera: Float) -> list[CameraDoubted]:
        """Take the motion since the keyframe before into account, and judge the camera when it is time."""
        before, self._before = self._before, (latent, T_odom_camera)
        self._seen += 1
        if before is None or (self._seen > PAIRS_MAX and self._seen % EVERY_LATER):
            return []
        flow = registrar.flow(before[0], latent, before[1], T_odom_camera)
        if flow is None:
            return []
        self._pairs.append(WatchedPair(flow))
        count = len(self._pairs)
        is_time = count in JUDGED_AT if self._seen <= PAIRS_MAX else self._seen % EVERY_LATER**2 == 0
        if not is_time or not shows_camera(self._pairs):
            return []
        verdict = camera_verdict(self._pairs, self._withheld)
        self._withheld = verdict.fault if verdict is not None and verdict.places_wrongly else None
        return [] if verdict is None else self._judged(verdict)

    def _judged(self, verdict: CameraVerdict) -> list[CameraDoubted]:
        doubt = _doubt_of(verdict)
        kind = doubt.doubt, doubt.withheld
        known = next((told for told in reversed(self._told) if (told.doubt, told.withheld) == kind), None)
        is_focal = verdict.fault is CameraFault.FOCAL_LENGTH
        if known is not None and not (is_focal and abs(known.amount / doubt.amount - 1.0) > FOCAL_STEP_RATIO):
            return []
        return self._tell(doubt)

    def _tell(self, doubt: CameraDoubted) -> list[CameraDoubted]:
        if len(self._told) >= TOLD_MAX:
            return []
        self._told.append(doubt)
        return [doubt]


def _doubt_of(verdict: CameraVerdict) -> CameraDoubted:
    """The verdict as it is told: a focal length as a factor, a mounting in degrees."""
    turn_deg = np.degrees(so3_log(verdict.X))
    is_turned = verdict.fault in (CameraFault.MOUNTING, CameraFault.BOTH)
    amount = float(np.linalg.norm(turn_deg)) if verdict.fault is CameraFault.MOUNTING else verdict.focal_factor
    where = _about(turn_deg) if is_turned else ""
    return CameraDoubted(
        doubt=verdict.fault.value,
        amount=round(amount, 3),
        where=where,
        pairs=verdict.pairs,
        withheld=verdict.places_wrongly,
    )


def _about(turn_deg: Float) -> str:
    """A turn in words, about the camera's axes."""
    x, y, z = (round(float(value), 1) for value in turn_deg)
    return f"{x:g} degrees about x (right), {y:g} about y (down), {z:g} about z (forward)"
