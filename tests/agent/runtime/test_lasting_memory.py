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

THREADS = """
import ctypes, threading
from flocc_agent.runtime.freed_memory import have_one_heap
have_one_heap()
glibc = ctypes.CDLL(None)
glibc.malloc.restype = ctypes.c_void_p
turn = threading.Barrier(4)
def work():
    glibc.malloc(50_000)
    turn.wait()
threads = [threading.Thread(target=work) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
glibc.fdopen.restype = ctypes.c_void_p
glibc.malloc_info(0, ctypes.c_void_p(glibc.fdopen(1, b"w")))
glibc.fflush(None)
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
@pytest.mark.parametrize(("environment", "is_one"), [({}, True), ({"MALLOC_ARENA_MAX": "4"}, False)])
def test_threads_of_an_agents_process_share_one_heap_unless_its_user_wants_more(
    environment: dict[str, str], is_one: bool
) -> None:
    command = [sys.executable, "-c", THREADS]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, check=True)
    assert (done.stdout.count(b"<heap nr=") == 1) is is_one


async def test_while_a_task_runs_nobody_holds_what_was_sent_of_it() -> None:
    """Else a round's graph is there thrice for as long as the solver works."""
    argument = os.urandom(4 * MEBIBYTE)
    pools = workers.Workers()

    def was_sent_and_let_go() -> bool:
        held, most = tracemalloc.get_traced_memory()
        return most > 4 * MEBIBYTE > 4 * held

    try:
        await pools.run("optimise", work.add, 1, 1)  # its process is there
        tracemalloc.start()
        running = asyncio.create_task(pools.run("optimise", work.first_after, argument, 60.0))
        await until(was_sent_and_let_go)
        assert not running.done()
    finally:
        tracemalloc.stop()
        await pools.close()
    await running
