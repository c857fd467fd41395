"""What each structure of a leader holds, against the clock of its mission.

    python -m flocc_lab.held --robots 10 --minutes 20 --held 500

Prints a JSON object for each quarter: seconds of CPU of the whole simulation, and kilobytes by attribute of the leader
and its machines. What several attributes refer to counts at the first; what agents of one process share counts too.
"""

import argparse
import gc
import json
import sys
import time
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from flocc_agent.core.robot import Robot
from flocc_lab.mission import town_swarm

SHARED = (type, ModuleType, FunctionType, BuiltinFunctionType, MethodType, CodeType)
"""What belongs to the program."""
CORE = "flocc_agent.core"
SMALL_KB = 8


def held_kb(core: Robot) -> dict[str, int]:
    """Kilobytes by attribute of a core and of its machines, the largest first."""
    found: dict[str, int] = {}
    seen = {id(core)}
    for name, machine in sorted(vars(core).items()):
        if type(machine).__module__.startswith(CORE) and hasattr(machine, "__dict__"):
            seen.add(id(machine))
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


def quarters(robots: int, minutes: float, held: int) -> list[dict[str, Any]]:
    """Run a mission, and look at its leader four times."""
    swarm, rows = town_swarm(robots, minutes, held), []
    for quarter in range(1, 5):
        began_s = time.process_time()
        swarm.run_until(60.0 * minutes * quarter / 4)
        cpu_s = round(time.process_time() - began_s, 1)
        leader = next(s.core for s in swarm.running() if s.core and s.core.election.leading)
        by_part = held_kb(leader)
        rows.append(
            {
                "minutes": minutes * quarter / 4,
                "cpu_s": cpu_s,
                "keyframes": leader.assembly.keyframes,
                "closures": leader.assembly.closures,
                "all_kb": sum(by_part.values()),
                "kb": {name: kb for name, kb in by_part.items() if kb >= SMALL_KB},
            }
        )
    return rows


def main() -> None:
    """Parse the command line and print what is held."""
    parser = argparse.ArgumentParser(prog="flocc_lab.held")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--held", type=int, default=100)
    given = parser.parse_args()
    for row in quarters(given.robots, given.minutes, given.held):
        sys.stdout.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
