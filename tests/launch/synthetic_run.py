"""A run folder that no swarm made: three robots in a hall, with everything that a report shows."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.registration import closure_probability
from flocc_agent.geometry import between, inverse, pose, se3_exp, so3_exp, tq_from_pose
from flocc_agent.runtime.robot_result import ClosureKnown, KeyframeResult, RobotResult
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.run_records import Run

Float = NDArray[np.float64]

WAYPOINTS_M = {
    "r1": [(0, 0), (24, 0), (24, 12), (12, 12), (12, 4), (2, 4)],
    "r2": [(30, 14), (30, 1), (14, 1), (14, 13), (4, 13), (4, 2)],
    "r3": [(2, 15), (25, 15), (25, 6), (8, 6), (8, 14), (20, 14)],
}
SPEED_M_S = 0.7
KEYFRAME_EVERY_S = 1.5
START_S = 1_700_000_000.0


@dataclass
class Synthetic:
    """Options of the run, and the poses it is made of."""

    seed: int = 7
    died: tuple[str, float] | None = None
    merged_s: float | None = 40.0
    with_truth: bool = True
    events: list[dict[str, Any]] = field(default_factory=list)
    truth: dict[str, Float] = field(default_factory=dict)
    odometry: dict[str, Float] = field(default_factory=dict)
    corrected: dict[str, Float] = field(default_factory=dict)
    closures: list[ClosureKnown] = field(default_factory=list)


def write(path: Path, options: Synthetic | None = None) -> RunFolder:
    """Write the folder as a driver leaves it, without what `finish` adds."""
    made = options or Synthetic()
    rng = np.random.default_rng(made.seed)
    for robot, corners in WAYPOINTS_M.items():
        made.truth[robot] = route(corners)
        made.odometry[robot] = drifted(made.truth[robot], rng)
        made.corrected[robot] = disturbed(made.truth[robot], rng)
    folder = RunFolder.create(path)
    fill_events(made, rng)
    folder.write_run(run_of(made))
    folder.write_events(made.events)
    for robot in WAYPOINTS_M:
        if made.died is None or robot != made.died[0]:
            folder.write_result(result_of(made, robot))
        if made.with_truth:
            write_truth(path / "recordings" / robot / "groundtruth.tum", made.truth[robot])
    return folder


def route(corners: list[tuple[int, int]]) -> Float:
    """True body poses every `KEYFRAME_EVERY_S`, x forward, along straight lines between corners."""
    points = np.array(corners, dtype=float)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.arange(0, lengths.sum(), SPEED_M_S * KEYFRAME_EVERY_S)
    ends = np.concatenate([[0], np.cumsum(lengths)])
    poses = []
    for s in along:
        k = min(int(np.searchsorted(ends, s, side="right")) - 1, len(lengths) - 1)
        part = (s - ends[k]) / lengths[k]
        x, y = (1 - part) * points[k] + part * points[k + 1]
        dx, dy = points[k + 1] - points[k]
        z = 1.0 + 0.1 * np.sin(s)
        poses.append(pose(so3_exp(np.array([0, 0, np.arctan2(dy, dx)])), np.array([x, y, z])))
    return np.array(poses)


def drifted(truth: Float, rng: np.random.Generator) -> Float:
    """Odometry from its own origin: each step with noise and a constant turn."""
    bias = np.array([0, 0, rng.normal(0, 0.004), 0, 0, 0])
    poses = [np.eye(4)]
    for before, after in pairwise(truth):
        noise = np.concatenate([rng.normal(0, 0.004, 3), rng.normal(0, 0.02, 3)])
        poses.append(poses[-1] @ between(before, after) @ se3_exp(bias + noise))
    return np.array(poses)


def disturbed(truth: Float, rng: np.random.Generator) -> Float:
    """Corrected poses in the map frame of r1, with a slow error of some centimetres."""
    T_map_world = inverse(se3_exp(np.array([0, 0, 0.3, 4, 5, 0])))
    walk = np.cumsum(rng.normal(0, 0.02, (len(truth), 3)), axis=0)
    shifts = np.array([pose(np.eye(3), t) for t in walk - walk.mean(axis=0)])
    return np.asarray(T_map_world @ shifts @ truth)


def stamps(poses: Float) -> Float:
    """Stamps of keyframes on the recording's clock."""
    return np.asarray(START_S + KEYFRAME_EVERY_S * np.arange(len(poses)), dtype=np.float64)


