"""Robots that come later, under other names, into the map of those before them: found how soon, and how well.

One after the other they are run in the saved map; the last map is held against the truth beside the map that all make
at the same time.

python -m flocc_lab.bench.later_robots ../shared/data/street r1,r2 runs/later perception.method=learned
"""

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import parsed_change
from flocc_agent.core.reports import FoundInMap
from flocc_agent.geometry import between, inverse, pose_from_tq, so3_log
from flocc_agent.runtime.event_lines import of_kind
from flocc_agent.runtime.map_folder import MapFolder
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.maps.gathering import stamps_s
from flocc_launch.maps.map_saving import save_map
from flocc_launch.maps.opening import MapUse
from flocc_launch.maps.solving import NotSolved
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.trajectory_errors import associate, ate_m
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.scenarios.shipped import read_scenario
from flocc_launch.setup.cache import cache_folder
from flocc_launch.simulation.sessions import alone
from flocc_launch.simulation.simulate import simulate

Float = NDArray[np.float64]

NEAR_M, NEAR_DEG = 3.0, 30.0
FOUND_KEYFRAMES_MAX = 20
"""Keyframes from the first one that is near a mapped one to the first correction in the map."""
ERROR_RATIO_MAX = 1.5
CAME_LATER = "-later"
"""Behind a robot's name where it comes into a map."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """One robot in the map of those before it.

    Attributes:
        robot: Of the recording.
        keyframes: That it took.
        near: Number of the first one that is near a mapped one by the truth, None where none is.
        found: Keyframes it had when it was first in the map, None where it never was.
    """

    robot: str
    keyframes: int
    near: int | None
    found: int | None

    @property
    def in_time(self) -> bool:
        """Whether it found itself soon enough; one that is never near need not."""
        if self.near is None:
            return True
        return self.found is not None and self.found - self.near <= FOUND_KEYFRAMES_MAX


@dataclass(frozen=True, slots=True)
class Later:
    """What came of it.

    Attributes:
        arrivals: In their order.
        ate_m: Joint error of the last map, all of its logs aligned to the truth together.
        ate_at_once_m: Of all robots at the same time; None where they do not get one map.
    """

    arrivals: tuple[Arrival, ...]
    ate_m: float | None
    ate_at_once_m: float | None

    def verdict(self) -> dict[str, object]:
        """The figures, and whether they are what is asked for."""
        ratio = None if self.ate_m is None or self.ate_at_once_m is None else self.ate_m / self.ate_at_once_m
        arrivals = [{**asdict(each), "in_time": each.in_time} for each in self.arrivals]
        met = all(each.in_time for each in self.arrivals) and ratio is not None and ratio <= ERROR_RATIO_MAX
        return {**asdict(self), "arrivals": arrivals, "ratio": ratio, "met": met}


def measure(scenario: Scenario, paths: Mapping[str, Path], first: list[str], out: Path, fixed: bool = False) -> Later:
    """Map with the first robots, let the others come one after the other, and do all of it at once as well.

    Args:
        scenario: Perception, keyframes and whatever else is the same for all.
        paths: Recording of each robot.
        first: Those that make the map, together.
        out: Folder of all runs.
        fixed: The map does not move.
    """
    at_once = simulate(_of(scenario, paths), out / "at-once", recordings=paths, cache=_cache())
    begun = {name: paths[name] for name in first}
    simulate(_of(scenario, begun), out / "first", recordings=begun, cache=_cache())
    save_map(out / "first", out / "first" / "map", name=out.name)
    latest, arrivals = out / "first" / "map", []
    for robot in sorted(set(paths) - set(first)):
        run, name = out / robot, robot + CAME_LATER
        only = alone(scenario, name, paths[robot])
        simulate(only, run, recordings={name: paths[robot]}, cache=_cache(), use=MapUse(latest, fixed))
        arrivals.append(arrival(robot, run, MapFolder.open(latest), paths))
        try:
            save_map(run, run / "map", name=out.name)
        except NotSolved:
            continue
        latest = run / "map"
    found = len(MapFolder.open(latest).poses()) == len(paths)
    return Later(tuple(arrivals), map_ate_m(MapFolder.open(latest), paths) if found else None, at_once.ate_joint_m)


def _of(scenario: Scenario, paths: Mapping[str, Path]) -> Scenario:
    """A scenario of these robots and nothing else."""
    one = alone(scenario, *next(iter(paths.items())))
    robots = {name: alone(scenario, name, path).robots[name] for name, path in paths.items()}
    return one.model_copy(update={"robots": robots})


def _cache() -> Path:
    return cache_folder() / "perception"


def arrival(robot: str, run: Path, mapped: MapFolder, paths: Mapping[str, Path]) -> Arrival:
    """How soon a robot was in the map after it could be."""
    loaded = load(RunFolder.open(run))
    track = loaded.tracks[robot + CAME_LATER]
    known = np.concatenate([truth for _, truth in posed(mapped, paths).values()])
    near = [k for k in np.flatnonzero(track.true).tolist() if _is_near(track.T_world_body[k], known)]
    found = [each.fact.keyframes for each in of_kind(loaded.events, FoundInMap)]
    return Arrival(robot, len(track), near[0] if near else None, found[0] if found else None)


def _is_near(T: Float, known: Float) -> bool:
    """Whether a true pose (4, 4) is near one of others (N, 4, 4)."""
    there = known[np.linalg.norm(known[:, :3, 3] - T[:3, 3], axis=1) <= NEAR_M]
    return any(np.rad2deg(np.linalg.norm(so3_log(between(T, other)[:3, :3]))) <= NEAR_DEG for other in there)


def map_ate_m(opened: MapFolder, paths: Mapping[str, Path]) -> float | None:
    """Joint error of a map's logs, aligned to the truth together."""
    pairs = posed(opened, paths).values()
    return ate_m([estimate for estimate, _ in pairs], [truth for _, truth in pairs])


def posed(opened: MapFolder, paths: Mapping[str, Path]) -> dict[str, tuple[Float, Float]]:
    """Body poses in the map and true ones, each (K, 4, 4), of every log's keyframes that have both."""
    found = {}
    mounted = {entry.id: entry.T_body_camera for entry in opened.manifest.logs}
    for log, T_map_camera in opened.poses().items():
        T_body_camera = mounted[log]
        T = T_map_camera if T_body_camera is None else T_map_camera @ inverse(pose_from_tq(np.array(T_body_camera)))
        truth = read_tum(paths[log.robot.removesuffix(CAME_LATER)] / "groundtruth.tum")
        known, true = associate(np.array(stamps_s(opened, log)), truth)
        found[str(log)] = T[known], true
    return found


def main() -> None:
    """Print what `measure` found and whether it is enough, as JSON."""
    parser = argparse.ArgumentParser(prog="flocc_lab.bench.later_robots")
    parser.add_argument("data", help="Scenario, or own data.")
    parser.add_argument("first", help="Robots that make the map, with commas.")
    parser.add_argument("out", type=Path, help="Folder of all runs.")
    parser.add_argument("sets", nargs="*", help="Other values for keys, KEY=VALUE.")
    parser.add_argument("--agents", type=int, help="Robots into which one data set is cut.")
    parser.add_argument("--map-fixed", action="store_true", help="The map does not move.")
    given = parser.parse_args()
    scenario = read_scenario(given.data, dict(map(parsed_change, given.sets)), given.agents)
    result = measure(scenario, recordings(scenario), given.first.split(","), given.out, given.map_fixed)
    sys.stdout.write(json.dumps(result.verdict()) + "\n")


if __name__ == "__main__":
    main()
