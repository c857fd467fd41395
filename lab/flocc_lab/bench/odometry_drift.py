"""How real odometry drifts, in the terms of `DriftSpec`: what `datasets/drift.py` gives each kind is held against it.

Odometry and truth are cut into pieces of one length; each gives an error of its turn about the vertical and of its
displacement. What all pieces of a recording share is its constant (scale, heading per metre), the rest its random walk.

    python -m flocc_lab.bench.odometry_drift drone odometry1.txt truth1.txt odometry2.txt truth2.txt
    python -m flocc_lab.bench.odometry_drift car kitti_00.g2o kitti_poses/00.txt
    python -m flocc_lab.bench.odometry_drift wheeled MITb.g2o optimised.g2o
    python -m flocc_lab.bench.odometry_drift handheld team.jrl

A `.jrl` holds odometry and truth of several robots, each a recording. Where a planar graph has no truth, its
optimum stands for it (`flocc optimise MITb.g2o --out DIR`).
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.geometry import between, inverse, pose, pose_from_tq, so3_exp, so3_log
from flocc_agent.runtime.trajectory import Trajectory
from flocc_agent.runtime.trajectory_text import read_poses, read_trajectory
from flocc_launch.datasets.drift import DRIFTS
from flocc_launch.graph_files import read_graph_file

Float = NDArray[np.float64]

PIECES = 60
PIECE_MIN_M = 1.0
CAMERA_OF_PLANE = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""A plane's axes (forward, left, up) in a camera's (right, down, forward)."""


@dataclass(frozen=True, slots=True)
class DriftFound:
    """How the odometry of one recording drifted.

    Attributes:
        length_m: Of the path.
        scale_ratio: Constant error of the scale.
        translation_m_per_sqrt_m: Random walk of the position, each axis.
        heading_rate_rad_per_m: Constant error of the heading.
        heading_rad_per_sqrt_m: Random walk of the heading.
        tilt_ratio: Random walk of roll and pitch over that of the heading.
    """

    length_m: float
    scale_ratio: float
    translation_m_per_sqrt_m: float
    heading_rate_rad_per_m: float
    heading_rad_per_sqrt_m: float
    tilt_ratio: float


def found_drift(odometry: Float, truth: Float, up_truth: Float, planar: bool = False) -> DriftFound:
    """Fit the terms of a drift.

    Args:
        odometry: (N, 4, 4) `T_odom_body`.
        truth: (N, 4, 4) `T_world_body` at the same moments.
        up_truth: (3,) against gravity in the truth's world.
        planar: The odometry knows no heights nor tilts: these are not looked at.

    Raises:
        ValueError: The path is too short for `PIECES` pieces.
    """
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    if along_m[-1] < PIECES * PIECE_MIN_M / 4:
        raise ValueError(f"the path of {along_m[-1]:.1f} m is too short")
    short_m = max(PIECE_MIN_M, along_m[-1] / PIECES)
    pieces = [_pieces(odometry, truth, up_truth, along_m, length_m, planar) for length_m in (short_m, 4 * short_m)]
    length_m, turned, said_m, true_m, _ = pieces[0]
    scale = float(np.sum(said_m * true_m) / np.sum(true_m**2)) - 1.0
    rate = float(turned.sum() / length_m.sum())
    heading, tilt, off = [], [], []
    for length_m, turned, said_m, true_m, tilted in pieces:
        heading.append((turned - rate * length_m) ** 2)
        tilt.append(np.mean(tilted**2, axis=1))
        off.append(np.sum((said_m - (1.0 + scale) * true_m) ** 2, axis=1) / (2 if planar else 3))
    lengths_m = [piece[0] for piece in pieces]
    walk = _walk(lengths_m, heading)
    tilt_ratio = 0.0 if planar or walk == 0 else _walk(lengths_m, tilt) / walk
    return DriftFound(float(along_m[-1]), scale, _walk(lengths_m, off), rate, walk, tilt_ratio)


def _walk(lengths_m: list[Float], squares: list[Float]) -> float:
    """What grows with the root of the length, without what short and long pieces share (noise of their ends)."""
    short_m, long_m = (float(np.mean(each)) for each in lengths_m)
    short, long = (float(np.mean(each)) for each in squares)
    return float(np.sqrt(max(0.0, (long - short) / (long_m - short_m))))


