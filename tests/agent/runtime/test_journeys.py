"""Odometry that begins anew is another journey of the same robot, joined to the earlier one by closures."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.agent.runtime.test_agent_api import CONFIG, camera

from flocc_agent import Agent
from flocc_agent.agent import JourneyError
from flocc_agent.core.corrected import Correction
from flocc_agent.core.effects import Report
from flocc_agent.core.in_map import InMap
from flocc_agent.core.reports import Fact, FoundInMap, MapLogWritten
from flocc_agent.core.saved_map import SavedMap
from flocc_agent.geometry import Float, between, pose, so3_exp
from flocc_agent.perception.synthetic import pose_image
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.new_journeys import began_anew
from flocc_launch.maps.map_saving import save_map
from flocc_protocol.ids import LogId

STEP_M = 0.7
WITHIN_S = 60.0


def at(x_m: float, turned_rad: float = 0.0) -> Float:
    return pose(so3_exp(np.array([0.0, 0.0, turned_rad])), np.array([x_m, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("before", "first", "anew"),
    [
        (at(12.0), at(0.0), True),
        (at(12.0), at(0.3), True),
        (at(0.0, 1.5), at(0.0), True),
        (at(12.0), at(12.1), False),
        (at(12.0), at(1.0), False),
        (at(1.0), at(0.0), False),
        (None, at(0.0), False),
    ],
)
def test_odometry_began_anew_where_it_lies_at_its_origin_and_did_not_before(
    before: Float | None, first: Float, anew: bool
) -> None:
    assert began_anew(before, first) is anew


def world(k: int) -> Float:
    """Where the robot truly is at its keyframe k: on a way with a corner, so that closures fix everything."""
    return at(STEP_M * k) if k <= 8 else at(STEP_M * 8, 0.4) @ at(STEP_M * (k - 8))


async def walk(agent: Agent, steps: range, began_at: int, stamp_s: float, life: str) -> None:
    """Give the frames of some steps; odometry begins at the step `began_at`."""
    for n, k in enumerate(steps):
        pixels = pose_image(world(k), f"{life}/{k}").pixels
        await agent.add_frame(pixels, between(world(began_at), world(k)), stamp_s + n)


async def until(agent: Agent, wanted: Callable[[Correction], bool]) -> Correction:
    async def found() -> Correction:
        async for correction in agent.corrections():
            if wanted(correction):
                return correction
        raise AssertionError("the agent stopped")

    return await asyncio.wait_for(found(), WITHIN_S)


async def test_a_call_begins_another_journey_that_closures_join_to_the_first(tmp_path: Path) -> None:
    async with Agent(CONFIG.model_copy(update={"folder": tmp_path, "incarnation": 0}), camera()) as agent:
        first = agent.log
        await walk(agent, range(14), 0, 1.0, "a")
        await until(agent, lambda c: c.map_frame == f"map/{first}" and c.pose_of(13) is not None)
        ended = asyncio.create_task(agent.finished())
        await agent.begin_journey()
        assert agent.log.robot == first.robot
        assert agent.log != first
        await walk(agent, range(3, 13), 3, 1.0, "b")
        joined = await until(agent, lambda c: c.map_frame == f"map/{first}" and len(c.own) >= 10)
        np.testing.assert_allclose(joined.T_map_odom, world(3), atol=0.3)
        assert not ended.done()
        agent.stop()
        await asyncio.wait_for(ended, WITHIN_S)


async def test_odometry_that_starts_at_identity_after_a_restart_is_another_journey(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"folder": tmp_path, "incarnation": 0})
    async with Agent(config, camera()) as agent:
        first = agent.log
        await walk(agent, range(8), 0, 1.0, "a")
        await until(agent, lambda c: len(c.own) == 8)
    async with Agent(config, camera()) as agent:
        await walk(agent, range(8, 10), 0, 100.0, "a")
        assert agent.log == first, "odometry went on"
        await until(agent, lambda c: len(c.own) == 10)
    async with Agent(config, camera()) as agent:
        await walk(agent, range(3, 5), 3, 200.0, "b")
        assert agent.log != first, "odometry began anew"


async def test_a_flag_begins_another_journey(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"folder": tmp_path, "incarnation": 0})
    async with Agent(config, camera(), new_journey=True) as agent:
        first = agent.log
        assert first.incarnation == 0, "nothing was written yet, so nothing has to end"
        await walk(agent, range(3), 0, 1.0, "a")
        await until(agent, lambda c: len(c.own) == 3)
    async with Agent(config, camera(), new_journey=True) as agent:
        assert agent.log != first


async def test_without_a_folder_there_is_nowhere_to_keep_the_earlier_journey() -> None:
    async with Agent(CONFIG, camera()) as agent:
        with pytest.raises(JourneyError, match=r"robot r1: has no folder \(the key 'folder'\)"):
            await agent.begin_journey()


async def test_a_robot_alone_finds_itself_in_an_old_map(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"folder": tmp_path / "r1", "incarnation": 0})
    async with Agent(config, camera()) as agent:
        await walk(agent, range(14), 0, 1.0, "a")
        await until(agent, lambda c: len(c.own) == 14)
    save_map(tmp_path / "r1", tmp_path / "map")
    told: list[Fact] = []

    def hear(event: Reported[Fact]) -> None:
        told.append(event.fact)

    alone = CONFIG.model_copy(update={"name": "a9", "map": tmp_path / "map"})
    async with Agent(alone, camera(), on_report=hear, map_fixed=True) as agent:
        await walk(agent, range(4, 12), 4, 1.0, "c")
        found = await until(agent, lambda c: c.map_frame == "map/r1")
        np.testing.assert_allclose(found.T_map_odom, world(4), atol=0.3)
        assert set(found.others) == {"r1"}
    (fact,) = [each for each in told if isinstance(each, FoundInMap)]
    assert fact.keyframes <= 8


def test_what_a_robot_says_before_it_is_found() -> None:
    saved = SavedMap((LogId("r1"),), frozenset({LogId("r1"), LogId("r2")}), {LogId("r1"): np.eye(4)[None]})
    in_map = InMap(saved, 0.0)
    assert in_map.state({}, 0.1) == "not in map/r1 yet: nothing compared so far"
    assert in_map.state({"r7": 0.9}, 0.1) == "not in map/r1 yet: nothing compared so far"
    assert in_map.state({"r1": 0.01, "r2": 0.052}, 0.1) == (
        "not in map/r1 yet: best similarity 0.052, with r2; 0.1 is needed"
    )
    assert in_map.state({"r2": 0.213}, 0.1) == (
        "not in map/r1 yet: looks like r2 (0.213); waits for closures that agree"
    )
    in_map.found = True
    assert in_map.state({}, 0.1) == "in map/r1"


def test_a_robot_that_writes_a_log_of_the_map_is_named_once() -> None:
    saved = SavedMap((LogId("r1"),), frozenset({LogId("r1")}), {LogId("r1"): np.eye(4)[None]})
    in_map = InMap(saved, 0.0)
    assert in_map.on_heartbeat(LogId("r2")) == []
    assert in_map.on_heartbeat(LogId("r1", 3)) == [], "another journey of that name"
    (told,) = in_map.on_heartbeat(LogId("r1"))
    assert told == Report(MapLogWritten(peer="r1", log=LogId("r1")))
    assert in_map.on_heartbeat(LogId("r1")) == []
