"""How many closures a dense team has, and what fewer of them cost in accuracy.

    python -m flocc_lab.bench.closure_density --robots 20 --area-m 53.7 --seeds 4 5

A swarm walks through a town on virtual time and registers all pairs. Then closures become known once more in the order
of their later keyframes, and those are left out at whose ends both ways have enough closures for each of their
keyframes, with whatever other robots: the most that any rule could spare which leaves each stretch as many. The
leader's graph is solved with all and with the rest. Prints a line of JSON for each seed.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from flocc_agent.core.pose_graph import PoseGraph
from flocc_agent.core.spared import STRETCH
from flocc_lab.bench.spared_closures import Replay
from flocc_lab.measure import town, with_enough
from flocc_lab.mission import leader_ate_m
from flocc_launch.simulation.simulate import playbacks_of, swarm_of
from flocc_protocol.messages import CandidatePair

DENSITIES = (0.5, 1.0, 2.0)
"""Ends of closures for each keyframe: each closure has two."""


def kept_by_density(graph: PoseGraph, enough: float) -> list[int]:
    """Which closures of a graph remain where stretches get no more than so many for each keyframe; sorted."""
    replay, kept = Replay(graph, enough=0), list[int]()
    numbers = {CandidatePair.of(c.query, c.match): k for k, c in enumerate(graph.closures)}
    for pair in sorted(numbers, key=lambda each: (max(each.low.index, each.high.index), each)):
        if min(replay.assembly.foretelling.density(end, STRETCH) for end in (pair.low, pair.high)) < enough:
            kept.append(numbers[pair])
            replay.learn(graph.closures[numbers[pair]])
    return sorted(kept)


def of_team(robots: int, area_m: float, minutes: float, seed: int, densities: Sequence[float]) -> dict[str, Any]:
    """One swarm."""
    scenario = with_enough(town(robots, area_m, minutes, seed).model_copy(update={"seed": seed}), 0)
    swarm = swarm_of(scenario, playbacks_of(scenario, {}), scenario.seed)
    swarm.run_until(60.0 * minutes)
    received = sum((traffic.received for traffic in swarm.network.traffic.values()), Counter[str]())
    leader = next(s.core for s in swarm.running() if s.core and s.core.election.leading)
    graph = leader.assembly.graph()
    ate_m = leader_ate_m(swarm, graph)
    row: dict[str, Any] = {
        "robots": robots,
        "area_m": area_m,
        "seed": seed,
        "keyframes": sum(len(each.T_odom_keyframe) for each in graph.trajectories.values()),
        "closures": len(graph.closures),
        "ate_m": ate_m,
        "bytes_per_robot": round(sum(received.values()) / robots),
    }
    for density in densities:
        kept = kept_by_density(graph, density)
        fewer = replace(graph, closures=tuple(graph.closures[k] for k in kept))
        is_all = len(kept) == len(graph.closures)
        ratio = 1.0 if is_all else round(leader_ate_m(swarm, fewer) / ate_m, 3)
        row[f"density_{density:g}"] = {"closures": len(kept), "ate_ratio": ratio}
    return row


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--area-m", type=float, default=53.7)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3])
    parser.add_argument("--densities", type=float, nargs="+", default=list(DENSITIES))
    given = parser.parse_args()
    for seed in given.seeds:
        row = of_team(given.robots, given.area_m, given.minutes, seed, given.densities)
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
