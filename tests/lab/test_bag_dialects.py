"""Drawn bags become what was drawn: where each robot was at each picture, and where its camera sits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flocc_lab.dialects.bags import CLOCKS, KINDS, POSES, Draw, drawn, judged

PLAIN = Draw("mcap", 2, "Odometry", True, False, "one", 1)


@pytest.mark.parametrize("seed", range(8))
def test_a_drawn_bag_becomes_what_was_drawn(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    draw = drawn(rng)
    assert judged(draw, rng, tmp_path) is None, draw


@pytest.mark.parametrize(
    "draw",
    [
        *(replace(PLAIN, kind=kind) for kind in KINDS),
        *(replace(PLAIN, poses=poses, mounted=poses == "tf") for poses in POSES),
        *(replace(PLAIN, clock=clock) for clock in CLOCKS),
    ],
    ids=str,
)
def test_every_value_that_can_be_drawn_is_right(draw: Draw, tmp_path: Path) -> None:
    assert judged(draw, np.random.default_rng(0), tmp_path) is None
