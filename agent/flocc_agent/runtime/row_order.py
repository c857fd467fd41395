"""Poses of a file in the order of time: rows that go back, repeat, or lie where nobody can be, cost themselves.

Too many of them refuse the file, with what it seems to be: several trajectories one behind the other, stamps that lost
their digits, another unit of length.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.runtime.pose_limits import SPEED_MAX_M_S, breaks, possible, reset_poses, spikes
from flocc_agent.runtime.text_tables import RecordingError
from flocc_agent.runtime.trajectory import Trajectory

Float = NDArray[np.float64]

DAMAGED_RATIO_MAX = 0.2
JUMPS = "jump away from those on both sides"
TOO_FAST = f"lie out of reach of the others (faster than {SPEED_MAX_M_S:g} m/s)"
TOO_FAST_ASKED = ": is the length in metres, and the stamp in its unit?"
LOST = "are exactly at the origin and not turned amid others that are not, as programs write where they are lost"
LOST_ASKED = ": take those rows out"
STRAY_STEPS_MIN = 20.0
JOINED_MAX, JOINED_ROWS_MIN = 8, 3
"""Trajectories one behind the other in a file, and the rows that each has; more, or shorter ones, are disorder."""


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """What a file of poses holds.

    Attributes:
        stamps_s: (N,) seconds, or None where the form has no stamps; not sorted.
        T_fixed_body: (N, 4, 4), metres.
        lines: (N,) line of each.
        notes: What was left out or concluded, one sentence each.
    """

    stamps_s: Float | None
    T_fixed_body: Float
    lines: NDArray[np.int64]
    notes: tuple[str, ...] = ()


def _strays(stamps_s: Float) -> NDArray[np.bool_]:
    """Rows whose stamp is far ahead, while the row behind goes on where the row before was."""
    found = np.zeros(len(stamps_s), dtype=bool)
    if len(stamps_s) < 4:
        return found
    before, here, after = stamps_s[:-2], stamps_s[1:-1], stamps_s[2:]
    step_s = float(np.median(np.abs(np.diff(stamps_s))))
    found[1:-1] = (here - before > STRAY_STEPS_MIN * step_s) & (after < here) & (after > before)
    return found


def in_order(poses: Poses, path: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """A trajectory of poses; those that go back in time are left out and counted."""
    stamps_s, T, lines, notes = poses.stamps_s, poses.T_fixed_body, poses.lines, list(poses.notes)
    assert stamps_s is not None
    if len(stamps_s) > 2 and np.all(np.diff(stamps_s) <= 0) and stamps_s[0] > stamps_s[-1]:
        stamps_s, T, lines = stamps_s[::-1], T[::-1], lines[::-1]
        notes.append(f"{path}: rows stand in reversed order of time, and were turned round")
    stray = _strays(stamps_s)
    if np.any(stray):
        first = int(np.argmax(stray))
        note = f"{np.count_nonzero(stray)} rows with a stamp far ahead of those around them were left out"
        notes.append(f"{path}:{lines[first]}: {note}")
        stamps_s, T, lines = stamps_s[~stray], T[~stray], lines[~stray]
    highest_s = np.maximum.accumulate(stamps_s)
    later = np.concatenate([[True], stamps_s[1:] > highest_s[:-1]])
    back = np.concatenate([[False], stamps_s[1:] < highest_s[:-1]])
    if np.any(back):
        first = int(np.argmax(back))
        where = f"time goes backwards, from {highest_s[first - 1]:.6f} s to {stamps_s[first]:.6f} s"
        count = int(np.count_nonzero(back))
        if count > DAMAGED_RATIO_MAX * len(stamps_s):
            raise RecordingError(
                f"{path}:{lines[first]}: {where}; {count} rows of {len(stamps_s)} lie before{_joined(stamps_s, lines)}"
            )
        notes.append(f"{path}:{lines[first]}: {where}; {count} rows were left out")
    moved = later & ~back
    differ = ~moved & ~back
    if np.any(differ):
        index = np.nonzero(differ)[0]
        unlike = sum(not np.allclose(T[k], T[k - 1], atol=1e-6) for k in index[:10000])
        if unlike > DAMAGED_RATIO_MAX * len(stamps_s):
            raise RecordingError(
                f"{path}:{lines[index[0]]}: {unlike} of {len(stamps_s)} rows have the stamp of the row before, "
                f"{stamps_s[index[0]]:.6f} s, and another pose; write stamps with all their digits"
            )
        if unlike:
            notes.append(f"{path}: {unlike} rows repeat a stamp with another pose; the first of each was taken")
    stamps_s, T, lines = stamps_s[moved], T[moved], lines[moved]
    good = possible(stamps_s, T[:, :3, 3])
    if not np.all(good):
        notes.append(_left_out(path, lines[~good], len(lines), TOO_FAST, TOO_FAST_ASKED))
    stamps_s, T, lines = stamps_s[good], T[good], lines[good]
    lost = reset_poses(T)
    if np.any(lost):
        notes.append(_left_out(path, lines[lost], len(lines), LOST, LOST_ASKED))
    stamps_s, T, lines = stamps_s[~lost], T[~lost], lines[~lost]
    odd = spikes(T[:, :3, 3])
    if np.any(odd):
        notes.append(_left_out(path, lines[odd], len(lines), JUMPS))
    stamps_s, T, lines = stamps_s[~odd], T[~odd], lines[~odd]
    anew = breaks(stamps_s, T)
    if np.any(anew):
        more = f" (and at {np.count_nonzero(anew) - 1} other rows)" if np.count_nonzero(anew) > 1 else ""
        notes.append(
            f"{path}:{lines[np.argmax(anew)]}: the pose jumps and goes on from there{more}; where this is "
            "odometry, it began anew there, and loop closures decide where the robot was"
        )
    return Trajectory(stamps_s, T), tuple(notes)


def _joined(stamps_s: Float, lines: NDArray[np.int64]) -> str:
    """Say which trajectories stand one behind the other, where the rows are a few that each go forwards."""
    starts = [0, *(np.flatnonzero(np.diff(stamps_s) < 0) + 1)]
    ends = [*starts[1:], len(stamps_s)]
    if len(starts) > JOINED_MAX or min(b - a for a, b in zip(starts, ends, strict=True)) < JOINED_ROWS_MIN:
        return ""
    parts = ", ".join(f"{lines[a]} to {lines[b - 1]}" for a, b in zip(starts, ends, strict=True))
    return (
        f": the file holds {len(starts)} trajectories one behind the other (lines {parts}), or its clock was set back; "
        "cut it, and convert the parts apart"
    )


def _left_out(path: Path, lines: NDArray[np.int64], count: int, what: str, asked: str = "") -> str:
    """Say how many poses are no use, and what is wrong with them.

    Raises:
        RecordingError: They are too many; what is asked then stands behind.
    """
    fault = f"{path}:{lines[0]}: {len(lines)} of {count} poses {what}"
    if len(lines) > DAMAGED_RATIO_MAX * count:
        raise RecordingError(fault + asked)
    return f"{fault} and were left out"
