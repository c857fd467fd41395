"""Measure what docs/reliability.md says of swarms on virtual time.

    python -m flocc_lab.measure loss
    python -m flocc_lab.measure gossip
    python -m flocc_lab.measure scale --robots 50 --minutes 10
    python -m flocc_lab.measure scale --robots 20 --minutes 2 --area-m 76
    python -m flocc_lab.measure twice --seeds 200

Each prints one JSON object. Everything but `cpu_s` and `memory_mb` is the same wherever it runs.
"""

import argparse
import json
import resource
import sys
import time
from collections import Counter
from dataclasses import replace
from typing import Any

from flocc_agent.core.parameters import CoreParameters, PlaceRecognitionParameters
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.campaign import prepared
from flocc_launch.simulation.generator import FAULTS_END_S, drawn_scenario
from flocc_launch.simulation.invariants import Invariant, InvariantWatch
from flocc_launch.simulation.liveness import not_everywhere
from flocc_launch.simulation.safety import Once
from flocc_launch.simulation.simulate import playbacks_of, swarm_of
from flocc_launch.simulation.swarm import Swarm
from flocc_protocol.records import decode_record

GOSSIP_KINDS = ("records", "want-records")
SETTLE_S = 60.0


def loss(ratios: tuple[float, ...] = (0.0, 0.2, 0.5)) -> dict[str, Any]:
    """The same swarm with more and more loss: closures, bytes, and whether a hole remains."""
    rows = {str(ratio): _with_loss(ratio) for ratio in ratios}
    lossless = rows[str(ratios[0])]["sent_bytes"]
    for row in rows.values():
        row["bytes_ratio"] = round(row["sent_bytes"] / lossless, 3)
    return {"loss": rows}


def gossip(dimension: int = 512) -> dict[str, Any]:
    """Bytes that replicating one keyframe costs per neighbour, heartbeats counted apart."""
    swarm = _swarm(_scenario(robots=4, dimension=dimension, similarity_threshold=1.0), 80.0)
    keyframes = sum(len(station.playback.captures) for station in swarm.stations.values())
    received = sum(swarm.network.traffic[name].received[kind] for name in swarm.stations for kind in GOSSIP_KINDS)
    neighbours = len(swarm.stations) - 1
    return {"keyframes": keyframes, "bytes_per_keyframe_and_neighbour": round(received / keyframes / neighbours, 1)}


def scale(robots: int, minutes: float, area_m: float = 120.0, closures_enough: int | None = None) -> dict[str, Any]:
    """A large swarm in a town, radio range 25 m: CPU time of the simulation on one core, bytes by kind, memory."""
    scenario = town(robots, area_m, minutes)
    if closures_enough is not None:
        scenario = with_enough(scenario, closures_enough)
    began_s = time.process_time()
    playbacks = playbacks_of(scenario, {})
    drawn_s = time.process_time()
    swarm = swarm_of(scenario, playbacks, scenario.seed)
    swarm.run_until(60.0 * minutes)
    done_s = time.process_time()
    received = sum((traffic.received for traffic in swarm.network.traffic.values()), Counter[str]())
    cores = [station.core for station in swarm.running() if station.core]
    written = Counter[str]()
    for core in cores:
        for data in core.gossip.logs[core.log].encoded:
            written[type(decode_record(data)).__name__] += len(data)
    held_bytes = sum(len(data) for core in cores for copy in core.gossip.logs.values() for data in copy.encoded)
    return {
        "robots": robots,
        "area_m": area_m,
        "virtual_s": 60.0 * minutes,
        "keyframes": sum(len(playback.captures) for playback in playbacks.values()),
        "logs_held_least": min(len(core.gossip.logs) for core in cores),
        "closures": max(core.assembly.closures for core in cores),
        "record_bytes": dict(written.most_common()),
        "held_ratio": round(held_bytes / len(cores) / sum(written.values()), 3),
        "messages_received_bytes": sum(received.values()),
        "received_bytes": dict(received.most_common()),
        "memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "cpu_walks_s": round(drawn_s - began_s, 1),
        "cpu_s": round(done_s - drawn_s, 1),
    }


