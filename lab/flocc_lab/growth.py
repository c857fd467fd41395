"""How what a robot pays grows with the team: bytes and CPU per robot against the number of robots.

    python -m flocc_lab.growth
    python -m flocc_lab.growth --robots 5 10 20 50 --minutes 2 --area-m 120

Twice the same teams (`measure.scale`): all in one area, and each robot with as much of it as one of the largest team
has. Each simulation has a process of its own. Prints one JSON object; everything but CPU and memory is the same
wherever it runs.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np

from flocc_lab.measure import scale

TEAMS_MIN = 2
Team = tuple[int, float]
"""Robots, and the edge of their town in metres."""
Simulate = Callable[[Iterable[Team], float], Mapping[Team, Mapping[str, Any]]]


def exponent(robots: Sequence[int], per_robot: Sequence[float]) -> float:
    """Slope of the line of least squares through the logarithms: 1 where a robot pays in proportion to the team."""
    slope, _ = np.polyfit(np.log(robots), np.log(per_robot), 1)
    return round(float(slope), 2)


def areas_m(robots: Sequence[int], area_m: float) -> dict[str, list[float]]:
    """Edges of the towns, by what is held fixed."""
    return {
        "area": [area_m] * len(robots),
        "density": [round(area_m * math.sqrt(n / max(robots)), 1) for n in robots],
    }


def simulated(teams: Iterable[Team], minutes: float) -> dict[Team, dict[str, Any]]:
    """What each costs, by the number of robots and the edge of their town; one after the other."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        runs = {(n, edge_m): pool.submit(scale, n, minutes, edge_m) for n, edge_m in teams}
        return {team: run.result() for team, run in runs.items()}


def growth(robots: Sequence[int], minutes: float, area_m: float, simulate: Simulate = simulated) -> dict[str, Any]:
    """Simulate all teams in both kinds of town, and fit."""
    fixed = areas_m(robots, area_m)
    teams = {(n, edge_m) for edges in fixed.values() for n, edge_m in zip(robots, edges, strict=True)}
    done = simulate(sorted(teams), minutes)
    return {
        "minutes": minutes,
        "load_average": os.getloadavg()[0],
        **{
            f"fixed_{kind}": _fitted(robots, [done[n, edge_m] for n, edge_m in zip(robots, edges, strict=True)])
            for kind, edges in fixed.items()
        },
    }


def _fitted(robots: Sequence[int], runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The runs of one kind of town in short, and their exponents: of all teams, and of the two largest alone."""
    rows = [_row(run) for run in runs]
    columns = ("bytes_per_robot", "cpu_s_per_robot")
    return {
        "runs": rows,
        "exponents": {column: exponent(robots, [row[column] for row in rows]) for column in columns},
        "exponents_of_the_largest": {
            column: exponent(robots[-2:], [row[column] for row in rows[-2:]]) for column in columns
        },
    }


def _row(run: Mapping[str, Any]) -> dict[str, Any]:
    robots, received = run["robots"], run["messages_received_bytes"]
    shares = {kind: run["received_bytes"].get(kind, 0) / received for kind in ("records", "heartbeat", "correction")}
    return {
        **{key: run[key] for key in ("robots", "area_m", "keyframes", "closures", "held_ratio", "memory_mb")},
        "bytes_per_robot": round(received / robots),
        "cpu_s_per_robot": round(run["cpu_s"] / robots, 4),
        "shares": {kind: round(share, 3) for kind, share in shares.items()},
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[5, 10, 20, 50])
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--area-m", type=float, default=120.0, help="Edge of the town, for the largest team at least.")
    given = parser.parse_args()
    robots = sorted(set(given.robots))
    if len(robots) < TEAMS_MIN or robots[0] < 1:
        parser.error("--robots names at least two numbers of robots, each 1 or more")
    measured = growth(robots, given.minutes, given.area_m)
    sys.stdout.write(json.dumps({**measured, "command": " ".join(sys.argv[1:])}) + "\n")


if __name__ == "__main__":
    main()
