"""What a limit on what is held in memory costs in closures and accuracy, on virtual time.

    python -m flocc_lab.mission --robots 4 --minutes 15 --held 100

One swarm in a town is run twice, with the limit and with all keyframes held; what each leader's graph holds at the end
is solved by the back end. Prints one JSON object. `cpu_quarters_s` is of the whole simulation, without that solve.
"""

import argparse
import json
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend.optimiser import optimise
from flocc_agent.config import BackendConfig
from flocc_agent.core.parameters import CoreParameters, MemoryParameters, PlaceRecognitionParameters
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph
from flocc_launch.graph_files.graph_file import ate_m
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.rightness import true_poses
from flocc_launch.simulation.simulate import playbacks_of, swarm_of
from flocc_launch.simulation.swarm import Swarm
from flocc_protocol.ids import KeyframeId, LogId

ALL_HELD = 10**9
AREA_M = 60.0
"""Side of a town in which robots are back at old places all the time."""
OLD_S = 120.0
"""A closure is to an old place when its keyframes are so far apart in time."""
SIMILARITY = 0.6
BESIDE_KEYFRAMES = 2
PLACE_M = 4.0
"""A place is the same one so far away: what the synthetic perception sees from one place."""
Float = NDArray[np.float64]
Ends = tuple[KeyframeId, LogId, Float]


def mission(robots: int, minutes: float, held: int) -> dict[str, Any]:
    """Run both, and compare."""
    limited, whole = (_run(robots, minutes, count) for count in (held, ALL_HELD))
    old = limited.pop("old"), whole.pop("old")
    recall = _recall(old[1], limited.pop("ends"))
    whole.pop("ends")
    return {
        "robots": robots,
        "virtual_s": 60.0 * minutes,
        "held": held,
        "limited": limited,
        "all_held": whole,
        "old_closures": [len(each) for each in old],
        "recall_of_old": round(recall, 4),
        "ate_ratio": round(limited["ate_m"] / whole["ate_m"], 4),
    }


def _run(robots: int, minutes: float, held: int) -> dict[str, Any]:
    swarm = town_swarm(robots, minutes, held)
    quarters = []
    for quarter in range(1, 5):
        began = time.process_time()
        swarm.run_until(60.0 * minutes * quarter / 4)
        quarters.append(round(time.process_time() - began, 1))
    swarm.run_until(60.0 * minutes + OLD_S)
    cores = [station.core for station in swarm.running() if station.core]
    leader = next(core for core in cores if core.election.leading)
    graph = leader.assembly.graph()
    return {
        "keyframes": leader.assembly.keyframes,
        "closures": len(graph.closures),
        "descriptors_held_most": max(core.recognition.rows for core in cores),
        "cpu_quarters_s": quarters,
        "ate_m": _ate_m(swarm, graph),
        "ends": _ends(swarm, graph),
        "old": _old(swarm, graph),
    }


def town_swarm(robots: int, minutes: float, held: int, area_m: float = AREA_M) -> Swarm:
    """A swarm in a town, with this many keyframes held."""
    fields = {
        "name": "mission",
        "tracks": {"robots": robots, "seed": 3, "area_m": area_m, "length_m": 42.0 * minutes},
        "keyframes": {"distance_m": 1.0, "rotation_rad": 0.7},
        "radio": {"latency_s": 0.02},
        "perception": {"method": "synthetic", "synthetic": {"dimension": 128}},
        "simulation": {"optimiser": "quick"},
    }
    core = CoreParameters(
        place_recognition=PlaceRecognitionParameters(similarity_threshold=SIMILARITY),
        memory=MemoryParameters(keyframes_held=held),
    )
    scenario = Scenario.model_validate({**fields, "core": core})
    return swarm_of(scenario, playbacks_of(scenario, {}), scenario.seed)


def _ends(swarm: Swarm, graph: PoseGraph) -> list[Ends]:
    """Both keyframes of each closure, the later one first, and where the earlier one was."""
    found = []
    for closure in graph.closures:
        earlier, later = sorted((closure.query, closure.match), key=lambda end: _stamp_s(swarm, end))
        T = true_poses(swarm.stations[earlier.log.robot].playback)[_stamp_s(swarm, earlier)]
        found.append((later, earlier.log, T[:3, 3]))
    return found


def _old(swarm: Swarm, graph: PoseGraph) -> list[Ends]:
    """Those closures whose keyframes are far apart in time."""
    closures = zip(graph.closures, _ends(swarm, graph), strict=True)
    return [ends for c, ends in closures if abs(_stamp_s(swarm, c.query) - _stamp_s(swarm, c.match)) >= OLD_S]


def _stamp_s(swarm: Swarm, keyframe: KeyframeId) -> float:
    return swarm.stations[keyframe.log.robot].playback.captures[keyframe.index].stamp_s


def _recall(old: list[Ends], found: list[Ends]) -> float:
    """Share of closures for which there is one from beside the later keyframe to the same place in the same log."""
    by_logs: dict[tuple[LogId, LogId], list[tuple[int, Float]]] = {}
    for later, log, at_m in found:
        by_logs.setdefault((later.log, log), []).append((later.index, at_m))
    again = sum(
        any(
            abs(index - later.index) <= BESIDE_KEYFRAMES and np.linalg.norm(there_m - at_m) <= PLACE_M
            for index, there_m in by_logs.get((later.log, log), ())
        )
        for later, log, at_m in old
    )
    return again / max(len(old), 1)


def _ate_m(swarm: Swarm, graph: PoseGraph) -> float:
    """Joint error of one solve over a graph, of its largest component."""
    solution = optimise(graph, BackendConfig())
    assert isinstance(solution, GraphSolution)
    component = max(solution.components, key=lambda each: len(each.logs))
    estimate = {log: np.asarray(T)[:, :3, 3] for log, T in component.T_map_keyframe.items()}
    truth = {}
    for log, positions in estimate.items():
        playback = swarm.stations[log.robot].playback
        poses = true_poses(playback)
        stamps = [capture.stamp_s for capture in playback.captures[: len(positions)]]
        truth[log] = np.array([poses[stamp][:3, 3] for stamp in stamps])
    error_m = ate_m(estimate, truth)
    assert error_m is not None
    return round(error_m, 4)


def main() -> None:
    """Compare once and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--held", type=int, default=100)
    given = parser.parse_args()
    measured = mission(given.robots, given.minutes, given.held)
    sys.stdout.write(json.dumps({**measured, "command": " ".join(sys.argv[1:])}) + "\n")


if __name__ == "__main__":
    main()
