"""The Python API: bad keyframes and fixes are refused with one sentence, and the agent goes on."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flocc_agent import Agent, AgentConfig
from flocc_agent.agent import BadKeyframe, NotRunning
from flocc_agent.config import ConfigError, PerceptionConfig, TransportConfig
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.interfaces import Camera, Image, OdometryPair, Perception
from flocc_agent.core.measurements import (
    BadMeasurement,
    Fix,
    Measurement,
    MetricClosure,
    OdometryCovariance,
    RobotBearing,
    StartPose,
    TagSighting,
)
from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.core.reports import EncodingFailed, Fact
from flocc_agent.geometry import Float, pose
from flocc_agent.perception.synthetic import pose_image
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.given_keyframes import GivenKeyframes
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import Digests, Envelope, LogDigest, RecordBatch, Records
from flocc_protocol.records import FixRecord, KeyframeRecord, OdometryCovarianceRecord, PoseFixRecord, encode_record

ALONE = TransportConfig(
    control_listen=("tcp/127.0.0.1:0",), bulk_listen=("tcp/127.0.0.1:0",), multicast=False, gossip=False
)
CONFIG = AgentConfig(name="r1", transport=ALONE, perception=PerceptionConfig(method="synthetic"))


def camera() -> Camera:
    return pose_image(np.eye(4), "r1/0").camera


def bad_poses() -> list[Float]:
    reflection, stretched, endless = np.eye(4), 2.0 * np.eye(4), np.eye(4)
    reflection[0, 0], endless[0, 3], stretched[3, 3] = -1.0, np.nan, 1.0
    return [reflection, stretched, endless, np.eye(3), np.eye(4)[:3], at_m(1e12)]


async def test_what_cannot_be_used_is_refused_and_the_agent_goes_on() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        for T in bad_poses():
            with pytest.raises(BadKeyframe, match="robot r1: keyframe at"):
                await agent.add_keyframe(pixels, T, 1.0)
            with pytest.raises(BadKeyframe, match="robot r1: keyframe at"):
                await agent.add_frame(pixels, T, 1.0)
        with pytest.raises(BadKeyframe, match="its camera says"):
            await agent.add_keyframe(np.zeros((7, 5, 3), np.uint8), np.eye(4), 1.0)
        with pytest.raises(BadMeasurement, match="no position"):
            agent.add_fix(np.array([np.nan, 0.0, 0.0]), np.eye(3))
        with pytest.raises(BadMeasurement, match="not positive definite"):
            agent.add_fix(np.zeros(3), -np.eye(3))
        await agent.add_keyframe(pixels, np.eye(4), 1.0)
        async for correction in agent.corrections():
            assert correction.map_frame == f"map/{agent.log}"
            assert not correction.frame_changed
            break


async def test_what_is_no_number_and_no_picture_is_refused_with_a_sentence() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    wrong: Any
    async with Agent(CONFIG, camera()) as agent:
        for wrong in ("1.0", None, np.datetime64("2026-12-01")):
            with pytest.raises(BadKeyframe, match="its stamp is no number of seconds but"):
                await agent.add_frame(pixels, np.eye(4), wrong)
        for wrong in (None, pixels.tolist()):
            with pytest.raises(BadKeyframe, match="image is no array but"):
                await agent.add_frame(wrong, np.eye(4), 1.0)
        for wrong in (None, {"kind": "fix"}):
            with pytest.raises(BadMeasurement, match=r"robot r1: .* is no measurement"):
                agent.add_measurement(wrong)
    for wrong in ({"width": "64"}, {"distortion": (0.1, 0.2, 0.3)}):
        with pytest.raises(ValueError, match="camera"):
            Camera(**{"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0, **wrong})


async def test_nothing_is_taken_in_before_the_start_and_after_the_end() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    agent = Agent(CONFIG, camera())

    async def refused(why: str) -> None:
        for frame in (agent.add_frame, agent.add_keyframe):
            with pytest.raises(NotRunning, match=why):
                await frame(pixels, at_m(3.0), 3.0)
        with pytest.raises(NotRunning, match=why):
            agent.add_fix(np.zeros(3), np.eye(3))
        with pytest.raises(NotRunning, match=why):
            await agent.begin_journey()

    await refused("use it in 'async with'")
    async with agent:
        await agent.add_frame(pixels, np.eye(4), 1.0)
        async for _ in agent.corrections():
            break
        with pytest.raises(NotRunning, match="runs on another thread"):
            await asyncio.to_thread(lambda: asyncio.run(agent.add_frame(pixels, at_m(3.0), 3.0)))
        agent.stop()
        await refused("has stopped")
        await agent.finished()
        await refused("has stopped")
    await refused("has stopped")
    assert [correction.map_frame async for correction in agent.corrections()] == [f"map/{agent.log}"]


@pytest.mark.parametrize("folder", ["/proc/r1", "file/r1"])
async def test_a_folder_that_can_never_be_is_refused(tmp_path: Path, folder: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=rf"{folder}: cannot be made \(the key 'folder'\)"):
        async with Agent(CONFIG.model_copy(update={"folder": tmp_path / folder}), camera()):
            pass


async def test_one_agent_is_one_robot() -> None:
    async with Agent(CONFIG, camera()) as agent:
        with pytest.raises(RuntimeError, match="robot r1: this agent runs already"):
            await agent.__aenter__()
        assert agent.status().keyframes == 0
    async with agent:  # one that was closed may begin again
        await agent.add_frame(pose_image(np.eye(4), "r1/0").pixels, np.eye(4), 1.0)


async def test_an_error_of_whoever_takes_facts_ends_no_agent(caplog: pytest.LogCaptureFixture) -> None:
    def fails(_: Reported[Fact]) -> None:
        raise KeyError("dashboard")

    async with Agent(CONFIG, camera(), on_report=fails) as agent:
        await agent.add_frame(pose_image(np.eye(4), "r1/0").pixels, np.eye(4), 1.0)
        async for _ in agent.corrections():
            break
    assert "robot r1: on_report failed; the agent goes on" in caplog.text


async def test_an_agent_that_failed_says_so_at_the_next_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError):  # noqa: PT012
        async with Agent(CONFIG, camera()) as agent:
            monkeypatch.setattr(agent.robot, "tick", fails)
            with pytest.raises(ZeroDivisionError):
                await agent.finished()
            with pytest.raises(NotRunning, match="its agent has failed: a bug"):
                await agent.add_frame(pose_image(np.eye(4), "r1/0").pixels, np.eye(4), 1.0)


async def test_the_status_tells_what_the_robot_doubts_of_its_camera() -> None:
    pixels = np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8)
    config = CONFIG.model_copy(update={"perception": PerceptionConfig()})
    async with Agent(config, Camera(160, 120, 130.0, 130.0, 80.0, 60.0)) as agent:
        assert agent.status().camera == ()
        for k in range(3):
            await agent.add_keyframe(pixels, at_m(float(k)), 1.0 + k)
        while not agent.status().camera:
            await asyncio.sleep(0.01)
        assert [(told.doubt, told.amount, told.withheld) for told in agent.status().camera] == [("frozen", 2.0, False)]


async def test_a_robot_whose_disk_is_behind_what_it_published_begins_another_log(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"folder": tmp_path, "incarnation": 0})
    async with Agent(config, camera()) as agent:
        old = agent.log
        lost = KeyframeRecord(0, 1.0, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None)
        copy = RecordBatch(old, 0, 0, (encode_record(lost),))
        assert agent._driver is not None
        agent._driver.put(MessageReceived(Envelope(LogId("r2"), Records((copy,)))))
        while "ended" not in _log_state(agent):
            await asyncio.sleep(0.01)
    async with Agent(config, camera()) as agent:
        assert agent.log.robot == "r1"
        assert agent.log != old


async def test_what_a_digest_claims_ends_no_log(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"folder": tmp_path, "incarnation": 0})
    async with Agent(config, camera()) as agent:
        old = agent.log
        lie = Digests(7, 2, (LogDigest(old, 5, 77), LogDigest(old, 0, 77)), 0, ())
        assert agent._driver is not None
        agent._driver.put(MessageReceived(Envelope(LogId("r2"), lie)))
        await agent.add_keyframe(pose_image(np.eye(4), "r1/0").pixels, np.eye(4), 1.0)
        async for _ in agent.corrections():
            break
        assert _log_state(agent) == "continued"
    async with Agent(config, camera()) as agent:
        assert agent.log == old


def _log_state(agent: Agent) -> str:
    """Whether the robot's log is to be continued after a restart."""
    assert agent.config.folder is not None
    return "continued" if (agent.config.folder / "store" / "intact").exists() else "ended"


