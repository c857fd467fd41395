"""Claims on what an agent's process holds beside its core: it does not follow the mission."""

import _sqlite3
import asyncio
import ctypes
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
from tests.agent.runtime import work
from tests.agent.runtime.loopback import until

from flocc_agent.config import StoreConfig
from flocc_agent.runtime import workers
from flocc_agent.runtime.freed_memory import give_back
from flocc_agent.runtime.given_keyframes import GivenKeyframes
from flocc_agent.runtime.store import Store, StoredRecord
from flocc_protocol.ids import LogId

MEBIBYTE = 1024 * 1024
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")

THREAD = """
import os, threading
from flocc_agent.runtime.freed_memory import give_back, have_one_heap
have_one_heap()
page_bytes = os.sysconf("SC_PAGE_SIZE")
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * page_bytes
def work():
    bytearray(24 << 20)  # glibc keeps pieces up to so large, once one was freed
    global began, grown
    began = resident()
    pieces = [bytearray(200_000) for _ in range(100)]
    for piece in pieces:
        piece[::4096] = b"x" * len(piece[::4096])
    grown = resident()
thread = threading.Thread(target=work)
thread.start()
thread.join()
give_back()
print(grown - resident(), grown - began)
"""


def sqlite_bytes() -> int:
    """What SQLite holds in this process."""
    try:
        used = ctypes.CDLL(_sqlite3.__file__).sqlite3_memory_used
    except AttributeError:
        pytest.skip("this Python's SQLite does not tell")
    used.restype = ctypes.c_int64
    return int(used())


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * PAGE_BYTES


def test_a_store_of_many_records_holds_few_pages_of_them(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "r1", StoreConfig())
    before = sqlite_bytes()
    for first in range(0, 16_000, 1000):
        store.put_records([StoredRecord(LogId("r2"), first + k, bytes(250)) for k in range(1000)])
    grown = sqlite_bytes() - before
    store.close()
    assert grown < MEBIBYTE / 2


def test_a_keyframe_that_was_given_costs_a_few_bytes() -> None:
    given = GivenKeyframes()
    tracemalloc.start()
    for k in range(4000):
        given.add(0.5 * k)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 16 * 4000


def test_stamps_may_come_in_any_order() -> None:
    given = GivenKeyframes([3.0, 1.0, 2.0, 2.0])
    assert [given.at("fix", stamp_s) for stamp_s in (1.0, 2.0, 3.0)] == [1, 3, 0]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's account of memory")
def test_what_was_freed_below_something_that_is_held_is_given_back() -> None:
    pieces = [bytearray(2048) for _ in range(20_000)]
    held = pieces[1::64]
    del pieces
    before = resident_bytes()
    give_back()
    assert before - resident_bytes() > 20 * MEBIBYTE
    assert len(held) == 313


async def test_what_a_task_needed_is_given_back_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    given_back: list[int] = []
    monkeypatch.setattr(workers, "GIVE_BACK_S", 0.0)
    monkeypatch.setattr(workers, "give_back", lambda: given_back.append(1))
    pools = workers.Workers()
    try:
        await asyncio.gather(*(pools.run("optimise", work.add, k, 1) for k in range(3)))
        await until(lambda: bool(given_back))
    finally:
        await pools.close()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs glibc")
@pytest.mark.parametrize(("environment", "is_given_back"), [({}, True), ({"MALLOC_ARENA_MAX": "4"}, False)])
def test_what_a_thread_freed_is_given_back_too(environment: dict[str, str], is_given_back: bool) -> None:
    done = subprocess.run([sys.executable, "-c", THREAD], env=os.environ | environment, capture_output=True, check=True)
    given_back, grown = map(int, done.stdout.split())
    assert (given_back > 0.8 * grown) is is_given_back
