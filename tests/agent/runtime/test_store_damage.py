"""Claims: a damaged store never keeps a robot from starting, and never gives a record that is not the one put there.

Each trial copies the files of a store that is in use, as a power cut leaves them, and damages one of them.
"""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flocc_agent.config import StoreConfig
from flocc_agent.core.effects import Effect, Unicast
from flocc_agent.core.gossip import Gossip
from flocc_agent.core.parameters import CoreParameters, GossipParameters
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.persistence import restore
from flocc_agent.runtime.store import Store, StoredRecord
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import RecordRequest, Records
from flocc_protocol.records import KeyframeRecord, encode_record

OWN, R2, R3 = LogId("r1", 5), LogId("r2", 77), LogId("r3")
RECORDS, CHECKPOINTED = 60, 40
TERM_COUNTER = 12
PAGE_BYTES = 4096
CONFIG = StoreConfig()

Records_ = dict[LogId, list[bytes]]


def encoded(log: LogId, index: int) -> bytes:
    """A keyframe's record, different for each log and number."""
    descriptor = np.random.default_rng([log.incarnation, index]).standard_normal(64).astype(np.float32)
    pose = (float(index), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    return encode_record(KeyframeRecord(index, float(index), pose, Array.of(descriptor, "f4")))


@pytest.fixture(scope="module")
def put() -> Records_:
    """What was put: three logs."""
    return {log: [encoded(log, index) for index in range(RECORDS)] for log in (OWN, R2, R3)}


@pytest.fixture(scope="module")
def used(tmp_path_factory: pytest.TempPathFactory, put: Records_) -> Path:
    """A store's files while it is in use: most of it in the database, the rest in the write-ahead log."""
    folder, copy = tmp_path_factory.mktemp("store"), tmp_path_factory.mktemp("copy")
    store = Store.open(folder, "r1", CONFIG, incarnation=OWN.incarnation)
    for number in range(RECORDS):
        if number == CHECKPOINTED:
            store._records._connections[0].execute("PRAGMA wal_checkpoint(TRUNCATE)")
        for log, records in put.items():
            store.put_record(log, number, records[number])
        store.put_latent(KeyframeId(OWN, number), bytes(2000))
    store.put_term_counter(TERM_COUNTER)
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    store.close()
    return copy


def flip(content: bytearray, draw: random.Random, bits: int) -> None:
    for _ in range(bits):
        content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)


def one_bit(content: bytearray, draw: random.Random) -> None:
    flip(content, draw, 1)


def eight_bits(content: bytearray, draw: random.Random) -> None:
    flip(content, draw, 8)


def bytes_64(content: bytearray, draw: random.Random) -> None:
    at = draw.randrange(len(content) - 64)
    content[at : at + 64] = draw.randbytes(64)