async def test_a_frame_becomes_a_keyframe_when_the_robot_moved_enough() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        steps_m = [0.0, 0.1, 0.49, 0.51, 0.6, 1.02]
        took = [await agent.add_frame(pixels, pose(np.eye(3), np.array([x, 0.0, 0.0])), x) for x in steps_m]
    assert took == [True, False, False, True, False, True]


async def test_a_frame_that_is_too_fast_or_not_newer_is_refused_and_the_agent_goes_on() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        assert await agent.add_frame(pixels, at_m(0.0), 10.0)
        for x, stamp_s, said in [(2000.0, 11.0, "faster than"), (1.0, 10.0, "not newer"), (1.0, 9.0, "not newer")]:
            with pytest.raises(BadKeyframe, match=said):
                await agent.add_frame(pixels, at_m(x), stamp_s)
        assert await agent.add_frame(pixels, at_m(1.0), 11.0)
        assert [x for _, _, x in await recorded(agent, 2)] == [0.0, 1.0]


async def test_the_step_of_a_jump_is_left_to_closures_and_said(caplog: pytest.LogCaptureFixture) -> None:
    """Odometry begins anew at the twelfth frame, 12 m away; the keyframe there says that the step was not measured."""
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        for k in range(16):
            x = 0.1 * k if k < 12 else 0.1 * k - 12.0
            await agent.add_frame(pixels, at_m(x), 10.0 + 0.1 * k)
        async with asyncio.timeout(20.0):
            while not (steps := steps_of(agent)):
                await asyncio.sleep(0.01)
    ((index, step),) = steps.items()
    at = [x for kind, k, x in log_of(agent) if (kind, k) == ("keyframe", index)]
    assert at == [pytest.approx(-10.8)]
    assert step.covariance.numpy()[0] == pytest.approx(np.pi**2)
    assert "robot r1: its odometry jumped before 11.200 s" in caplog.text


