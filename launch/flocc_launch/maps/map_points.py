"""A sparse cloud of a map: points that two keyframes of a closure both see, where the solution puts them.

What the front end matched in the latents of a used closure is matched again, and each match that agrees with one
relative pose becomes a point by the two keyframes' poses in the map, where their rays nearly meet in front of both.
Its colour is that of its pixel where the recording is at hand, else its log's.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.interfaces import Perception, SeenMatches
from flocc_agent.runtime.map_folder import MapFolder
from flocc_agent.runtime.recording import Frame, Recording
from flocc_launch.maps.gathering import stamps_s
from flocc_launch.maps.thumbnails import frame_at
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]
Colours = NDArray[np.uint8]
Progress = Callable[[int, int], None]

PARALLAX_MIN_RAD = np.deg2rad(1.5)
"""Rays that meet at a smaller angle say nothing of how far the point is."""
OFF_MAX_RAD = np.deg2rad(0.5)
"""How far a point may lie from where either keyframe sees it: its poses are off by as much."""
CLOSURES_MAX = 2000
"""Closures that are matched again; of more, so many evenly spread ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """A cloud.

    Attributes:
        at_m: (N, 3) in the map.
        colours: (N, 3) red, green, blue.
        closures: How many closures gave some.
    """

    at_m: Float
    colours: Colours
    closures: int


def points_of(
    opened: MapFolder,
    perception: Perception,
    recordings: Mapping[LogId, Path],
    colour_of: Mapping[LogId, tuple[int, int, int]],
    progress: Progress,
) -> Points | None:
    """The cloud of a map's used closures; None where the front end cannot tell what it matched.

    Args:
        opened: The map.
        perception: The front end that made it.
        recordings: Those at hand, for colours.
        colour_of: A log's, where it has no recording.
        progress: Called with (done, all) closures.
    """
    poses, film = opened.poses(), _Film(opened, recordings)
    with_latent = set(opened.latent_keyframes())
    pairs = [(query, match) for query, match in opened.used_closures() if {query, match} <= with_latent]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), CLOSURES_MAX)).astype(int))
    found: list[tuple[Float, Colours]] = []
    for done, (query, match) in enumerate(pairs[k] for k in chosen.tolist()):
        progress(done, len(chosen))
        latents = opened.latent(query), opened.latent(match)
        if latents[0] is None or latents[1] is None:
            continue
        matches = perception.matches(latents[0], latents[1])
        if matches is None:
            return None
        at_m, seen = triangulated(matches, poses[query.log][query.index], poses[match.log][match.index])
        if len(at_m):
            own = np.tile(np.array(colour_of[query.log], dtype=np.uint8), (len(at_m), 1))
            found.append((at_m, film.colours(query, matches.query[seen], own)))
    if not found:
        return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 0)
    at_m, colours = (np.concatenate(each) for each in zip(*found, strict=True))
    return Points(np.asarray(at_m), np.asarray(colours), len(found))


def triangulated(matches: SeenMatches, T_map_query: Float, T_map_match: Float) -> tuple[Float, NDArray[np.intp]]:
    """Points (K, 3) in the map halfway between two rays, and which matches they are."""
    agree = np.flatnonzero(matches.agree)
    ends = ((matches.query[agree], T_map_query), (matches.match[agree], T_map_match))
    (from_query, from_match), base = (_rays(seen, T) for seen, T in ends), T_map_match[:3, 3] - T_map_query[:3, 3]
    cosine = np.einsum("ni,ni->n", from_query, from_match)
    apart = np.maximum(1.0 - cosine**2, 1e-12)
    along_query, along_match = from_query @ base, from_match @ base
    depth_query = (along_query - cosine * along_match) / apart
    depth_match = (cosine * along_query - along_match) / apart
    ahead = (depth_query > 0.0) & (depth_match > 0.0) & (apart > np.sin(PARALLAX_MIN_RAD) ** 2) & (cosine > 0.0)
    near_query = T_map_query[:3, 3] + depth_query[:, None] * from_query
    near_match = T_map_match[:3, 3] + depth_match[:, None] * from_match
    half_m = np.linalg.norm(near_query - near_match, axis=1) / 2.0
    ahead &= half_m <= np.tan(OFF_MAX_RAD) * np.minimum(depth_query, depth_match)
    return np.asarray((near_query + near_match)[ahead] / 2.0), np.asarray(agree[ahead], dtype=np.intp)


def _rays(seen: Float, T_map_camera: Float) -> Float:
    """Directions (K, 3) in the map, of unit length, of points (K, 2) as x/z and y/z."""
    rays = np.column_stack([seen, np.ones(len(seen))]) @ T_map_camera[:3, :3].T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


class _Film:
    """The pictures of a map's keyframes, where recordings are at hand."""

    def __init__(self, opened: MapFolder, recordings: Mapping[LogId, Path]) -> None:
        self._opened = opened
        self._recordings = {log: Recording.open(path) for log, path in recordings.items()}
        self._stamps_s: dict[LogId, list[float]] = {}

    def colours(self, keyframe: KeyframeId, seen: Float, own: Colours) -> Colours:
        """Of points (K, 2) as x/z and y/z, in a keyframe's picture; their own (K, 3) where there is none."""
        recording = self._recordings.get(keyframe.log)
        if recording is None or (frame := self._frame(recording, keyframe)) is None:
            return own
        image = recording.load_image(frame)
        rays = np.column_stack([seen, np.ones(len(seen))])
        K, distortion = image.camera.K(), np.array(image.camera.distortion)
        at = np.rint(cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)).astype(int)
        inside = ((at >= 0) & (at < [image.camera.width, image.camera.height])).all(axis=1)
        pixels = image.pixels if image.pixels.ndim == 3 else np.repeat(image.pixels[..., None], 3, axis=2)
        found = own.copy()
        found[inside] = pixels[at[inside, 1], at[inside, 0]]
        return found

    def _frame(self, recording: Recording, keyframe: KeyframeId) -> Frame | None:
        if keyframe.log not in self._stamps_s:
            self._stamps_s[keyframe.log] = stamps_s(self._opened, keyframe.log)
        number = frame_at(recording, self._stamps_s[keyframe.log][keyframe.index])
        return None if number is None else recording.frames[number]


def recordings_of(opened: MapFolder, folders: Iterable[Path]) -> dict[LogId, Path]:
    """Recordings of a map's logs, by the names of their robots: those folders, or folders in them.

    Raises:
        RecordingError: One is damaged.
    """
    found = {}
    for folder in folders:
        for log in opened.poses():
            path = folder if folder.name == log.robot else folder / log.robot
            if path.is_dir():
                found[log] = path
    return found
