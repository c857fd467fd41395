"""The pictures of a run's recordings that its report shows, and what the front end matched in them.

The front end of the run looks at the pictures again, so that nothing needs to be kept while robots drive. Where the
recordings are gone, or the front end cannot tell, the report has that much less to show.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from flocc_agent.config import PerceptionConfig
from flocc_agent.core.interfaces import Camera, Image, Perception, SeenMatches
from flocc_agent.perception.backends import OWN, build_perception
from flocc_agent.runtime.recording import Frame, Recording
from flocc_launch.report.shown_pairs import (
    PAIRS_SHOWN,
    ShownPair,
    keyframes_of,
    shown_pairs,
    views,
)
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.run_folder import RunFolder
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId

Float = NDArray[np.float64]
Progress = Callable[[int, int], None]

PAIR_SIDE_PX = 400
VIEW_SIDE_PX = 170
JPEG_QUALITY = 68
PICTURE_MIN_PX = 16
"""What is lower or narrower is a code for synthetic perception, which nobody wants to look at."""
SAME_STAMP_S = 1e-3
LINES_MAX = 60
"""Lines that are drawn of the matches that agree, and of those that do not; more of them hide the pictures."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture as the page holds it."""

    jpeg: bytes
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """SeenMatches of a pair to draw; positions are (x, y) from 0 to 1 within each picture.

    Attributes:
        agree: (K, 4) positions in query and match of those that agree.
        others: (L, 4) of those that do not.
        agree_count: How many agree, drawn or not.
        count: How many there are, drawn or not.
    """

    agree: Float
    others: Float
    agree_count: int
    count: int


@dataclass(frozen=True, slots=True)
class Album:
    """What is shown of a run as pictures.

    Attributes:
        pairs: Pairs with both pictures, in the order of the page.
        pictures: Of every keyframe of a pair.
        matches: Of the pairs whose front end can tell, by the pair's name.
        views: Small pictures along the robots' ways.
        pairs_left_out: Pairs that would be worth a picture too, beyond the number asked for.
    """

    pairs: tuple[ShownPair, ...] = ()
    pictures: Mapping[KeyframeId, Picture] = field(default_factory=dict)
    matches: Mapping[str, Drawn] = field(default_factory=dict)
    views: Mapping[KeyframeId, Picture] = field(default_factory=dict)
    pairs_left_out: int = 0


EMPTY = Album()


def album_of(
    folder: RunFolder, loaded: LoadedRun, pairs_max: int = PAIRS_SHOWN, progress: Progress | None = None
) -> Album:
    """Read the pictures that are worth showing, as far as the recordings are there.

    Args:
        folder: The run.
        loaded: The same, read.
        pairs_max: Pairs to show at most; 0 shows no pictures at all.
        progress: Called with (done, all) pictures and pairs.
    """
    if pairs_max == 0:
        return EMPTY
    shelf = Shelf(folder, loaded)
    wanted = shown_pairs(loaded, pairs_max)
    images = {keyframe: image for keyframe in keyframes_of(wanted) if (image := shelf.image(keyframe)) is not None}
    pairs = tuple(each for each in wanted if each.pair.query in images and each.pair.match in images)
    seen = {keyframe: image for keyframe in views(loaded) if (image := shelf.image(keyframe)) is not None}
    return Album(
        pairs=pairs,
        pictures={keyframe: jpeg_of(image, PAIR_SIDE_PX) for keyframe, image in images.items()},
        matches=matches_of(loaded, pairs, images, progress or unheard),
        views={keyframe: jpeg_of(image, VIEW_SIDE_PX) for keyframe, image in seen.items()},
        pairs_left_out=len(shown_pairs(loaded, len(loaded.pairs))) - len(wanted) if pairs else 0,
    )


def unheard(done: int, total: int) -> None:
    """Progress that nobody asked for."""


