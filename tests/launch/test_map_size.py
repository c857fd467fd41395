"""A large map opens quickly, and in little memory."""

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flocc_agent.core.saved_map import SavedClosure, SavedMap
from flocc_agent.geometry import pose, pose7, so3_exp
from flocc_agent.runtime.map_folder import MapFrontEnd
from flocc_launch.maps.solving import SolvedMap
from flocc_launch.maps.writing import MapContent, write_map
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import ClosureRecord, KeyframeRecord, encode_record

KEYFRAMES, ROBOTS, DIMENSION = 10_000, 10, 512
CPU_MAX_S, MEMORY_MAX_BYTES = 2.0, 100e6

OPEN = """
import sys, time
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
print(time.process_time() - began_s, held() - before, robot.in_map.saved.keyframes)
"""


def write_large(out: Path) -> None:
    """A map of ten logs, with a closure for every second keyframe and descriptors of 512 numbers."""
    rng = np.random.default_rng(1)
    logs: dict[LogId, tuple[bytes, ...]] = {}
    poses, latents = {}, []
    closures: dict[tuple[KeyframeId, KeyframeId], SavedClosure] = {}
    for r in range(ROBOTS):
        log, records, T = LogId(f"r{r}"), [], []
        for k in range(KEYFRAMES // ROBOTS):
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


@pytest.mark.slow
def test_ten_thousand_keyframes_open_in_two_seconds_and_100_megabytes(tmp_path: Path) -> None:
    write_large(tmp_path / "map")
    done = subprocess.run(
        [sys.executable, "-c", OPEN, str(tmp_path / "map")], capture_output=True, text=True, check=True
    )
    cpu_s, grown_bytes, keyframes = map(float, done.stdout.split())
    print(f"{cpu_s:.2f} s of CPU, {grown_bytes / 1e6:.0f} MB")
    assert keyframes == KEYFRAMES
    assert cpu_s <= CPU_MAX_S
    assert grown_bytes <= MEMORY_MAX_BYTES