def town(robots: int, area_m: float, minutes: float, seed: int = 3) -> Scenario:
    """Robots that walk through a town of an edge of `area_m`, with a radio range of 25 m."""
    scenario = _scenario(robots=robots, area_m=area_m, length_m=42.0 * minutes, range_m=25.0, distance_m=2.0)
    assert scenario.tracks is not None
    return scenario.model_copy(update={"tracks": scenario.tracks.model_copy(update={"seed": seed})})


def with_enough(scenario: Scenario, closures_enough: int) -> Scenario:
    """The same, where pairs are spared beside so many that agree, however small the team is; 0: none is."""
    closing = replace(scenario.core.loop_closing, closures_enough=closures_enough, sparing_logs_min=0)
    return scenario.model_copy(update={"core": replace(scenario.core, loop_closing=closing)})


def twice(seeds: int) -> dict[str, Any]:
    """How many pairs of a campaign were registered again, though the robot that began with it lived on."""
    pairs = again = 0
    for seed in range(seeds):
        swarm, once = prepared(drawn_scenario(seed)), Once(separated=True)
        InvariantWatch(swarm, [Invariant("registered once", step=once.step)])
        swarm.run_until(FAULTS_END_S + SETTLE_S)
        pairs, again = pairs + once.pairs, again + once.again
    return {"seeds": seeds, "pairs": pairs, "registered_twice": again}


def _with_loss(ratio: float) -> dict[str, Any]:
    swarm = _swarm(_scenario(robots=4, loss_ratio=ratio), 57.0 + SETTLE_S)
    station = next(station for station in swarm.running() if station.core and station.core.election.leading)
    assert station.core is not None
    return {
        "closures": station.core.assembly.closures,
        "sent_bytes": sum(sum(traffic.sent.values()) for traffic in swarm.network.traffic.values()),
        "holes": list(not_everywhere(swarm)),
    }


def _swarm(scenario: Scenario, seconds: float) -> Swarm:
    swarm = swarm_of(scenario, playbacks_of(scenario, {}), scenario.seed)
    swarm.run_until(seconds)
    return swarm


def _scenario(
    robots: int,
    area_m: float = 20.0,
    length_m: float = 40.0,
    range_m: float | None = None,
    loss_ratio: float = 0.0,
    distance_m: float = 1.0,
    dimension: int = 128,
    similarity_threshold: float = 0.6,
) -> Scenario:
    fields = {
        "name": "measure",
        "tracks": {"robots": robots, "seed": 3, "area_m": area_m, "length_m": length_m},
        "keyframes": {"distance_m": distance_m, "rotation_rad": 0.7},
        "radio": {"range_m": range_m, "loss_ratio": loss_ratio, "latency_s": 0.02},
        "perception": {"method": "synthetic", "synthetic": {"dimension": dimension, "outlier_probability": 0.0}},
        "simulation": {"optimiser": "quick"},
    }
    core = CoreParameters(place_recognition=PlaceRecognitionParameters(similarity_threshold=similarity_threshold))
    return Scenario.model_validate({**fields, "core": core})


def main() -> None:
    """Measure one thing and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("loss", "gossip", "scale", "twice"))
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--area-m", type=float, default=120.0)
    parser.add_argument(
        "--closures-enough",
        type=int,
        help="agreeing ways between two stretches, however small the team; 0: register all pairs",
    )
    parser.add_argument("--seeds", type=int, default=200)
    given = parser.parse_args()
    match given.what:
        case "loss":
            measured = loss()
        case "gossip":
            measured = gossip()
        case "twice":
            measured = twice(given.seeds)
        case _:
            measured = scale(given.robots, given.minutes, given.area_m, given.closures_enough)
    sys.stdout.write(json.dumps({**measured, "command": " ".join(sys.argv[1:])}) + "\n")


if __name__ == "__main__":
    main()
