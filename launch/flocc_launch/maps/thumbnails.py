"""Small pictures of a map's places, where the recordings that it was made of are there."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flocc_agent.runtime.recording import Recording
from flocc_launch.maps.gathering import Logs, opened_record
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import KeyframeRecord

THUMBNAILS_MAX = 48
WIDTH_PX = 160
STAMP_TOLERANCE_S = 1e-4


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """One keyframe's picture."""

    keyframe: KeyframeId
    jpeg: bytes


def thumbnails(recordings: Mapping[LogId, Path], logs: Logs) -> list[Thumbnail]:
    """Evenly spread keyframes of each log as small pictures; none where recordings are gone."""
    found: list[Thumbnail] = []
    for log, path in sorted(recordings.items()):
        try:
            found += _of_log(log, Recording.open(path), logs.get(log, ()), THUMBNAILS_MAX // max(len(recordings), 1))
        except FloccError:
            continue
    return found


def _of_log(log: LogId, recording: Recording, records: tuple[bytes, ...], count_max: int) -> list[Thumbnail]:
    taken = [r for data in records if isinstance(r := opened_record(data)[0], KeyframeRecord)]
    found = []
    for k in np.unique(np.linspace(0, len(taken) - 1, min(count_max, len(taken))).astype(int)):
        frame = frame_at(recording, taken[k].stamp_s)
        if frame is not None:
            found += [Thumbnail(KeyframeId(log, taken[k].index), _small(recording, frame))]
    return found


def frame_at(recording: Recording, stamp_s: float) -> int | None:
    """Number of the picture that was taken at a stamp, of the recording or since its beginning; None without one."""
    stamps_s = np.array([frame.stamp_s for frame in recording.frames])
    apart_s = np.minimum(np.abs(stamps_s - stamp_s), np.abs(stamps_s - stamps_s[0] - stamp_s))
    nearest = int(np.argmin(apart_s))
    return nearest if apart_s[nearest] <= STAMP_TOLERANCE_S else None


def _small(recording: Recording, frame: int) -> bytes:
    import cv2

    pixels = recording.load_image(recording.frames[frame]).pixels
    height = max(1, round(pixels.shape[0] * WIDTH_PX / pixels.shape[1]))
    small = cv2.resize(pixels, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
    return jpeg.tobytes()
