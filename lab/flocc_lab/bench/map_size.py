"""What it costs to open a large map, measured in a process of its own.

python -m flocc_lab.bench.map_size 10000 30000 100000
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from flocc_agent.core.saved_map import SavedClosure, SavedMap
from flocc_agent.geometry import pose, pose7, so3_exp
from flocc_agent.runtime.map_folder import MapFrontEnd
from flocc_launch.maps.solving import SolvedMap
from flocc_launch.maps.writing import MapContent, write_map
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import ClosureRecord, KeyframeRecord, encode_record

ROBOTS, DIMENSION = 10, 512
TIMEOUT_S = 3600.0

OPEN = """
import json, sys, time
from pathlib import Path
from flocc_agent.agent import Agent
from flocc_agent.config import StoreConfig
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.map_folder import MapFolder
from flocc_agent.runtime.persistence import restore
from flocc_agent.runtime.store import Store

def held():
    return 1024 * int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1])

store, before, began_s = Store.open(None, "z9", StoreConfig()), held(), time.process_time()
opened = MapFolder.open(Path(sys.argv[1]))
store.open_map(opened)
robot = Robot(store.identity.log, 0, 1, CoreParameters(), 0.0, restore(store, None, opened))
robot.assembly.graph()
found = {
    "keyframes": robot.in_map.saved.keyframes,
    "cpu_s": round(time.process_time() - began_s, 2),
    "mb": round((held() - before) / 1e6),
    "rows": robot.recognition.rows,
}
print(json.dumps(found))
"""


def write_large(out: Path, keyframes: int) -> None:
    """A map of ten logs, with a closure for every second keyframe and descriptors of 512 numbers."""
    rng = np.random.default_rng(1)
    logs: dict[LogId, tuple[bytes, ...]] = {}
    poses, latents = {}, []
    closures: dict[tuple[KeyframeId, KeyframeId], SavedClosure] = {}
    for r in range(ROBOTS):
        log, records, T = LogId(f"r{r}"), [], []
        for k in range(keyframes // ROBOTS):
            at = pose(so3_exp(rng.uniform(-0.5, 0.5, 3)), rng.uniform(0.0, 1000.0, 3))
            descriptor = Array.of(rng.integers(-127, 128, DIMENSION).astype(np.int8), "i1")
            records.append(encode_record(KeyframeRecord(k, float(k), pose7(at), descriptor)))
            if r and k % 2 == 0:
                ends = KeyframeId(log, k), KeyframeId(LogId("r0"), k)
                closures[ends] = SavedClosure(1.0, 0.9)
                records.append(encode_record(ClosureRecord(*ends, pose7(at), 100, 200, 0.5, 1.0)))
            data = f"{log}/{k}".encode()
            latents.append((KeyframeId(log, k), hashlib.sha256(data).digest(), data))
            T.append(at)
        logs[log], poses[log] = tuple(records), np.array(T)
    saved = SavedMap(tuple(sorted(logs)), frozenset(logs), poses, closures)
    nothing = {log: np.full((len(T), 21), np.nan, dtype=np.float32) for log, T in poses.items()}
    write_map(out, MapContent("large", logs, SolvedMap(saved, nothing, {}), MapFrontEnd(), {}, latents))


def measure(keyframes: int) -> dict[str, float]:
    """Write such a map, and open it in a fresh process that has one thread, as a robot's has.

    Returns:
        Its keyframes, the seconds of CPU, the megabytes that the process grew by, and the descriptors it compares with.
    """
    with tempfile.TemporaryDirectory(prefix="flocc-map-") as folder:
        write_large(Path(folder) / "map", keyframes)
        command = [sys.executable, "-c", OPEN, str(Path(folder) / "map")]
        alone = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=True, env=alone)
    found: dict[str, float] = json.loads(done.stdout)
    return found


if __name__ == "__main__":
    for count in sys.argv[1:]:
        sys.stdout.write(json.dumps(measure(int(count))) + "\n")