def _pieces(
    odometry: Float, truth: Float, up_truth: Float, along_m: Float, piece_m: float, planar: bool
) -> tuple[Float, Float, Float, Float, Float]:
    """Of pieces of the path: length, error about the vertical, displacement as said and in truth, error across it."""
    cuts = np.unique(np.searchsorted(along_m, np.arange(0.0, along_m[-1], piece_m)))
    turned, said_m, true_m, tilted = [], [], [], []
    for a, b in pairwise(cuts):
        said, true = between(odometry[a], odometry[b]), between(truth[a], truth[b])
        up = truth[a, :3, :3].T @ up_truth
        error = so3_log(said[:3, :3] @ true[:3, :3].T)
        level = np.eye(3) - np.outer(up, up) if planar else np.eye(3)
        turned.append(error @ up)
        said_m.append(level @ said[:3, 3])
        true_m.append(level @ true[:3, 3])
        across = error - (error @ up) * up
        tilted.append([np.linalg.norm(across) / np.sqrt(2)])
    length_m = along_m[cuts[1:]] - along_m[cuts[:-1]]
    return length_m, np.array(turned), np.array(said_m), np.array(true_m), np.array(tilted)


def of_files(odometry: Path, truth: Path) -> DriftFound:
    """Fit a file of odometry against one of ground truth: trajectories, or KITTI's planar graph and its poses."""
    if odometry.suffix == ".g2o":
        of_plane = truth.suffix == ".g2o"
        world = _vertices(truth) if of_plane else read_poses(truth).T_fixed_body
        steps = [line.split()[3:6] for line in odometry.read_text().splitlines() if line.startswith("EDGE_SE2 ")]
        ends = [line.split()[1:3] for line in odometry.read_text().splitlines() if line.startswith("EDGE_SE2 ")]
        plane = pose(np.eye(3) if of_plane else CAMERA_OF_PLANE, np.zeros(3))
        poses = [np.eye(4)]
        for (x, y, angle), (a, b) in zip(steps, ends, strict=True):
            if int(b) == int(a) + 1:
                step = pose(so3_exp(np.array([0.0, 0.0, float(angle)])), np.array([float(x), float(y), 0.0]))
                poses.append(poses[-1] @ plane @ step @ inverse(plane))
        up = np.array([0.0, 0.0, 1.0]) if of_plane else np.array([0.0, -1.0, 0.0])
        return found_drift(np.array(poses), world[: len(poses)], up, True)
    said, _ = read_trajectory(odometry, "tum")
    true, _ = read_trajectory(truth)
    return found_drift(*_paired(said, true), np.array([0.0, 0.0, 1.0]))


def _vertices(graph: Path) -> Float:
    """(N, 4, 4) poses of a graph of vertices x y z qx qy qz qw, in the order of their numbers."""
    rows = [line.split() for line in graph.read_text().splitlines() if line.startswith("VERTEX_SE3:QUAT ")]
    ordered = sorted(([int(row[1]), *map(float, row[2:9])] for row in rows), key=lambda row: row[0])
    return np.array([pose_from_tq(np.array(row)[[1, 2, 3, 7, 4, 5, 6]]) for row in ordered])


def of_team(path: Path) -> list[DriftFound]:
    """Fit the odometry of every robot in a `.jrl` against its true poses; its world's z points up."""
    file = read_graph_file(path)
    up = np.array([0.0, 0.0, 1.0])
    robots = file.graph.trajectories
    return [found_drift(robots[log].T_odom_keyframe, T, up) for log, T in sorted(file.T_truth.items())]


def of_arguments(files: Sequence[Path]) -> list[DriftFound]:
    """Recordings of teams, and of odometry and truth in turn."""
    teams = [path for path in files if path.suffix == ".jrl"]
    pairs = [path for path in files if path.suffix != ".jrl"]
    found = [of_files(odometry, truth) for odometry, truth in zip(pairs[::2], pairs[1::2], strict=True)]
    return [*(each for path in teams for each in of_team(path)), *found]


def _paired(said: Trajectory, true: Trajectory) -> tuple[Float, Float]:
    """Poses of the odometry and those of the truth nearest in time."""
    inside = (said.stamps_s >= true.stamps_s[0]) & (said.stamps_s <= true.stamps_s[-1])
    after = np.clip(np.searchsorted(true.stamps_s, said.stamps_s[inside]), 1, len(true) - 1)
    nearer = true.stamps_s[after] - said.stamps_s[inside] > said.stamps_s[inside] - true.stamps_s[after - 1]
    return said.T_fixed_body[inside], true.T_fixed_body[after - nearer]


def main() -> None:
    """Print what was found in each recording, the sigma of all, and what the kind is given."""
    parser = argparse.ArgumentParser(description="How real odometry drifts, beside what is drawn for its kind.")
    parser.add_argument("kind", choices=list(DRIFTS))
    parser.add_argument("files", type=Path, nargs="+", help="odometry and truth, in turn, or a team's .jrl")
    given = parser.parse_args()
    found = of_arguments(given.files)
    terms = list(asdict(found[0]))[1:]
    sigma = {term: float(np.sqrt(np.mean([getattr(each, term) ** 2 for each in found]))) for term in terms}
    table = {
        "recordings": [asdict(each) for each in found],
        "sigma": sigma,
        given.kind: DRIFTS[given.kind].model_dump(),
    }
    sys.stdout.write(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
