"""Cutting one data set into parts by time."""

from dataclasses import replace

import numpy as np

from flocc_agent.runtime.trajectory import Trajectory
from flocc_launch.datasets.source import DatasetError, Source


def cut(source: Source, index: int, parts: int, overlap_s: float = 0.0) -> Source:
    """One of several equal parts of a data set by time, with its stamps counted from 0 s."""
    start_s, end_s = source.images[0][0], source.images[-1][0]
    share_s = (end_s - start_s) / parts
    from_s = start_s + index * share_s
    last = index == parts - 1
    to_s = end_s + 1e-6 if last else from_s + share_s + overlap_s
    images = tuple((stamp_s - from_s, file) for stamp_s, file in source.images if from_s <= stamp_s < to_s)
    if not images:
        raise DatasetError(f"{source.path}: no image lies in part {index + 1} of {parts}")
    odometry, truth = _window(source.odometry, from_s, to_s), _window(source.truth, from_s, to_s)
    return replace(source, images=images, odometry=odometry, truth=truth)


def _window(trajectory: Trajectory | None, from_s: float, to_s: float) -> Trajectory | None:
    """The part of a trajectory from one pose before to one pose after an interval, counted from its start."""
    if trajectory is None:
        return None
    first = max(int(np.searchsorted(trajectory.stamps_s, from_s, side="right")) - 1, 0)
    last = int(np.searchsorted(trajectory.stamps_s, to_s, side="left")) + 1
    stamps_s = trajectory.stamps_s[first:last] - from_s
    return Trajectory(stamps_s, trajectory.T_fixed_body[first:last]) if len(stamps_s) else None