def a_page(content: bytearray, draw: random.Random) -> None:
    at = draw.randrange(len(content) // PAGE_BYTES) * PAGE_BYTES
    content[at : at + PAGE_BYTES] = draw.choice([bytes(PAGE_BYTES), draw.randbytes(PAGE_BYTES)])


def cut(content: bytearray, draw: random.Random) -> None:
    del content[draw.randrange(len(content)) :]


Damage = Callable[[bytearray, random.Random], None]
KINDS: tuple[tuple[Damage, tuple[str, ...]], ...] = (
    (one_bit, ("robot.sqlite", "robot.sqlite-wal", "latents.sqlite-wal")),
    (eight_bits, ("robot.sqlite", "robot.sqlite-wal", "latents.sqlite-wal")),
    (bytes_64, ("robot.sqlite", "robot.sqlite-wal")),
    (a_page, ("robot.sqlite", "robot.sqlite-wal")),
    (cut, ("robot.sqlite-wal",)),
)
TRIALS = [(kind, names, seed) for kind, names in KINDS for seed in range(12)]


def damage(folder: Path, used: Path, kind: Damage, names: tuple[str, ...], seed: int) -> None:
    """Lay a copy of the store into a folder, with one file damaged."""
    shutil.copytree(used, folder)
    (folder / "robot.sqlite-shm").unlink(missing_ok=True)
    draw = random.Random(f"{kind.__name__}-{seed}")
    path = folder / names[seed % len(names)]
    content = bytearray(path.read_bytes())
    kind(content, draw)
    path.write_bytes(content)


def opened(folder: Path) -> Store:
    return Store.open(folder, "r1", CONFIG, incarnation_after_loss=99)


@pytest.mark.parametrize(("kind", "names", "seed"), TRIALS, ids=lambda each: getattr(each, "__name__", None))
def test_a_damaged_store_starts_and_gives_no_other_record(
    tmp_path: Path, used: Path, put: Records_, kind: Damage, names: tuple[str, ...], seed: int
) -> None:
    folder = tmp_path / "r1"
    damage(folder, used, kind, names, seed)
    store = opened(folder)
    restored = restore(store)
    robot = Robot(store.identity.log, 0, 1, CoreParameters(), 0.0, restored)
    assert all(list(records) == put[log][: len(records)] for log, records in restored.records)
    if store.identity.log == OWN:
        assert dict(restored.records)[OWN] == tuple(put[OWN]), "it goes on with a log of which it lost something"
        assert store.term_counter() == TERM_COUNTER
    assert store.identity.log in (OWN, LogId("r1", 99))
    assert fetched_again(robot.gossip, put)
    store.close()


@pytest.mark.parametrize(("kind", "names", "seed"), TRIALS[::5], ids=lambda each: getattr(each, "__name__", None))
def test_damage_is_said_once(
    tmp_path: Path,
    used: Path,
    kind: Damage,
    names: tuple[str, ...],
    seed: int,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder = tmp_path / "r1"
    damage(folder, used, kind, names, seed)
    opened(folder).close()
    said = [message for message in caplog.messages if "is damaged" in message or "went back in time" in message]
    assert len(said) <= 1
    caplog.clear()
    opened(folder).close()
    assert [record.message for record in caplog.records if record.levelname != "INFO"] == []


def fetched_again(gossip: Gossip, put: Records_) -> bool:
    """Whether a robot in range of a peer that holds all has it all after ten seconds."""
    peer = Gossip(LogId("peer"), GossipParameters())
    for log, records in put.items():
        for data in records:
            peer.restore(log, data)
    for second in range(10):
        effects = gossip.on_digests(LogId("peer"), peer.digests(), float(second))
        while request := next((r for r in map(_request, effects) if r is not None), None):
            answers = peer.on_request(LogId("r1"), request)
            effects = []
            for answer in answers:
                assert isinstance(answer, Unicast)
                assert isinstance(answer.message, Records)
                effects += gossip.on_records(LogId("peer"), answer.message, float(second))[1]
    return all(log in gossip.logs and gossip.logs[log].encoded == put[log] for log in put)


def _request(effect: Effect) -> RecordRequest | None:
    is_request = isinstance(effect, Unicast) and isinstance(effect.message, RecordRequest)
    return effect.message if is_request else None  # type: ignore[union-attr, return-value]


def altered_record(folder: Path, log: LogId, number: int, put: Records_) -> None:
    """Bring all into the database, and flip one bit within a record's bytes, as a disk does."""
    opened(folder).close()
    path = folder / "robot.sqlite"
    content = bytearray(path.read_bytes())
    at = content.find(put[log][number])
    assert at > 0
    content[at + 100] ^= 4
    path.write_bytes(content)


def test_an_altered_record_of_another_robot_takes_along_what_follows_and_leaves_the_own_log_whole(
    tmp_path: Path, used: Path, put: Records_, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(used, tmp_path / "r1")
    altered_record(tmp_path / "r1", R2, 7, put)
    store = opened(tmp_path / "r1")
    assert store.identity.log == OWN
    assert store.records(R2) == [StoredRecord(R2, number, put[R2][number]) for number in range(7)]
    assert [record.data for record in store.records(R3)] == put[R3]
    assert (tmp_path / "r1/robot.sqlite.damaged-1").exists()
    assert "a row of records was altered: 'r2~4d 7'" in caplog.text
    assert "127 records are sound and kept, 53 are not" in caplog.text


def test_an_altered_own_record_begins_a_new_log_and_keeps_what_is_sound(
    tmp_path: Path, used: Path, put: Records_
) -> None:
    shutil.copytree(used, tmp_path / "r1")
    altered_record(tmp_path / "r1", OWN, 7, put)
    store = opened(tmp_path / "r1")
    assert store.identity.log == LogId("r1", 99)
    assert [record.data for record in store.records(OWN)] == put[OWN][:7]
    assert store.term_counter() == TERM_COUNTER


def test_a_store_that_went_back_in_time_begins_a_new_log_at_once(
    tmp_path: Path, used: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(used, tmp_path / "r1")
    (tmp_path / "r1/robot.sqlite-wal").unlink()
    store = opened(tmp_path / "r1")
    assert store.identity.log == LogId("r1", 99)
    assert f"holds {CHECKPOINTED} records of r1~5, and held {RECORDS}: it went back in time" in caplog.text
    store.close()
    assert opened(tmp_path / "r1").identity.log == LogId("r1", 99)


def test_a_store_whose_term_went_back_begins_a_new_log(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "old", "r1", CONFIG)
    shutil.copytree(tmp_path / "old", tmp_path / "r1")
    store.put_term_counter(4)
    shutil.copy(tmp_path / "old/intact", tmp_path / "r1/intact")
    store.close()
    assert opened(tmp_path / "r1").identity.log == LogId("r1", 99)


def test_a_damaged_intact_file_is_not_believed(tmp_path: Path, used: Path) -> None:
    shutil.copytree(used, tmp_path / "r1")
    content = bytearray((tmp_path / "r1/intact").read_bytes())
    content[9] += 1
    (tmp_path / "r1/intact").write_bytes(content)
    assert opened(tmp_path / "r1").identity.log == OWN
