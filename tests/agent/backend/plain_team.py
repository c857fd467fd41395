"""Teams of the graph family in which nothing is hard, from which each test changes one thing."""

from dataclasses import replace
from typing import Any

from flocc_lab.graph_family.family_spec import Lengths, drawn
from flocc_lab.graph_family.graphs import Member, made


def plain_team(seed: int, keyframes: tuple[int, ...], **changes: Any) -> Member:
    """Robots in a plane with true odometry and metric closures, all as exact as they say, but for what is changed."""
    plain = replace(
        drawn(seed),
        keyframes=keyframes,
        scale_off=(1.0,) * len(keyframes),
        lengths=Lengths.METRIC,
        closures=60,
        odometry=(0.002, 0.02),
        closure=(0.01, 0.05),
        odometry_factor=1.0,
        closure_factor=1.0,
        heavy_tails=False,
        outliers=0.0,
        groups=0,
        weak=False,
        opposite=False,
        parallel=False,
        planar=True,
    )
    return made(replace(plain, **changes))
