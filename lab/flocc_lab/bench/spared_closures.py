"""What it costs in accuracy that closures which tell nothing new are not registered.

    python -m flocc_lab.bench.spared_closures --draws 40 --first 7000 --keyframes-max 400
    python -m flocc_lab.bench.spared_closures ../shared/data/cosmo_bench/wifi/kth_r3_00_d06_d09_d10_wifi.jrl
    python -m flocc_lab.bench.spared_closures --walks 6 --first 7000
    python -m flocc_lab.bench.spared_closures --scenario ../shared/data/street

Drawn graphs and files: their closures become known in the order of their later keyframes, wrong ones among them, and
those that a robot would spare are left out; both graphs are solved. Walks and scenarios: the swarm runs twice on
virtual time, all pairs registered and such spared, and each leader's graph is solved at the end. A line of JSON each;
a drawn graph is not solved where nothing is spared.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.gossip import NewRecord
from flocc_agent.core.pose_graph import GraphSolution, LoopClosure, PoseGraph
from flocc_agent.core.spared import Spared
from flocc_agent.geometry import pose7, pose7s
from flocc_lab.graph_family.family_spec import drawn
from flocc_lab.graph_family.graphs import made
from flocc_lab.graph_family.judge import joint_ate_m
from flocc_lab.graph_family.methods import flocc, oracle, settings
from flocc_lab.measure import with_enough
from flocc_lab.mission import leader_ate_m
from flocc_launch.graph_files import read_graph_file
from flocc_launch.graph_files.graph_file import GraphFile, ate_m
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.scenarios.shipped import read_scenario
from flocc_launch.setup.cache import cache_folder
from flocc_launch.simulation.simulate import playbacks_of, run, swarm_of
from flocc_protocol.ids import LogId
from flocc_protocol.messages import CandidatePair
from flocc_protocol.records import ClosureRecord, KeyframeRecord, Record

ENOUGH = 3
"""As many as the campaign's robots need."""


class Replay:
    """A robot that knows all odometry, and learns of closures one after the other.

    Attributes:
        assembly: What it knows.
        spared: Pairs that it does not register.
    """

    def __init__(self, graph: PoseGraph, enough: int) -> None:
        """Start without closures; `enough` that agree are enough, 0: no pair is spared."""
        self.assembly = GraphAssembly()
        self.spared = Spared(self.assembly.foretelling, enough)
        self._numbers: dict[LogId, int] = {}
        for log, trajectory in graph.trajectories.items():
            for k, T in enumerate(pose7s(trajectory.T_odom_keyframe)):
                self._add(log, KeyframeRecord(k, float(k), T, None))

    def learn(self, closure: LoopClosure) -> list[CandidatePair]:
        """Register a closure; spared pairs that are to be registered because of it."""
        T, scale = closure.T_query_match_unscaled, 1.0 if closure.metric else closure.scale_initial
        record = ClosureRecord(closure.query, closure.match, pose7(T), 100, 100, closure.match_ratio, scale)
        self._add(closure.query.log, record)
        return [pair for pair, _ in self.spared.on_closure(CandidatePair.of(closure.query, closure.match))]

    def _add(self, log: LogId, record: Record) -> None:
        number = self._numbers.get(log, 0)
        self._numbers[log] = number + 1
        self.assembly.add(NewRecord(log, number, record))


def kept_of(graph: PoseGraph, enough: int = ENOUGH) -> list[int]:
    """Which closures of a graph a swarm would have registered; sorted."""
    replay, kept = Replay(graph, enough), set[int]()
    numbers = {CandidatePair.of(c.query, c.match): k for k, c in enumerate(graph.closures)}
    for pair in sorted(numbers, key=lambda each: (max(each.low.index, each.high.index), each)):
        if replay.spared.is_told(pair):
            replay.spared.add(pair, 0.0)
            continue
        waiting = [pair]
        while waiting:
            kept.add(numbers[waiting[0]])
            waiting += replay.learn(graph.closures[numbers[waiting.pop(0)]])
    return sorted(kept)