def write_truth(path: Path, truth: Float) -> None:
    """Ground truth as a recording has it."""
    path.parent.mkdir(parents=True)
    write_tum(path, Trajectory(stamps(truth), truth))


def living(made: Synthetic, robot: str, t: float) -> bool:
    return made.died is None or robot != made.died[0] or t < made.died[1]


def fill_events(made: Synthetic, rng: np.random.Generator) -> None:
    """Everything that happened, in any order."""
    for robot, poses in made.odometry.items():
        for i, T in enumerate(poses):
            t = KEYFRAME_EVERY_S * i + 0.2
            if living(made, robot, t):
                stamp_s = float(stamps(poses)[i])
                say(made, t, robot, "keyframe", keyframe=f"{robot}/{i}", stamp_s=stamp_s, T_odom_body=listed(T))
    fill_pairs(made, rng)
    fill_leaders(made)
    fill_corrections(made)
    fill_bytes(made)
    if made.died is not None:
        say(made, made.died[1], made.died[0], "agent_died", signal=9, exit_code=None)
    end = max(event["t"] for event in made.events) + 2.0
    for robot in WAYPOINTS_M:
        if living(made, robot, end):
            say(made, end, robot, "agent_stopped")


def say(made: Synthetic, t: float, robot: str, event: str, **fields: Any) -> None:
    made.events.append({"t": round(t, 6), "robot": robot, "event": event, **fields})


def listed(T: Float) -> list[float]:
    return [float(v) for v in tq_from_pose(T)]


def fill_pairs(made: Synthetic, rng: np.random.Generator) -> None:
    """Candidates where two robots came within 2.5 m, and some that only look alike."""
    for query_robot, match_robot in (("r1", "r2"), ("r1", "r3"), ("r2", "r3")):
        query, match = made.truth[query_robot], made.truth[match_robot]
        apart = np.linalg.norm(query[:, None, :3, 3] - match[None, :, :3, 3], axis=-1)
        near = [(i, int(np.argmin(apart[i]))) for i in range(len(query)) if apart[i].min() < 2.5]
        false = [(int(i), int(rng.integers(len(match)))) for i in rng.choice(len(query), 6, replace=False)]
        for i, j in sorted({*near, *false}):
            t = KEYFRAME_EVERY_S * max(i, j) + 1.0
            if living(made, query_robot, t) and living(made, match_robot, t):
                fill_pair(made, rng, (query_robot, i), (match_robot, j), t, float(apart[i, j]))


def fill_pair(
    made: Synthetic, rng: np.random.Generator, query: tuple[str, int], match: tuple[str, int], t: float, apart: float
) -> None:
    names = {"query": f"{query[0]}/{query[1]}", "match": f"{match[0]}/{match[1]}"}
    say(made, t, query[0], "candidate", **names, similarity=float(np.clip(0.95 - 0.1 * apart / 2, 0.62, 1)))
    ratio = float(np.clip(1.1 - 0.25 * apart + rng.normal(0, 0.12), 0.02, 1.6))
    if apart > 6 and rng.random() < 0.5:
        say(made, t + 1.2, query[0], "closure_rejected", **names, ratio=None, reason="few correspondences")
    elif ratio < 0.55:
        say(made, t + 1.2, query[0], "closure_rejected", **names, ratio=ratio, reason="match ratio below 0.55")
    else:
        accept(made, t + 1.2, query, match, names, ratio)


def accept(
    made: Synthetic, t: float, query: tuple[str, int], match: tuple[str, int], names: dict[str, str], ratio: float
) -> None:
    probability = closure_probability(ratio, 4.0)
    counts = {"correspondences": int(ratio * 300), "odometry_correspondences": 300}
    say(
        made, t, query[0], "closure_accepted", **names, ratio=ratio, probability=probability, **counts,
        scale_initial=2.0, by=query[0],
    )  # fmt: skip
    T = between(made.truth[query[0]][query[1]], made.truth[match[0]][match[1]])
    T[:3, 3] /= 2.0
    made.closures.append(ClosureKnown(**names, T_query_match_unscaled=listed(T), match_ratio=ratio, scale_initial=2.0))


def fill_leaders(made: Synthetic) -> None:
    """First each alone, then r1 leads; r2 takes over when r1 dies."""
    for robot in WAYPOINTS_M:
        say(made, 0.3, robot, "leader", term=1, leader=robot)
        say(made, 4.0 + 0.2 * int(robot[1]), robot, "leader", term=2, leader="r1")
        for peer in WAYPOINTS_M:
            if peer != robot:
                fill_links(made, robot, peer)
    if made.died is not None:
        for robot in WAYPOINTS_M:
            if robot != made.died[0]:
                say(made, made.died[1] + 3.1, robot, "leader", term=3, leader="r2" if made.died[0] == "r1" else "r1")


