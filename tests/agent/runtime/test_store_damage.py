"""Claims: a damaged store never keeps a robot from starting, and never gives a record that is not the one put there.

Each trial copies the files of a store that is in use, as a power cut leaves them, and damages one of them. A thousand
of them: `python -m flocc_lab.damaged_stores 1000`.
"""

import shutil
from pathlib import Path

import pytest

from flocc_agent.runtime.store import Store, StoredRecord
from flocc_lab.damaged_stores import (
    CHECKPOINTED,
    CONFIG,
    KINDS,
    OTHERS,
    OWN,
    RECORDS,
    TERM_COUNTER,
    Damage,
    damage,
    three_logs,
    tried,
    tried_many,
    use_store,
)
from flocc_protocol.ids import LogId

R2, R3 = OTHERS

Records_ = dict[LogId, list[bytes]]
TRIALS = [(kind, names, seed) for kind, names in KINDS for seed in range(12)]


@pytest.fixture(scope="module")
def put() -> Records_:
    """What was put: three logs."""
    return three_logs()


@pytest.fixture(scope="module")
def used(tmp_path_factory: pytest.TempPathFactory, put: Records_) -> Path:
    """A store's files while it is in use."""
    return use_store(tmp_path_factory.mktemp("store"), put)


def opened(folder: Path) -> Store:
    return Store.open(folder, "r1", CONFIG, incarnation_after_loss=99)


@pytest.mark.parametrize(("kind", "names", "seed"), TRIALS, ids=lambda each: getattr(each, "__name__", None))
def test_a_damaged_store_starts_and_gives_no_other_record(
    tmp_path: Path, used: Path, put: Records_, kind: Damage, names: tuple[str, ...], seed: int
) -> None:
    folder = tmp_path / "r1"
    damage(folder, used, kind, names, seed)
    assert tried(folder, put).faults == ()


def test_many_stores_are_told_of_as_a_table() -> None:
    table = tried_many(12, 5).splitlines()
    assert [line.split("|")[1].strip() for line in table[2:]] == [kind.__name__ for kind, _ in KINDS]
    assert all(line.endswith("| 0 |") for line in table[2:])


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