def of_draws(first: int, draws: int, keyframes_max: int) -> Iterator[dict[str, Any]]:
    """Members of the family of graphs."""
    for seed in range(first, first + draws):
        spec = drawn(seed)
        if sum(spec.keyframes) > keyframes_max:
            continue
        member = made(spec)
        kept = kept_of(member.graph)
        if len(kept) == len(member.graph.closures):
            yield {"of": f"draw {seed}", "closures": len(kept), "registered": len(kept)}
            continue
        closures = tuple(member.graph.closures[k] for k in kept)
        fewer = replace(member, graph=replace(member.graph, closures=closures), is_right=member.is_right[kept])
        groups, method = oracle(member).groups, flocc(settings())
        found = [joint_ate_m(each, method(each), groups) for each in (member, fewer)]
        yield _row(f"draw {seed}", len(member.graph.closures), len(kept), found)


def of_file(path: Path) -> dict[str, Any]:
    """A graph file that knows the truth."""
    file = read_graph_file(path)
    kept = kept_of(file.graph)
    fewer = replace(file, graph=replace(file.graph, closures=tuple(file.graph.closures[k] for k in kept)))
    return _row(path.stem, len(file.graph.closures), len(kept), [_file_ate_m(each) for each in (file, fewer)])


def _file_ate_m(file: GraphFile) -> float:
    solution = optimise(file.graph, BackendConfig(weight_by_probability=False))
    assert isinstance(solution, GraphSolution)
    component = max(solution.components, key=lambda each: len(each.logs))
    estimate = {log: np.asarray(T)[:, :3, 3] for log, T in component.T_map_keyframe.items()}
    found = ate_m(estimate, {log: file.truth_m[log] for log in estimate})
    assert found is not None, "the file has no ground truth"
    return found


def of_scenario(name: str, scenario: Scenario) -> dict[str, Any]:
    """A swarm on virtual time, twice."""
    paths, closures, found = recordings(scenario), list[int](), list[float]()
    for enough in (0, ENOUGH):
        changed = with_enough(scenario, enough)
        swarm = swarm_of(changed, playbacks_of(changed, paths), changed.seed, cache_folder())
        run(swarm)
        leader = next(s.core for s in swarm.running() if s.core and s.core.election.leading)
        closures.append(leader.assembly.closures)
        found.append(leader_ate_m(swarm, leader.assembly.graph()))
    return _row(name, closures[0], closures[1], found)


def walk_scenario(seed: int, robots: int = 5, length_m: float = 150.0, area_m: float = 60.0) -> Scenario:
    """Robots that walk through a town, with wrong closures among theirs."""
    fields = {
        "name": f"walk-{seed}",
        "seed": seed,
        "tracks": {"robots": robots, "seed": seed, "area_m": area_m, "length_m": length_m},
        "keyframes": {"distance_m": 1.0, "rotation_rad": 0.7},
        "radio": {"range_m": 25.0, "latency_s": 0.02},
        "perception": {"method": "synthetic"},
        "simulation": {"optimiser": "quick"},
    }
    return Scenario.model_validate(fields)


def _row(name: str, all_closures: int, registered: int, ates_m: list[float]) -> dict[str, Any]:
    every, fewer = ates_m
    return {
        "of": name,
        "closures": all_closures,
        "registered": registered,
        "ate_all_m": round(every, 4),
        "ate_m": round(fewer, 4),
        "ratio": round(fewer / every, 4),
    }


def main() -> None:
    """Compare what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="graph files with ground truth")
    parser.add_argument("--scenario", action="append", default=[], help="a scenario, its name or its folder")
    parser.add_argument("--draws", type=int, default=0, help="members of the family of graphs")
    parser.add_argument("--walks", type=int, default=0, help="swarms that walk through a drawn town")
    parser.add_argument("--first", type=int, default=7000, help="seed of the first draw or walk")
    parser.add_argument("--keyframes-max", type=int, default=400, help="leave out larger draws")
    given = parser.parse_args()
    for row in _rows(given):
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()


def _rows(given: argparse.Namespace) -> Iterator[dict[str, Any]]:
    yield from (of_file(path) for path in given.files)
    yield from (of_scenario(name, read_scenario(name, {})) for name in given.scenario)
    yield from of_draws(given.first, given.draws, given.keyframes_max)
    seeds = range(given.first, given.first + given.walks)
    yield from (of_scenario(f"walk {seed}", walk_scenario(seed)) for seed in seeds)


if __name__ == "__main__":
    main()
