"""What each structure of a leader holds, against the clock of its mission.

    python -m flocc_lab.held --robots 10 --minutes 20 --held 500
    python -m flocc_lab.held --robots 10 --minutes 480 --held 5000 --area-m 2000 --parts 8

Prints a JSON object for each part: seconds of CPU of the whole simulation, kilobytes by attribute of the leader and its
machines, and what of all that has no maximum (`unbounded_kb`), which alone grows for ever. What several attributes
refer to counts at the first; what agents of one process share counts too. The last line says how much more an hour
costs in the second half of the mission: kilobytes, and CPU of its last part against the first of that half.
"""

import argparse
import gc
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from flocc_agent.core.robot import Robot
from flocc_lab.mission import AREA_M, town_swarm

SHARED = (type, ModuleType, FunctionType, BuiltinFunctionType, MethodType, CodeType)
"""What belongs to the program."""
CORE = "flocc_agent.core"
SMALL_KB = 8
UNBOUNDED = ("assembly._closures", "assembly._odometry", "closing._resolved", "gossip.logs", "corrections._whole")
"""What grows with the mission once everything that has a maximum has reached it."""


def held_kb(core: Robot) -> dict[str, int]:
    """Kilobytes by attribute of a core and of its machines, the largest first.

    What helpers of the core and its machines refer to of another machine is that one's.
    """
    found: dict[str, int] = {}
    parts = sorted(vars(core).items(), key=lambda each: (each[0].startswith("_"), each[0]))
    machines = {name for name, one in parts if type(one).__module__.startswith(CORE) and hasattr(one, "__dict__")}
    seen = {id(core), *(id(machine) for name, machine in parts if name in machines)}
    for name, machine in parts:
        if name in machines:
            found |= {f"{name}.{part}": _size(value, seen) for part, value in sorted(vars(machine).items())}
        else:
            found[name] = _size(machine, seen)
    return {name: size // 1024 for name, size in sorted(found.items(), key=lambda each: -each[1])}


def _size(root: object, seen: set[int]) -> int:
    """Bytes of an object and of all it refers to that nobody has counted yet."""
    total, waiting = 0, [root]
    while waiting:
        one = waiting.pop()
        if id(one) in seen or isinstance(one, SHARED):
            continue
        seen.add(id(one))
        total += sys.getsizeof(one)
        waiting += gc.get_referents(one)
        if isinstance(one, np.ndarray) and one.base is not None:
            waiting.append(one.base)
    return total


def looked_at(
    robots: int, minutes: float, held: int, parts: int = 4, area_m: float = AREA_M
) -> Iterator[dict[str, Any]]:
    """Run a mission, and look at its leader so many times."""
    swarm = town_swarm(robots, minutes, held, area_m)
    for part in range(1, parts + 1):
        began_s = time.process_time()
        swarm.run_until(60.0 * minutes * part / parts)
        cpu_s = round(time.process_time() - began_s, 1)
        leader = next(s.core for s in swarm.running() if s.core and s.core.election.leading)
        by_part = held_kb(leader)
        yield {
            "minutes": minutes * part / parts,
            "cpu_s": cpu_s,
            "keyframes": leader.assembly.keyframes,
            "closures": leader.assembly.closures,
            "all_kb": sum(by_part.values()),
            "unbounded_kb": sum(by_part.get(name, 0) for name in UNBOUNDED),
            "kb": {name: kb for name, kb in by_part.items() if kb >= SMALL_KB},
        }


def hourly(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """How much more an hour costs in the second half of a mission."""
    half, last = rows[len(rows) // 2 - 1], rows[-1]
    hours = (last["minutes"] - half["minutes"]) / 60.0
    return {
        "all_kb_per_hour": round((last["all_kb"] - half["all_kb"]) / hours, 1),
        "unbounded_kb_per_hour": round((last["unbounded_kb"] - half["unbounded_kb"]) / hours, 1),
        "cpu_ratio": round(last["cpu_s"] / max(rows[len(rows) // 2]["cpu_s"], 0.1), 3),
    }


def main() -> None:
    """Parse the command line and print what is held."""
    parser = argparse.ArgumentParser(prog="flocc_lab.held")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--held", type=int, default=100)
    parser.add_argument("--parts", type=int, default=4, help="How often the leader is looked at.")
    parser.add_argument("--area-m", type=float, default=AREA_M, help="Side of the town.")
    given = parser.parse_args()
    rows = []
    for row in looked_at(given.robots, given.minutes, given.held, given.parts, given.area_m):
        rows.append(row)
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
    sys.stdout.write(json.dumps(hourly(rows)) + "\n")


if __name__ == "__main__":
    main()