def steps_of(agent: Agent) -> dict[int, OdometryCovarianceRecord]:
    records = agent.robot.gossip.logs[agent.log].records
    return {record.index: record for record in records if isinstance(record, OdometryCovarianceRecord)}


def test_a_mounting_that_is_no_pose_is_refused() -> None:
    for T_body_camera in (2.0 * np.eye(4), at_m(1e6), np.eye(3)):
        with pytest.raises(BadKeyframe, match="robot r1: T_body_camera"):
            Agent(CONFIG, camera(), T_body_camera)


async def test_an_agent_without_a_camera_says_so() -> None:
    async with Agent(CONFIG) as agent:
        with pytest.raises(BadKeyframe, match="has no camera"):
            await agent.add_keyframe(np.zeros((1, 1, 3), np.uint8), np.eye(4), 0.0)


def at_m(x: float) -> Float:
    return pose(np.eye(3), np.array([x, 0.0, 0.0]))


def log_of(agent: Agent) -> list[tuple[str, int, float]]:
    """The agent's own log: kind of record, keyframe and x."""
    found = []
    for record in agent.robot.gossip.logs[agent.log].records:
        if isinstance(record, KeyframeRecord):
            found.append(("keyframe", record.index, record.T_odom_camera[0]))
        elif isinstance(record, FixRecord):
            found.append(("fix", record.index, float(record.position_m.numpy()[0])))
        elif isinstance(record, PoseFixRecord):
            found.append(("pose", record.index, record.T_world_camera[0]))
    return found


async def recorded(agent: Agent, count: int) -> list[tuple[str, int, float]]:
    async with asyncio.timeout(20.0):
        while len(log_of(agent)) < count:
            await asyncio.sleep(0.01)
    return log_of(agent)


@pytest.mark.parametrize("slowly", [False, True], ids=["without pauses", "each after the other"])
async def test_each_fix_belongs_to_the_keyframe_given_before_it(slowly: bool) -> None:
    """Three keyframes 5 m apart, each followed by its fix: once every fix was 5 m off, and the first was lost."""
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        for k in range(3):
            assert await agent.add_frame(pixels, at_m(5.0 * k), float(k))
            agent.add_fix(np.array([5.0 * k, 0.0, 0.0]), np.eye(3))
            if slowly:
                await recorded(agent, 2 * (k + 1))
        found = await recorded(agent, 6)
    assert found == [(kind, k, 5.0 * k) for k in range(3) for kind in ("keyframe", "fix")]


