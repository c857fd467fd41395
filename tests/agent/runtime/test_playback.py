"""Playing a recording: an agent that was killed goes on after the last keyframe of its log."""

import asyncio
import logging
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flocc_agent.config import KeyframeConfig, SourceConfig
from flocc_agent.core.interfaces import Camera, Image
from flocc_agent.geometry import pose
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.playback import play
from flocc_agent.runtime.recording import Frame, Recording

Float = NDArray[np.float64]
CAMERA = Camera(8, 8, 8.0, 8.0, 4.0, 4.0)
FIRST_S = 1000.0


def played(monkeypatch: pytest.MonkeyPatch, last_stamp_s: float | None, now_s: float) -> tuple[list[float], object]:
    """Stamps of what is played of ten frames, a second and two metres apart, and how long that takes."""
    frames = tuple(
        Frame(FIRST_S + k, Path(f"{k}.png"), pose(np.eye(3), np.array([2.0 * k, 0.0, 0.0]))) for k in range(10)
    )
    recording = Recording(Path("alfa"), CAMERA, np.eye(4), frames, None)
    monkeypatch.setattr(Recording, "load_image", lambda self, frame: Image(np.zeros((8, 8, 3), np.uint8), CAMERA))
    clock_s, stamps_s = [now_s], []

    async def sleep(for_s: float) -> None:
        clock_s[0] += for_s

    async def add(image: Image, T_odom_body: Float, stamp_s: float) -> None:
        stamps_s.append(stamp_s - FIRST_S)

    async def run() -> None:
        monkeypatch.setattr("flocc_agent.runtime.playback.asyncio.sleep", sleep)
        selector = KeyframeSelector(KeyframeConfig())
        await play(
            recording,
            SourceConfig(),
            selector,
            add,
            lambda measured, stamp_s: None,
            lambda: clock_s[0],
            lambda at_m: None,
            last_stamp_s,
        )

    asyncio.run(run())
    return stamps_s, round(clock_s[0] - now_s, 6)


def test_a_first_start_plays_all(monkeypatch: pytest.MonkeyPatch) -> None:
    assert played(monkeypatch, None, 0.0) == (list(range(10)), 9.0)


def test_an_agent_whose_clock_began_anew_goes_on_at_once_after_its_last_keyframe(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        assert played(monkeypatch, FIRST_S + 4.0, 0.5) == ([5, 6, 7, 8, 9], 4.0)
    assert "alfa: goes on at 1005.000 s" in caplog.text


def test_under_a_launcher_whose_clock_goes_on_the_time_off_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    assert played(monkeypatch, FIRST_S + 2.0, 6.0) == ([5, 6, 7, 8, 9], 3.0)


def test_a_recording_that_was_played_to_its_end_is_not_played_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert played(monkeypatch, FIRST_S + 9.0, 0.0) == ([], 0.0)
    assert "alfa: was played to its end before" in caplog.text