def fill_links(made: Synthetic, robot: str, peer: str) -> None:
    say(made, 2.0, robot, "neighbour_up", peer=peer)
    if {robot, peer} == {"r2", "r3"} and made.died is None:
        say(made, 18.0, robot, "neighbour_down", peer=peer)
        say(made, 31.5, robot, "neighbour_up", peer=peer)
    if made.died is not None and peer == made.died[0]:
        say(made, made.died[1] + 3.0, robot, "neighbour_down", peer=peer)


def fill_corrections(made: Synthetic) -> None:
    """A correction every five seconds; until `merged_s` everyone has a map of its own."""
    end = max(event["t"] for event in made.events)
    for k, t in enumerate(np.arange(6.0, end, 5.0)):
        leader = "r1" if made.died is None or t < made.died[1] + 3 else "r2"
        merged = made.merged_s is not None and t >= made.merged_s
        parts = [["r1", "r2", "r3"]] if merged else [["r1"], ["r2"], ["r3"]]
        say(
            made, float(t), leader, "optimised", term=2, round=k, components=parts, keyframes=30 + 9 * k,
            closures_used=3 * k, closures_rejected=k // 6, cost=40.0 / (k + 1), solve_s=0.02 + 0.004 * k,
            warnings=["the scale of one closure is unobservable"] if k % 7 == 0 else [],
        )  # fmt: skip
        for robot in WAYPOINTS_M:
            frame = "map/r1" if merged else f"map/{robot}"
            changed = bool(merged and robot != "r1" and made.merged_s is not None and t < made.merged_s + 5)
            if living(made, robot, t):
                T_map_odom = listed(made.corrected[robot][0] @ inverse(made.odometry[robot][0]))
                say(
                    made, float(t) + 0.1 * int(robot[1]), robot, "correction", term=2, round=k, map_frame=frame,
                    T_map_odom=T_map_odom, frame_changed=changed,
                )  # fmt: skip


def fill_bytes(made: Synthetic) -> None:
    end = max(event["t"] for event in made.events)
    for t in (end / 2, end):
        for robot in WAYPOINTS_M:
            if living(made, robot, t):
                sent = {"heartbeat": int(180 * t), "records": int(5200 * t), "latents": int(41_000 * t)}
                sent |= {"corrections": int(900 * t), "election": 640}
                say(made, t, robot, "bytes", sent=sent, received={kind: int(0.97 * n) for kind, n in sent.items()})


def run_of(made: Synthetic) -> Run:
    return Run(
        scenario="synthetic-hall",
        seed=made.seed,
        robots=list(WAYPOINTS_M),
        start="2026-11-22T16:00:00+00:00",
        driver="launch",
        recordings={robot: f"recordings/{robot}" for robot in WAYPOINTS_M} if made.with_truth else {},
        radio={"loss_ratio": 0.1, "latency_s": 0.05, "range_m": 25.0},
        settings={"core": {"closing": {"match_ratio_threshold": 0.55}, "places": {"similarity_threshold": 0.6}}},
        expectations={"merged_within_s": 60.0, "ate_max_m": 0.5},
        wall_s=121.4,
    )


def result_of(made: Synthetic, robot: str) -> RobotResult:
    odometry, corrected = made.odometry[robot], made.corrected[robot]
    merged = made.merged_s is not None
    T_map_odom = corrected[-1] @ inverse(odometry[-1])
    return RobotResult(
        robot=robot,
        map_frame="map/r1" if merged else f"map/{robot}",
        T_map_odom=listed(T_map_odom),
        keyframes=list(keyframes(odometry, corrected)),
        closures=made.closures,
        logs={other: len(made.odometry[other]) + len(made.closures) // 3 for other in WAYPOINTS_M},
    )


def keyframes(odometry: Float, corrected: Float) -> Iterable[KeyframeResult]:
    """The last keyframe came after the last correction."""
    for i, stamp_s in enumerate(stamps(odometry)):
        last = i == len(odometry) - 1
        yield KeyframeResult(
            index=i,
            stamp_s=float(stamp_s),
            T_odom_body=listed(odometry[i]),
            T_map_body=None if last else listed(corrected[i]),
        )