async def test_a_measurement_names_its_keyframe_by_a_stamp() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        for k in range(3):
            await agent.add_keyframe(pixels, at_m(5.0 * k), 10.0 + k)
        agent.add_fix(np.array([5.0, 0.0, 0.0]), np.eye(3), stamp_s=11.0)
        found = await recorded(agent, 4)
    assert ("fix", 1, 5.0) in found


async def test_a_known_start_may_come_before_the_first_keyframe() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        agent.add_measurement(StartPose(at_m(7.0), 0.01 * np.eye(6)))
        await agent.add_keyframe(pixels, at_m(0.0), 1.0)
        found = await recorded(agent, 2)
    assert found == [("keyframe", 0, 0.0), ("pose", 0, 7.0)]


async def test_what_belongs_to_no_keyframe_is_refused_at_the_call() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    fix = Fix(np.zeros(3), np.eye(3))
    async with Agent(CONFIG, camera()) as agent:
        with pytest.raises(BadMeasurement, match="robot r1: fix: no keyframe was given yet"):
            agent.add_measurement(fix)
        await agent.add_frame(pixels, at_m(0.0), 10.0)
        with pytest.raises(BadMeasurement, match=r"robot r1: fix at 3\.0 s: is older than the map"):
            agent.add_measurement(fix, stamp_s=3.0)
        with pytest.raises(BadMeasurement, match="no keyframe has this stamp"):
            agent.add_measurement(fix, stamp_s=10.5)
        assert not await agent.add_frame(pixels, at_m(0.1), 11.0)
        with pytest.raises(BadMeasurement, match="did not become a keyframe"):
            agent.add_measurement(fix)
        with pytest.raises(BadMeasurement, match="not positive definite"):
            agent.add_measurement(TagSighting("7", np.eye(4), np.zeros((6, 6))))


async def test_a_keyframe_that_no_log_may_hold_is_refused_at_the_call() -> None:
    """Stamps in nanoseconds, and a robot beyond the map: once each ended the agent."""
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        with pytest.raises(BadKeyframe, match=r"robot r1: keyframe at 1\.7e"):
            await agent.add_keyframe(pixels, at_m(0.0), 1.7e18)
        with pytest.raises(BadKeyframe, match="over 10000 km"):
            await agent.add_keyframe(pixels, at_m(1e8), 1.0)
        await agent.add_keyframe(pixels, at_m(0.0), 1.0)
        assert await recorded(agent, 1) == [("keyframe", 0, 0.0)]


async def test_what_was_measured_at_a_refused_frame_is_not_tied_to_the_one_before() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        await agent.add_frame(pixels, at_m(0.0), 1.0)
        for T in bad_poses():
            with pytest.raises(BadKeyframe):
                await agent.add_frame(pixels, T, 2.0)
            with pytest.raises(BadMeasurement, match="did not become a keyframe"):
                agent.add_fix(np.zeros(3), np.eye(3))


async def test_what_is_measured_after_a_restart_is_not_tied_to_the_life_before(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"folder": tmp_path, "incarnation": 0})
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(config, camera()) as agent:
        await agent.add_keyframe(pixels, at_m(0.0), 1.0)
        await recorded(agent, 1)
    async with Agent(config, camera()) as agent:
        assert log_of(agent) == [("keyframe", 0, 0.0)]
        with pytest.raises(BadMeasurement, match="no keyframe was given yet"):
            agent.add_fix(np.zeros(3), np.eye(3))
        agent.add_fix(np.array([7.0, 0.0, 0.0]), np.eye(3), stamp_s=1.0)
        assert await recorded(agent, 2) == [("keyframe", 0, 0.0), ("fix", 0, 7.0)]


def test_of_two_keyframes_with_one_stamp_the_newer_is_named() -> None:
    assert GivenKeyframes([1.0, 5.0, 5.0]).at("fix", 5.0) == 2


async def test_a_stamp_names_the_nearest_keyframe() -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera()) as agent:
        for k, stamp_s in enumerate((1.0, 1.0004, 1.0008, 1.0012, 5.0)):
            await agent.add_keyframe(pixels, at_m(0.1 * k), stamp_s)
        agent.add_fix(np.array([3.0, 0.0, 0.0]), np.eye(3), stamp_s=1.0012)
        agent.add_fix(np.array([5.0, 0.0, 0.0]), np.eye(3), stamp_s=5.0)
        found = await recorded(agent, 7)
    assert [entry for entry in found if entry[0] == "fix"] == [("fix", 3, 3.0), ("fix", 4, 5.0)]


