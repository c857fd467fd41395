"""Playing a recording into an agent by its stamps, as if the robot were moving now."""

import asyncio
import logging
from collections.abc import Awaitable, Callable

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import SourceConfig
from flocc_agent.core.interfaces import Image
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.measurement_file import Stamped
from flocc_agent.runtime.recording import Recording, RecordingError

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]
AddKeyframe = Callable[[Image, Float, float], Awaitable[None]]
AddMeasurement = Callable[[Stamped, float], None]

READY_S = 1.0
"""Frames due before this are played at once: an agent needs a moment to start."""


def due_s(stamp_s: float, first_stamp_s: float, config: SourceConfig) -> float:
    """When a frame is played, seconds since the start of the run."""
    return config.start_s + (stamp_s - first_stamp_s) / config.rate


async def play(
    recording: Recording,
    config: SourceConfig,
    selector: KeyframeSelector,
    add_keyframe: AddKeyframe,
    add_measurement: AddMeasurement,
    clock_s: Callable[[], float],
    on_position: Callable[[Float], None],
    last_stamp_s: float | None = None,
) -> None:
    """Play frames when they are due; late ones are played at once, none is skipped but what cannot be read.

    Args:
        recording: What to play.
        config: Speed and start.
        selector: Decides which frames become keyframes.
        add_keyframe: Takes (image, T_odom_body, stamp_s); may wait.
        add_measurement: Takes what was measured at the keyframe with this stamp.
        clock_s: Seconds since the start of the run.
        on_position: Takes the true position (3,) of each frame, where it is known, for emulated range.
        last_stamp_s: Of the last keyframe that the robot's log has: the agent was restarted, and goes on after it.
            Frames that were due before now are skipped then, unless the run's clock began anew as well.
    """
    first_s = recording.frames[0].stamp_s
    started_s, waits_s = clock_s(), 0.0
    frames = recording.frames
    if last_stamp_s is not None:
        frames = tuple(frame for frame in frames if frame.stamp_s > last_stamp_s)
        if not frames:
            logger.warning("%s: was played to its end before, and is not played again", recording.path)
        elif due_s(last_stamp_s, first_s, config) > started_s:
            waits_s = due_s(frames[0].stamp_s, first_s, config) - started_s
            logger.info("%s: goes on at %.3f s, after the last keyframe of the log", recording.path, frames[0].stamp_s)
    for frame in frames:
        wanted_s = due_s(frame.stamp_s, first_s, config) - waits_s
        if last_stamp_s is not None and wanted_s < started_s - READY_S:
            continue
        await asyncio.sleep(max(wanted_s - clock_s(), 0.0))
        truth = recording.ground_truth(frame.stamp_s)
        if truth is not None:
            on_position(truth[:3, 3])
        if selector.wants(frame.T_odom_body) or recording.measurements.keeps(frame.stamp_s):
            try:
                image = await asyncio.to_thread(recording.load_image, frame)
            except RecordingError as error:
                logger.warning("%s; left out", error)
                continue
            selector.took(frame.T_odom_body)
            await add_keyframe(image, frame.T_odom_body, frame.stamp_s)
            for measured in recording.measurements.at(frame.stamp_s):
                add_measurement(measured, frame.stamp_s)
