"""Claims: an older store opens with its map frame; a later version's record keeps nobody from starting."""

import asyncio
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from tests.agent.runtime.test_agent_api import ALONE, CONFIG, camera
from tests.protocol.wire_examples import CORRECTIONS

from flocc_agent import Agent
from flocc_agent.config import StoreConfig
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import pose
from flocc_agent.perception.synthetic import pose_image
from flocc_agent.runtime.database import VERSION_MARK, LaterSchema
from flocc_agent.runtime.persistence import restore
from flocc_agent.runtime.record_tables import MIGRATIONS
from flocc_agent.runtime.store import Store
from flocc_agent.runtime.stored_correction import correction_in, stored
from flocc_protocol.codec import to_bytes
from flocc_protocol.ids import LogId, Term
from flocc_protocol.records import UnknownRecord

OLD = Path(__file__).parent / "store_04961b5" / "r2"
OWN = LogId("r2")
FORM_1 = (
    "9b0192a2723100920992a27232000492a2723100c438000000000000f03f000000000000004000000000000000000000"
    "00000000000000000000000000000000000000000000000000000000f03fc0030294a26634920207c438000000000000"
    "0000000000000000803f0000000000000000000000000000803f00000000000000000000803f00000000000000000000"
    "0000cb3ff0000000000000c400"
)
"""A correction as commit d7e3ab6 kept it."""


def old_store(folder: Path) -> Path:
    """The store that commit 04961b5 left: two robots with one map, named after r1."""
    shutil.copytree(OLD, folder / "store")
    (folder / "store" / "intact").touch()
    return folder / "store"


def opened(path: Path) -> Store:
    return Store.open(path, "r2", StoreConfig(), incarnation_after_loss=99)


def test_the_store_of_an_older_version_opens_with_its_log_and_map_frame(tmp_path: Path) -> None:
    store = opened(old_store(tmp_path))
    robot = Robot(store.identity.log, 0, 1, CoreParameters(), 0.0, restore(store))
    store.close()
    assert (store.identity.log, store.identity.boots) == (OWN, 2)
    assert {str(log): len(copy) for log, copy in robot.gossip.logs.items()} == {"r1": 38, "r2": 27}
    applied = robot.corrections.applied
    assert applied is not None
    assert (map_frame(applied.anchor), applied.round) == ("map/r1", 2)
    assert robot.assembly.closures == 29


def test_a_migrated_store_opens_again(tmp_path: Path) -> None:
    path = old_store(tmp_path)
    first, again = (_restored(path) for _ in range(2))
    assert first == again
    assert first[1] is not None


def _restored(path: Path) -> tuple[object, ...]:
    store = opened(path)
    found = restore(store)
    store.close()
    return found.records, found.correction, found.frame_changed


async def test_an_agent_starts_on_the_older_store_and_keeps_its_map_frame(tmp_path: Path) -> None:
    old_store(tmp_path)
    config = CONFIG.model_copy(update={"name": "r2", "folder": tmp_path, "incarnation": 0, "transport": ALONE})
    async with Agent(config, camera()) as agent:
        status = agent.status()
    assert (status.log, status.map_frame, status.keyframes) == ("r2", "map/r1", 12)


async def test_records_of_a_later_version_in_the_own_store_keep_no_agent_from_starting(tmp_path: Path) -> None:
    path = old_store(tmp_path)
    later = [to_bytes([99, {"of": "a later version"}]), to_bytes([1, [12, 22.0, b"a keyframe with", "more", 1, 2]])]
    store = opened(path)
    for number, data in enumerate(later, start=27):
        store.put_record(OWN, number, data)
    store.close()
    config = CONFIG.model_copy(update={"name": "r2", "folder": tmp_path, "incarnation": 0, "transport": ALONE})
    async with Agent(config, camera()) as agent:
        log = agent.robot.gossip.logs[OWN]
        assert agent.log == OWN
        assert log.encoded[27:] == later
        assert [type(record) for record in log.records[27:]] == [UnknownRecord, UnknownRecord]
        assert agent.status().keyframes == 13
        T_odom_camera = pose(np.eye(3), np.array([12.0, 0.0, 0.0]))  # at the origin a new journey would begin
        await agent.add_keyframe(pose_image(T_odom_camera, "r2/12").pixels, T_odom_camera, 30.0)
        async with asyncio.timeout(20.0):
            while len(log) < 30:
                await asyncio.sleep(0.01)
        assert log.records[29].index == 13  # type: ignore[union-attr]


def test_a_store_of_a_later_schema_is_left_alone_and_named(tmp_path: Path) -> None:
    path = old_store(tmp_path)
    opened(path).close()
    with sqlite3.connect(path / "robot.sqlite") as connection:
        connection.execute(f"PRAGMA user_version={len(MIGRATIONS) + 1}")
        connection.execute(f"PRAGMA application_id={VERSION_MARK + len(MIGRATIONS) + 1}")
    connection.close()
    before = (path / "robot.sqlite").read_bytes()
    with pytest.raises(LaterSchema, match=r"robot.sqlite: is of schema 3, a later flocc's"):
        opened(path)
    assert (path / "robot.sqlite").read_bytes() == before


def test_a_correction_of_the_older_store_that_is_damaged_is_forgotten(tmp_path: Path) -> None:
    path = old_store(tmp_path)
    with sqlite3.connect(path / "robot.sqlite") as connection:
        connection.execute("UPDATE corrections SET data = x'94029900'")
    connection.close()
    assert _restored(path)[1] is None


@pytest.mark.parametrize("correction", CORRECTIONS)
def test_a_stored_correction_reads_back(correction: object) -> None:
    assert correction_in(stored(correction)) == correction  # type: ignore[arg-type]


def test_a_correction_of_form_1_keeps_its_number_and_where_the_odom_frame_lies() -> None:
    """It listed poses; without the odometry they say nothing, and the next correction takes its place."""
    correction = correction_in(bytes.fromhex(FORM_1))
    assert correction is not None
    assert correction.version == (LogId("r1"), Term(9, LogId("r2")), 4)
    assert correction.T_map_odom == (1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert correction.knots is not None
    assert correction.knots.keyframes.numpy().tolist() == [5]
    assert not correction.knots.twists.numpy().any()


@pytest.mark.parametrize(
    "data", [b"", b"\x00", to_bytes([3, "a later form"]), to_bytes([2, "a form"]), to_bytes([1, 2, 3]), to_bytes({})]
)
def test_what_is_no_stored_correction_is_none(data: bytes) -> None:
    assert correction_in(data) is None
