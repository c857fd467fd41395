"""Ground truth of a run: where it is found, and what is wrong with it.

A file that a person put into the run's `groundtruth/` counts before the recording's and is never written over; one that
flocc made there says so in its first line.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from flocc_agent.runtime.trajectory import HEADER, Trajectory, tum_line
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.runs.plain_numbers import number
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.tracks import RobotTrack
from flocc_launch.runs.trajectory_errors import ate_m

MADE = "# made by flocc of the recording's truth; a file without this line is never written over\n"
SAME_START_M = 1e-6
APART_RATIO = 5.0
"""Truths may not share a frame where the error of all together is so many times that of the worst robot alone."""
APART_MIN_M = 0.1


def ground_truth(folder: RunFolder, robot: str) -> Trajectory | None:
    """True body poses of a robot: as a person put them into the run, from its recording, or as its driver left them."""
    place = truth_path(folder, robot)
    recording = folder.recording(robot)
    places = [place]
    if recording is not None:
        places.insert(1 if is_given(place) else 0, recording / "groundtruth.tum")
    found: Path | None = next((each for each in places if each.is_file()), None)
    return None if found is None else read_tum(found)


def truth_path(folder: RunFolder, robot: str) -> Path:
    """Where a run keeps a robot's ground truth."""
    return folder.path / "groundtruth" / f"{robot}.tum"


def is_given(path: Path) -> bool:
    """Whether a file of ground truth stands there that flocc did not make."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MADE)) != MADE.encode()


def write_truth(path: Path, truth: Trajectory) -> None:
    """Write ground truth into a run, unless a person put some there, or a link."""
    if len(truth) and not is_given(path) and not path.is_symlink() and not path.parent.is_symlink():
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = [tum_line(s, T) for s, T in zip(truth.stamps_s, truth.T_fixed_body, strict=True)]
        path.write_text(MADE + HEADER + "".join(line + "\n" for line in lines), encoding="utf-8")


def other_clocks(tracks: Mapping[str, RobotTrack]) -> list[str]:
    """Robots whose truth has no pose at any keyframe's time, each with how far its clock is off."""
    found = []
    for robot, track in sorted(tracks.items()):
        if track.truth is None or not len(track.truth) or not len(track) or track.true.any():
            continue
        first_s, last_s = track.truth.stamps_s[[0, -1]]
        offset_s = first_s - track.stamps_s[0]
        found.append(
            f"The ground truth of {robot} has no pose at its keyframes: it is from {first_s:.3f} s to {last_s:.3f} s, "
            f"they are from {track.stamps_s[0]:.3f} s to {track.stamps_s[-1]:.3f} s, so its clock is off by about "
            f"{offset_s:+.3f} s if both begin together."
        )
    return found


def in_separate_frames(tracks: Mapping[str, RobotTrack]) -> tuple[str, ...]:
    """Robots whose truths cannot be in one frame: all begin in the very same place, and they do not fit together."""
    doubtful = do_not_fit_together(tracks)
    starts = {robot: _start(tracks[robot]) for robot in doubtful}
    same = [
        pair for pair in combinations(doubtful, 2) if np.linalg.norm(starts[pair[0]] - starts[pair[1]]) < SAME_START_M
    ]
    return tuple(sorted({robot for pair in same for robot in pair}))


def do_not_fit_together(tracks: Mapping[str, RobotTrack]) -> tuple[str, ...]:
    """Robots of one map that fit their truths one by one, but not together."""
    for frame in sorted({track.map_frame for track in tracks.values() if track.map_frame is not None}):
        here = {robot: t for robot, t in sorted(tracks.items()) if t.map_frame == frame}
        pairs = {robot: track.corrected_and_true() for robot, track in here.items()}
        pairs = {robot: pair for robot, pair in pairs.items() if len(pair[1])}
        alone_m = [ate_m([estimate], [truth]) or 0.0 for estimate, truth in pairs.values()]
        together_m = ate_m([pair[0] for pair in pairs.values()], [pair[1] for pair in pairs.values()])
        if len(pairs) > 1 and together_m is not None and together_m > APART_RATIO * max(alone_m) + APART_MIN_M:
            return tuple(pairs)
    return ()


def frame_sentences(tracks: Mapping[str, RobotTrack]) -> list[str]:
    """What is to be said of truths that do not fit together."""
    doubtful = do_not_fit_together(tracks)
    if not doubtful:
        return []
    if apart := in_separate_frames(tracks):
        return [
            f"The ground truths of {', '.join(apart)} are in separate frames (each begins in the same place), so "
            "there is no joint error; put them into one frame."
        ]
    alone = _alone(tracks, doubtful)
    return [
        f"{', '.join(doubtful)} fit their ground truth one by one ({alone}), "
        "but not together: either their ground truths are in separate frames, or the map joins them wrongly."
    ]


def _alone(tracks: Mapping[str, RobotTrack], robots: Sequence[str]) -> str:
    errors_m = [ate_m([pair[0]], [pair[1]]) for pair in (tracks[robot].corrected_and_true() for robot in robots)]
    return ", ".join(number(error_m, "m") for error_m in errors_m)


def _start(track: RobotTrack) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Position (3,) at which a truth begins."""
    assert track.truth is not None
    return np.asarray(track.truth.T_fixed_body[0, :3, 3])
