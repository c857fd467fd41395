"""Claims: no change of keys or members keeps a robot from starting on its store; what nobody takes is set aside."""

import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest
from tests.protocol.wire_examples import knots

from flocc_agent.config import StoreConfig, TlsConfig
from flocc_agent.core.gossip import Sealer
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.persistence import restore
from flocc_agent.runtime.security import RecordSealer
from flocc_agent.runtime.store import Store
from flocc_agent.runtime.stored_correction import stored
from flocc_launch.setup.credentials import make_keys
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import LogCorrection, encode_correction
from flocc_protocol.records import KeyframeRecord, encode_record

OWN, R2, R4 = LogId("r1", 5), LogId("r2", 77), LogId("r4", 1000)
NEW = LogId("r1", 99)
IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
COUNT = 5


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    return make_keys(tmp_path / "keys", "field", ["r1", "r2", "r4"])


def sealer(folder: Path) -> RecordSealer:
    return RecordSealer.of(TlsConfig(folder=folder))


def record(number: int) -> bytes:
    return encode_record(KeyframeRecord(number, float(number), IDENTITY, None))


def filled(path: Path, folders: dict[str, Path] | None) -> Path:
    """A store of r1 with three robots' logs and a correction by r4, with signatures or without any."""
    store = Store.open(path, "r1", StoreConfig(), incarnation=OWN.incarnation)
    for log in (OWN, R2, R4):
        for number in range(COUNT):
            data = record(number)
            store.put_record(
                log, number, data if folders is None else sealer(folders[log.robot]).seal(log, number, data)
            )
    correction = LogCorrection(OWN, Term(3, R4), 1, R2, IDENTITY, knots(1))
    if folders is not None:
        signature = sealer(folders["r4"]).sign_correction(encode_correction(correction))
        correction = replace(correction, signature=signature)
    store.put_correction("r1", stored(correction))
    store.close()
    return path


def started(path: Path, keys: Sealer | None) -> Robot:
    store = Store.open(path, "r1", StoreConfig(), incarnation_after_loss=NEW.incarnation)
    restored = restore(store, keys)
    robot = Robot(store.identity.log, 0, 1, CoreParameters(), 0.0, restored, keys)
    store.close()
    return robot


def held(robot: Robot) -> dict[LogId, int]:
    return {log: len(copy) for log, copy in robot.gossip.logs.items()}


def test_removing_a_stolen_robot_as_documented_keeps_nobody_from_starting(
    tmp_path: Path, folders: dict[str, Path], caplog: pytest.LogCaptureFixture
) -> None:
    path = filled(tmp_path / "r1", folders)
    members = folders["r1"] / "members.json"
    content = json.loads(members.read_bytes())
    del content["robots"]["r4"]
    members.write_text(json.dumps(content))
    robot = started(path, sealer(folders["r1"]))
    assert held(robot) == {OWN: COUNT, R2: COUNT}
    assert robot.corrections.applied is None
    said = f"{R4}: its 5 records on the disk are set aside: log {R4} is of no member of the swarm"
    assert caplog.messages.count(said) == 1
    caplog.clear()
    assert held(started(path, sealer(folders["r1"]))) == {OWN: COUNT, R2: COUNT}
    assert said not in caplog.messages
    with sqlite3.connect(path / "robot.sqlite") as database:
        assert database.execute("SELECT log, COUNT(*) FROM aside GROUP BY log").fetchall() == [(str(R4), COUNT)]


def test_keys_over_a_store_without_them_begin_a_new_log(tmp_path: Path, folders: dict[str, Path]) -> None:
    path = filled(tmp_path / "r1", None)
    assert held(started(path, sealer(folders["r1"]))) == {NEW: 0}
    again = started(path, sealer(folders["r1"]))
    assert (again.log, held(again)) == (NEW, {NEW: 0})


def test_a_store_with_signatures_opens_without_keys(tmp_path: Path, folders: dict[str, Path]) -> None:
    robot = started(filled(tmp_path / "r1", folders), None)
    assert (robot.log, held(robot)) == (NEW, {NEW: 0})


def test_a_store_with_signatures_opens_with_its_keys(tmp_path: Path, folders: dict[str, Path]) -> None:
    robot = started(filled(tmp_path / "r1", folders), sealer(folders["r1"]))
    assert held(robot) == {OWN: COUNT, R2: COUNT, R4: COUNT}
    assert robot.corrections.applied is not None


def test_a_log_whose_later_records_are_signed_otherwise_is_read_up_to_them(
    tmp_path: Path, folders: dict[str, Path]
) -> None:
    path = filled(tmp_path / "r1", folders)
    store = Store.open(path, "r1", StoreConfig())
    store.put_record(R2, COUNT, record(COUNT))
    store.close()
    assert held(started(path, sealer(folders["r1"])))[R2] == COUNT
