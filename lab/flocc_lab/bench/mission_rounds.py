"""What rounds cost while a mission grows, and how far maps lie from whole rounds' where only what is new is judged.

    python -m flocc_lab.bench.mission_rounds --robots 4 --keyframes 5000 --closures 1000 --outliers 0.05 --seed 1

A drawn mission is solved from nothing when it has so many keyframes. From then on each round has ten closures more, and
the keyframes that came meanwhile; all rounds are done twice, whole ones from the round before, and such as rest on the
choice of closures of the last whole one where they can. Prints one JSON object: CPU seconds, ratios to the first solve,
joint ATE against the truth.
"""

import argparse
import json
import logging
import sys
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import GraphSolution, LoopClosure, PoseGraph, Trajectory
from flocc_lab.bench.generated_graph import GeneratedGraph, generate
from flocc_launch.graph_files.graph_file import ate_m

CLOSURES_PER_ROUND = 10
GROWTH_RATIO = 1.2
"""Of the keyframes that are drawn to those at which rounds begin."""
CONFIG = BackendConfig(weight_by_probability=False)


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """A drawn graph and its closures in the order in which they are found; `ends` (L,) are their later keyframes."""

    drawn: GeneratedGraph
    closures: tuple[LoopClosure, ...]
    ends: np.ndarray[Any, np.dtype[np.int64]]

    def at(self, closures: int) -> PoseGraph:
        """The graph when so many closures have been found."""
        keyframes = int(self.ends[closures - 1]) + 1
        cut = {}
        for log, t in self.drawn.graph.trajectories.items():
            S = t.edge_covariances
            cut[log] = Trajectory(t.T_odom_keyframe[:keyframes], None if S is None else S[: keyframes - 1])
        return PoseGraph(cut, tuple(sorted(self.closures[:closures], key=lambda c: (c.query, c.match))))

    def ate_m(self, solution: GraphSolution) -> float:
        """Joint error of the largest component."""
        component = max(solution.components, key=lambda each: len(each.logs))
        estimate = {log: np.asarray(T)[:, :3, 3] for log, T in component.T_map_keyframe.items()}
        truth = self.drawn.truth_m()
        error_m = ate_m(estimate, {log: truth[log][: len(at)] for log, at in estimate.items()})
        assert error_m is not None
        return error_m


def measure(robots: int, keyframes: int, closures: int, outlier_ratio: float, rounds: int, seed: int) -> dict[str, Any]:
    """Do the rounds of one mission both ways; keyframes and closures are those at which they begin."""
    longer, more = int(GROWTH_RATIO * keyframes / robots), int(GROWTH_RATIO * closures)
    drawn = generate(np.random.default_rng(seed), robots, longer, more, outlier_ratio)
    of_mission = sorted(drawn.graph.closures, key=lambda c: (max(c.query.index, c.match.index), c.query, c.match))
    ends = np.array([max(c.query.index, c.match.index) for c in of_mission])
    mission = Mission(drawn, tuple(of_mission), ends)
    known = int(np.searchsorted(ends, keyframes // robots))
    rounds = min(rounds, (len(of_mission) - known) // CLOSURES_PER_ROUND)
    first, full_s = _timed(mission.at(known), None)
    counts = [known + CLOSURES_PER_ROUND * (k + 1) for k in range(rounds)]
    whole = _rounds(mission, counts, replace(first, iterations=0))
    settled = _rounds(mission, counts, first)
    ratios = np.array(settled["ate_m"]) / np.array(whole["ate_m"])
    return {
        "keyframes": sum(len(T) for T in mission.at(counts[-1]).trajectories.values()),
        "closures": counts[-1],
        "from_nothing_s": round(full_s, 2),
        "whole": _told(whole, full_s),
        "settled": _told(settled, full_s),
        "ate_ratio": {"mean": round(float(ratios.mean()), 4), "worst": round(float(ratios.max()), 4)},
    }


def _rounds(mission: Mission, counts: list[int], first: GraphSolution) -> dict[str, list[float]]:
    """CPU seconds, error, and whether each round was whole; from a start that solved nothing all are."""
    solution, follows = first, first.iterations > 0
    done: dict[str, list[float]] = {"cpu_s": [], "ate_m": [], "whole": []}
    for count in counts:
        solution, cpu_s = _timed(mission.at(count), solution)
        done["cpu_s"].append(cpu_s)
        done["ate_m"].append(mission.ate_m(solution))
        done["whole"].append(float(solution.whole is None))
        solution = solution if follows else replace(solution, iterations=0)
    return done


def _timed(graph: PoseGraph, initial: GraphSolution | None) -> tuple[GraphSolution, float]:
    began = time.process_time()
    solution = optimise(graph, CONFIG, initial)
    assert isinstance(solution, GraphSolution)
    return solution, time.process_time() - began


def _told(done: dict[str, list[float]], full_s: float) -> dict[str, float]:
    cpu_s = np.array(done["cpu_s"])
    return {
        "rounds": len(cpu_s),
        "solved_whole": int(sum(done["whole"])),
        "mean_s": round(float(cpu_s.mean()), 3),
        "median_s": round(float(np.median(cpu_s)), 3),
        "mean_ratio": round(float(cpu_s.mean()) / full_s, 4),
        "median_ratio": round(float(np.median(cpu_s)) / full_s, 4),
        "ate_m": round(float(np.mean(done["ate_m"])), 4),
    }


def main() -> None:
    """Measure one mission and print it."""
    logging.disable(logging.CRITICAL)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--keyframes", type=int, default=5000)
    parser.add_argument("--closures", type=int, default=1000)
    parser.add_argument("--outliers", type=float, default=0.05)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    measured = measure(given.robots, given.keyframes, given.closures, given.outliers, given.rounds, given.seed)
    sys.stdout.write(json.dumps({**measured, "command": " ".join(sys.argv[1:])}) + "\n")


if __name__ == "__main__":
    main()
