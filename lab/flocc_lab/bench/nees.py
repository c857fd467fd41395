"""`python -m flocc_lab.bench.nees FILE...`: whether reported uncertainties of corrected poses are true.

The normalised squared error (NEES) of poses against the truth, both relative to the anchor's first keyframe: 6 in the
mean where covariances are right, of which 3 are the rotation's and 3 the translation's. With `--draws N`, graphs of the
family instead of files. One number per graph says little: all poses share the error of the anchor's first keyframes.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from flocc_agent.backend.optimiser import optimise
from flocc_agent.core.pose_graph import Component, GraphSolution, PoseGraph
from flocc_agent.geometry import inverse, se3_log, so3_log, umeyama
from flocc_lab.graph_family.family_spec import drawn
from flocc_lab.graph_family.graphs import made
from flocc_launch.graph_files import read_graph_file
from flocc_launch.graph_files.optimise import file_config
from flocc_protocol.ids import KeyframeId, LogId

Float = NDArray[np.float64]

ASKED_KEYFRAMES = 15
"""Of each robot so many keyframes, evenly chosen."""
INSIDE = 0.95
HEAD = (
    "| graph | NEES | rotation | translation | within 95 % | turn of the anchor's first keyframe, degrees |\n"
    + "|---" * 6
    + "|"
)


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """How errors of one graph compare with their reported covariances, in the mean over keyframes.

    Attributes:
        whole: NEES of poses.
        rotation: Of rotations alone.
        translation: Of translations alone.
        inside: Part of the poses whose truth lies within their 95 %.
        first_turn_rad: How far the anchor's first keyframe is turned, when all positions are aligned.
    """

    whole: float
    rotation: float
    translation: float
    inside: float
    first_turn_rad: float


def asked(graph: PoseGraph) -> list[KeyframeId]:
    """Keyframes whose covariances are compared."""
    return [
        KeyframeId(log, int(k))
        for log, trajectory in sorted(graph.trajectories.items())
        for k in np.unique(np.linspace(0, len(trajectory) - 1, ASKED_KEYFRAMES).astype(int))
    ]


def uncertainty(component: Component, T_truth: Mapping[LogId, Float]) -> Uncertainty | None:
    """Compare a component with the truth; None where it has no covariances of keyframes that moved."""
    anchor = component.anchor
    T_truth_map = T_truth[anchor][0] @ inverse(component.T_map_keyframe[anchor][0])
    rows = []
    for keyframe, S in component.covariance_keyframe.items():
        T = T_truth_map @ component.T_map_keyframe[keyframe.log][keyframe.index]
        error = se3_log(inverse(T) @ T_truth[keyframe.log][keyframe.index])
        if np.any(S):
            parts = (slice(0, 6), slice(0, 3), slice(3, 6))
            rows.append([float(error[p] @ np.linalg.solve(S[p, p], error[p])) for p in parts])
    if not rows:
        return None
    squared = np.array(rows)
    inside = float(np.mean(squared[:, 0] <= chdtri(6.0, 1.0 - INSIDE)))
    whole, rotation, translation = squared.mean(axis=0).tolist()
    return Uncertainty(whole, rotation, translation, inside, first_turn_rad(component, T_truth))


def first_turn_rad(component: Component, T_truth: Mapping[LogId, Float]) -> float:
    """The angle by which the anchor's first keyframe is turned, when all positions are aligned."""
    source = np.concatenate([component.T_map_keyframe[log][:, :3, 3] for log in component.logs])
    target = np.concatenate([T_truth[log][:, :3, 3] for log in component.logs])
    R_align = umeyama(source, target)[1][:3, :3]
    R = R_align @ component.T_map_keyframe[component.anchor][0][:3, :3]
    return float(np.linalg.norm(so3_log(R.T @ T_truth[component.anchor][0][:3, :3])))


def graphs(options: argparse.Namespace) -> Iterator[tuple[str, PoseGraph, Mapping[LogId, Float]]]:
    """Names, graphs and true poses: of files with unit scale and as they are, or of the family."""
    for path in options.files:
        metric = read_graph_file(Path(path))
        for name, file in (("unit scale", metric.with_unit_scale()), ("metric", metric)):
            yield f"{Path(path).stem}, {name}", file.graph, file.T_truth
    for seed in range(options.first, options.first + options.draws):
        if sum(drawn(seed).keyframes) <= options.keyframes_max:
            member = made(drawn(seed))
            yield f"seed {seed}", member.graph, member.T_world_keyframe


def main(words: list[str]) -> None:
    """Print a row per component of every graph, and the mean of all."""
    parser = argparse.ArgumentParser(prog="python -m flocc_lab.bench.nees", description=__doc__)
    parser.add_argument("files", nargs="*", help="pose graphs with true poses")
    parser.add_argument("--draws", type=int, default=0, help="number of graphs of the family")
    parser.add_argument("--first", type=int, default=1, help="seed of the first one")
    parser.add_argument("--keyframes-max", type=int, default=1000, help="leave out graphs with more keyframes")
    options, found = parser.parse_args(words), []
    sys.stdout.write(HEAD + "\n")
    for name, graph, T_truth in graphs(options):
        solution = optimise(graph, file_config(None, None, None), None, asked(graph))
        components = solution.components if isinstance(solution, GraphSolution) else ()
        told = [u for c in components if len(c.logs) > 1 and (u := uncertainty(c, T_truth)) is not None]
        found += told
        sys.stdout.writelines(row(name, u) for u in told)
        sys.stdout.flush()
    if found:
        wholes = np.array([u.whole for u in found])
        inside = np.mean([u.inside for u in found])
        sys.stdout.write(f"\nMedian NEES {np.median(wholes):.1f}, within 95 %: {inside:.2f} in the mean.\n")


def row(name: str, u: Uncertainty) -> str:
    """One line of the table."""
    return (
        f"| {name} | {u.whole:.1f} | {u.rotation:.1f} | {u.translation:.1f} | {u.inside:.2f} "
        f"| {np.degrees(u.first_turn_rad):.1f} |\n"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