@pytest.mark.parametrize(
    ("made", "complaint"),
    [
        (lambda log: MetricClosure(KeyframeId(log, 0), np.eye(4), np.eye(6)), "cannot be registered with itself"),
        (lambda log: OdometryCovariance(np.eye(6)), "no edge before it"),
        (lambda log: RobotBearing(log.robot, np.array([1.0, 0.0, 0.0]), 1.0, 0.1, 0.1), "does not see itself"),
        (lambda log: StartPose(at_m(9_999_999.0), np.eye(6)), "beyond 1e"),
    ],
)
async def test_what_no_log_may_hold_is_refused_at_the_call(
    made: Callable[[LogId], Measurement], complaint: str
) -> None:
    pixels = pose_image(np.eye(4), "r1/0").pixels
    async with Agent(CONFIG, camera(), T_body_camera=at_m(5.0)) as agent:
        await agent.add_keyframe(pixels, at_m(0.0), 1.0)
        with pytest.raises(BadMeasurement, match=f"robot r1: .*{complaint}"):
            agent.add_measurement(made(agent.log))


class Careless:
    """A front end of somebody else, with one mistake."""

    dimension = 8
    model = "careless"

    def __init__(self, descriptor: object, latent: object) -> None:
        self._descriptor = descriptor
        self._latent = latent

    def describe(self, image: Image) -> Any:
        return self._descriptor

    def encode(self, image: Image) -> Any:
        return self._latent

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Any:
        return None


UNIT = np.eye(8)[0]


@pytest.mark.parametrize(
    ("descriptor", "latent"),
    [
        (np.ones((2, 4)), b""),
        (np.ones(0), b""),
        (np.float32(1.0), b""),
        (np.ones(5000), b""),
        (np.full(8, np.nan), b""),
        ("grey", b""),
        (None, b""),
        (UNIT, None),
        (UNIT, "grey"),
        (UNIT, np.ones(3)),
    ],
    ids=range(10),
)
async def test_what_a_strangers_front_end_gives_wrongly_fails_the_keyframe_alone(
    descriptor: object, latent: object
) -> None:
    """Once each of these ended the agent, or put into its store what nobody can read."""
    eyes = Careless(descriptor, latent)
    told: list[Reported[Fact]] = []
    perception = Perception(eyes, eyes, eyes)
    async with Agent(CONFIG, camera(), perception=perception, on_report=told.append) as agent:
        await agent.add_keyframe(pose_image(np.eye(4), "r1/0").pixels, at_m(0.0), 1.0)
        assert await recorded(agent, 1) == [("keyframe", 0, 0.0)]
    assert [reported.fact.keyframe.index for reported in told if isinstance(reported.fact, EncodingFailed)] == [0]


def test_what_a_strangers_registrar_gives_wrongly_is_refused_where_it_is_made() -> None:
    eyes = Careless(UNIT, b"")
    with pytest.raises(TypeError, match="not NoneType"):
        Perception(eyes, eyes, eyes).register(b"", b"", None)
    for made in (
        lambda: Registration(np.eye(3), 100, 100, 1.0),
        lambda: Registration(np.eye(4).tolist(), 100, 100, 1.0),  # type: ignore[arg-type]
        lambda: Registration(np.eye(4, dtype=object), 100, 100, 1.0),
        lambda: Registration(np.eye(4), -1, 100, 1.0),
        lambda: Registration(np.eye(4), 10**12, 100, 1.0),
        lambda: Registration(np.eye(4), 1.5, 100, 1.0),  # type: ignore[arg-type]
        lambda: Registration(np.eye(4), 100, 100, 1.0, np.eye(3)),
        lambda: Registration(np.eye(4), 100, 100, "far"),  # type: ignore[arg-type]
        lambda: RegistrationFailed("dark"),  # type: ignore[arg-type]
        lambda: RegistrationFailed(RegistrationFailure.NO_MODEL, "", -1),
    ):
        with pytest.raises(ValueError, match=r"registration|counts|RegistrationFailure"):
            made()
