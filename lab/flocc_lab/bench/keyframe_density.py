"""`python -m flocc_lab.bench.keyframe_density ../shared/data`: whether verdicts depend on how dense keyframes are.

The denominator of Eq. (1) is what the query shares with its odometry neighbour, and that is more where the neighbour
is nearer. Here the same pairs are registered twice: with the next keyframe as neighbour, and with the one after it.
"""

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from flocc_agent.perception.backends import build_perception
from flocc_agent.perception.classical.sift_registrar import ACCEPTANCE
from flocc_agent.perception.multiview.acceptance import Acceptance
from flocc_agent.perception.multiview.registrar import PairRegistrar
from flocc_lab.bench.acceptance_fit import kept
from flocc_lab.bench.acceptance_rows import (
    AcceptanceRow,
    JudgedScene,
    cached_latents,
    chosen_pairs,
    judged_scenes,
    perception_of,
    row,
)

SCENE = "street"


def every_second(judged: JudgedScene) -> tuple[JudgedScene, list[int]]:
    """The scene with half of each robot's views, and where these are among all."""
    numbered = list(enumerate(judged.scene.views))
    kept_numbers = [k for _, robot in groupby(numbered, key=lambda one: one[1].robot) for k, _ in list(robot)[::2]]
    views = tuple(judged.scene.views[k] for k in kept_numbers)
    return replace(judged, scene=replace(judged.scene, name=f"{judged.scene.name}-half", views=views)), kept_numbers


def rows_by_density(judged: JudgedScene, pairs_max: int, cache: Path) -> dict[str, list[AcceptanceRow]]:
    """The same pairs with near and with far odometry neighbours."""
    skills = build_perception(perception_of("classical"))
    registrar = skills.registrar
    assert isinstance(registrar, PairRegistrar)
    half, numbers = every_second(judged)
    pairs = chosen_pairs(half, pairs_max, cache)
    latents = cached_latents(judged.scene, range(len(judged.scene.views)), skills, cache)
    of_half = [latents[k] for k in numbers]
    return {
        "every second keyframe": [row(half, i, j, c, registrar, of_half) for i, j, c in pairs],
        "every keyframe": [row(judged, numbers[i], numbers[j], c, registrar, latents) for i, j, c in pairs],
    }


def line(name: str, rows: Sequence[AcceptanceRow], rule: Acceptance) -> str:
    """One row of the table."""
    by_ratio, by_rule = kept(rows, None), kept(rows, rule)
    matches = np.median([one.odometry_correspondences for one in rows])
    ratio = np.median([one.evidence.match_ratio for one in rows if one.evidence is not None and one.is_right])
    return (
        f"| {name} | {matches:.0f} | {ratio:.2f} | {by_ratio.right} + {by_ratio.wrong} "
        f"| {by_rule.right} + {by_rule.wrong} of {by_rule.possible} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--pairs", type=int, default=150)
    parser.add_argument("--cache", type=Path, default=Path("runs") / "keyframe-density")
    given = parser.parse_args(arguments)
    judged = next(each for each in judged_scenes(given.shared) if each.scene.name == SCENE)
    sys.stdout.write("| odometry neighbour | its matches | Eq. (1) of right pairs | at least 0.3 | the rule |\n")
    sys.stdout.write("| --- | --- | --- | --- | --- |\n")
    for name, rows in rows_by_density(judged, given.pairs, given.cache).items():
        sys.stdout.write(f"{line(name, rows, ACCEPTANCE)}\n")


if __name__ == "__main__":
    main()
