"""Claims on the store: what was committed comes back, bounds hold, and no failure of the disk stops the robot."""

import json
import logging
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from flocc_agent.config import StoreConfig
from flocc_agent.core.effects import DropLog, PersistRecord
from flocc_agent.runtime.database import StoreError
from flocc_agent.runtime.persistence import write
from flocc_agent.runtime.store import Store, StoredRecord
from flocc_protocol.ids import KeyframeId, LogId

MEBIBYTE = 1024 * 1024
CONFIG = StoreConfig(latent_bytes_max=2 * MEBIBYTE, record_bytes_max=MEBIBYTE)
OWN, OTHER = LogId("r1"), LogId("r2", 77)


def reopened(store: Store, folder: Path) -> Store:
    store.close()
    return Store.open(folder, "r1", CONFIG, incarnation_after_loss=99)


@pytest.fixture(params=["disk", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    return Store.open(tmp_path / "r1" if request.param == "disk" else None, "r1", CONFIG)


def test_gives_back_what_was_put(store: Store) -> None:
    store.put_record(OWN, 0, b"a")
    store.put_records([StoredRecord(OTHER, 5, b"f"), StoredRecord(OTHER, 3, b"d")])
    store.put_latent(KeyframeId(OWN, 0), b"latent")
    store.put_correction("r1", b"old")
    store.put_correction("r1", b"new")
    store.put_term_counter(12)
    store.put_fact("anchor", b"r1")
    assert store.logs() == [OWN, OTHER]
    assert store.records(OTHER) == [StoredRecord(OTHER, 3, b"d"), StoredRecord(OTHER, 5, b"f")]
    assert store.records(OTHER, first=4) == [StoredRecord(OTHER, 5, b"f")]
    assert store.latent(KeyframeId(OWN, 0)) == b"latent"
    assert store.latent_keyframes() == [KeyframeId(OWN, 0)]
    assert (store.correction("r1"), store.term_counter(), store.fact("anchor")) == (b"new", 12, b"r1")


def test_what_was_never_put_is_none(store: Store) -> None:
    assert store.records(OTHER) == []
    assert store.latent(KeyframeId(OWN, 0)) is None
    assert not store.has_latent(KeyframeId(OWN, 0))
    assert (store.correction("r1"), store.term_counter(), store.fact("anchor")) == (None, 0, None)


def test_of_a_log_that_others_continued_nothing_stands_in_the_way_of_what_they_bring(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "r1", CONFIG)
    store.put_record(OWN, 0, b"mine")
    store.end_log()
    store.put_record(OWN, 1, b"mine, too late")
    store = reopened(store, tmp_path)
    assert (store.identity.log, store.logs()) == (LogId("r1", 99), [])
    store.put_records([StoredRecord(OWN, 0, b"theirs"), StoredRecord(OWN, 1, b"theirs, too")])
    assert [record.data for record in store.records(OWN)] == [b"theirs", b"theirs, too"]


def test_a_record_that_is_there_stays_as_it_is(store: Store) -> None:
    store.put_record(OTHER, 0, b"first")
    store.put_record(OTHER, 0, b"second")
    assert store.records(OTHER) == [StoredRecord(OTHER, 0, b"first")]


def test_the_oldest_latents_give_way_and_the_bound_holds(store: Store) -> None:
    for index in range(10):
        store.put_latent(KeyframeId(OWN, index), bytes([index]) * (MEBIBYTE // 2))
    assert [keyframe.index for keyframe in store.latent_keyframes()] == [6, 7, 8, 9]
    store.put_latent(KeyframeId(OWN, 10), bytes(3 * MEBIBYTE))
    assert not store.has_latent(KeyframeId(OWN, 10))


def test_others_records_stop_at_the_bound_and_own_ones_never_do(store: Store) -> None:
    for number in range(5):
        store.put_record(OTHER, number, bytes(MEBIBYTE // 4))
        store.put_record(OWN, number, bytes(MEBIBYTE // 4))
    assert len(store.records(OTHER)) == 4
    assert len(store.records(OWN)) == 5


def test_of_a_log_that_is_dropped_nothing_stays_and_its_room_is_free_again(store: Store) -> None:
    r2, r3, much = LogId("r2"), LogId("r3"), bytes(MEBIBYTE)
    write(store, [PersistRecord(r2, 0, much), PersistRecord(r3, 0, b"no room")])
    assert store.logs() == [r2]
    write(store, [DropLog(r2)])
    write(store, [PersistRecord(r3, 0, b"room")])
    assert store.logs() == [r3]


def test_comes_back_with_everything_and_the_same_numbering(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "r1", CONFIG, incarnation=5)
    own = store.identity.log
    store.put_record(own, 0, b"mine")
    store.put_latent(KeyframeId(own, 0), b"latent")
    store.put_term_counter(3)
    again = reopened(store, tmp_path)
    assert (again.identity.log, again.identity.boots) == (LogId("r1", 5), 2)
    assert again.records(own) == [StoredRecord(own, 0, b"mine")]
    assert again.latent(KeyframeId(own, 0)) == b"latent"
    assert again.term_counter() == 3
    for index in range(1, 5):
        again.put_latent(KeyframeId(own, index), bytes(MEBIBYTE))
    assert [keyframe.index for keyframe in again.latent_keyframes()] == [3, 4]


def test_refuses_another_robots_store_and_one_in_use(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "r1", CONFIG)
    with pytest.raises(StoreError, match="in use by another process"):
        Store.open(tmp_path, "r1", CONFIG)
    store.close()
    with pytest.raises(StoreError, match="belongs to robot r1, not to r2"):
        Store.open(tmp_path, "r2", CONFIG)
    Store.open(tmp_path, "r1", CONFIG).close()


def overwrite_all(path: Path) -> None:
    path.write_bytes(b"\x00garbage" * 4096)


def overwrite_the_middle(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 6000] = b"\xff" * 6000
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [overwrite_all, overwrite_the_middle])
def test_a_damaged_database_is_kept_aside_and_the_robot_begins_a_new_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: Callable[[Path], None]
) -> None:
    store = Store.open(tmp_path, "r1", CONFIG)
    for number in range(200):
        store.put_record(OWN, number, bytes(500))
    store.put_latent(KeyframeId(OWN, 0), b"latent")
    store.close()
    damage(tmp_path / "robot.sqlite")
    again = Store.open(tmp_path, "r1", CONFIG, incarnation_after_loss=99)
    assert again.identity.log == LogId("r1", 99)
    assert again.failure is None
    assert again.latent(KeyframeId(OWN, 0)) == b"latent"
    assert (tmp_path / "robot.sqlite.damaged-1").exists()
    assert any("is damaged" in message and "robot.sqlite.damaged-1" in message for message in caplog.messages)
    again.put_record(again.identity.log, 0, b"new")
    assert reopened(again, tmp_path).records(LogId("r1", 99)) == [StoredRecord(LogId("r1", 99), 0, b"new")]


def test_a_damaged_latent_is_not_given(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "r1", CONFIG)
    store.put_latent(KeyframeId(OWN, 0), b"latent")
    store.close()
    with sqlite3.connect(tmp_path / "latents.sqlite") as database:
        database.execute("UPDATE latents SET data = ?", (b"altered",))
    assert Store.open(tmp_path, "r1", CONFIG).latent(KeyframeId(OWN, 0)) is None


def fill_disk(store: Store) -> None:
    """Let the files grow no further, as a full disk does."""
    for database in (store._records, store._latents):
        connection = database._connections[0]
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
        connection.execute(f"PRAGMA max_page_count={pages}")


def test_on_a_full_disk_the_robot_goes_on_in_memory_and_says_so_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store.open(tmp_path, "r1", CONFIG)
    store.put_record(OWN, 0, b"on disk")
    store.put_latent(KeyframeId(OWN, 0), b"on disk")
    fill_disk(store)
    with caplog.at_level(logging.ERROR):
        for number in range(1, 100):
            store.put_record(OWN, number, bytes(1000))
            store.put_latent(KeyframeId(OWN, number), bytes(10_000))
    assert store.failure is not None
    assert "goes on in memory" in str(store.failure)
    assert len([message for message in caplog.messages if "robot.sqlite" in message]) == 1
    assert [record.number for record in store.records(OWN)] == list(range(100))
    assert store.latent(KeyframeId(OWN, 0)) == b"on disk"
    assert store.latent(KeyframeId(OWN, 99)) == bytes(10_000)


def test_after_a_full_disk_no_number_is_used_twice(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "r1", CONFIG)
    store.put_record(OWN, 0, b"on disk")
    fill_disk(store)
    for number in range(1, 100):
        store.put_record(OWN, number, bytes(1000))
    again = reopened(store, tmp_path)
    assert again.identity.log == LogId("r1", 99)
    assert again.records(OWN)[0] == StoredRecord(OWN, 0, b"on disk")


def test_a_disk_that_has_room_again_takes_everything_and_the_log_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flocc_agent.runtime.database.RETRY_S", 0.0)
    store = Store.open(tmp_path, "r1", CONFIG)
    store.put_record(OWN, 0, bytes(1000))
    store.put_latent(KeyframeId(OWN, 0), b"on disk")
    fill_disk(store)
    for number in range(1, 50):
        store.put_record(OWN, number, bytes(1000))
        store.put_latent(KeyframeId(OWN, number), bytes(10_000))
    store.put_term_counter(7)
    assert not (tmp_path / "intact").exists()
    for each in (store._records, store._latents):
        each._connections[-1].execute("PRAGMA max_page_count=1000000")
    store.put_record(OWN, 50, bytes(1000))
    store.put_latent(KeyframeId(OWN, 50), bytes(10_000))
    assert store.failure is None
    assert caplog.text.count("robot.sqlite: the disk works again") == 1
    again = reopened(store, tmp_path)
    assert (again.identity.log, again.identity.boots, again.term_counter()) == (OWN, 2, 7)
    assert [record.number for record in again.records(OWN)] == list(range(51))
    assert [keyframe.index for keyframe in again.latent_keyframes()] == list(range(51))
    assert again.latent(KeyframeId(OWN, 49)) == bytes(10_000)


def test_a_folder_that_cannot_be_made_means_memory(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    store = Store.open(tmp_path / "file" / "r1", "r1", CONFIG)
    assert store.failure is not None
    store.put_record(OWN, 0, b"a")
    assert store.records(OWN) == [StoredRecord(OWN, 0, b"a")]


SEEDS = (20261122, 20261123, 20261124, 20261125)
NURSERY = Path(__file__).with_name("store_killing.py")


@pytest.mark.slow
def test_killed_at_any_point_no_published_record_is_lost(tmp_path: Path) -> None:
    """200 processes, each killed with SIGKILL at a random moment, on four folders of real files."""
    nurseries = [
        subprocess.Popen(
            [sys.executable, str(NURSERY), str(tmp_path / str(seed)), "50", str(seed)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for seed in SEEDS
    ]
    told = []
    for nursery in nurseries:
        output, errors = nursery.communicate(timeout=240)
        assert nursery.returncode == 0, errors[-3000:]
        told.append(json.loads(output))
    assert sum(each["kills"] for each in told) == 200
    assert sum(each["published"] for each in told) > 200
    assert sum(each["kills_while_writing"] for each in told) > 50