class Shelf:
    """The recordings of a run, opened when a picture of them is asked for."""

    def __init__(self, folder: RunFolder, loaded: LoadedRun) -> None:
        self._folder = folder
        self._loaded = loaded
        self._recordings: dict[str, Recording | None] = {}

    def image(self, keyframe: KeyframeId) -> Image | None:
        """What a robot saw at a keyframe; None where that is no longer there."""
        track = self._loaded.tracks.get(keyframe.log.robot)
        if track is None or keyframe.log.incarnation != track.incarnation or keyframe.index >= len(track):
            return None
        recording = self._recording(keyframe.log.robot)
        frame = None if recording is None else frame_at(recording, float(track.stamps_s[keyframe.index]))
        if recording is None or frame is None:
            return None
        if min(recording.camera.width, recording.camera.height) < PICTURE_MIN_PX:
            return None
        try:
            return recording.load_image(frame)
        except FloccError:
            return None

    def _recording(self, robot: str) -> Recording | None:
        if robot not in self._recordings:
            path = self._folder.recording(robot)
            try:
                there = path is not None and (path / "images.txt").is_file()
                self._recordings[robot] = Recording.open(path) if path is not None and there else None
            except FloccError:
                self._recordings[robot] = None
        return self._recordings[robot]


def frame_at(recording: Recording, stamp_s: float) -> Frame | None:
    """The frame of a stamp."""
    nearest = min(recording.frames, key=lambda frame: abs(frame.stamp_s - stamp_s))
    return nearest if abs(nearest.stamp_s - stamp_s) <= SAME_STAMP_S else None


def jpeg_of(image: Image, side_px: int) -> Picture:
    """A smaller copy whose longer side has so many pixels at most."""
    height, width = image.pixels.shape[:2]
    factor = min(1.0, side_px / max(width, height))
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    small = cv2.resize(image.pixels, size, interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    done, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done
    return Picture(encoded.tobytes(), *size)


def matches_of(
    loaded: LoadedRun, pairs: tuple[ShownPair, ...], images: Mapping[KeyframeId, Image], progress: Progress
) -> dict[str, Drawn]:
    """What the run's front end matches in each pair; nothing where it is not flocc's own or cannot tell."""
    perception = front_end(loaded)
    if perception is None or not pairs:
        return {}
    keyframes, total = keyframes_of(pairs), len(keyframes_of(pairs)) + len(pairs)
    latents: dict[KeyframeId, bytes] = {}
    for done, keyframe in enumerate(keyframes):
        progress(done, total)
        latents[keyframe] = perception.encode(images[keyframe])
    found: dict[str, Drawn] = {}
    for done, each in enumerate(pairs, start=len(keyframes)):
        progress(done, total)
        query, match = each.pair.query, each.pair.match
        matches = perception.matches(latents[query], latents[match])
        if matches is None:
            return {}
        found[each.name] = drawn(matches, images[query].camera, images[match].camera)
    return found


def front_end(loaded: LoadedRun) -> Perception | None:
    """What the robots saw with, built again; None where the run does not say, or it cannot be built here."""
    try:
        config = PerceptionConfig.model_validate(loaded.run.perception or {})
        known = bool(loaded.run.perception) and config.method in OWN
        return build_perception(config, loaded.run.seed or 0) if known else None
    except (FloccError, ValidationError):
        return None


def drawn(matches: SeenMatches, query: Camera, match: Camera) -> Drawn:
    """SeenMatches as lines between two pictures."""
    both = np.hstack([within(matches.query, query), within(matches.match, match)])
    agree, others = both[matches.agree], both[~matches.agree]
    return Drawn(some(agree), some(others), len(agree), len(both))


def within(rays: Float, camera: Camera) -> Float:
    """Where rays (N, 2) without distortion lie in the picture, from 0 to 1 (N, 2)."""
    if not len(rays):
        return np.zeros((0, 2))
    points = np.column_stack([rays, np.ones(len(rays))])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K(), np.array(camera.distortion))
    return np.asarray((pixels.reshape(-1, 2) + 0.5) / [camera.width, camera.height])


def some(lines: Float) -> Float:
    """At most `LINES_MAX` of the lines, evenly."""
    return lines if len(lines) <= LINES_MAX else lines[np.linspace(0, len(lines) - 1, LINES_MAX).astype(int)]
