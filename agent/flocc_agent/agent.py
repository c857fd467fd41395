"""`Agent`: one robot's agent, for the robot's own program. What it is made of stands in `composition.py`."""

import asyncio
import logging
import threading
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flocc_agent.composition import Sight, compose, recording_of
from flocc_agent.config import AgentConfig, RadioConfig, Ros2Config
from flocc_agent.core.corrected import Correction
from flocc_agent.core.interfaces import Camera, Image, Perception
from flocc_agent.core.measurements import BadMeasurement, Fix, Measurement, StartPose
from flocc_agent.core.reports import Fact
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import inverse
from flocc_agent.radio import Radio
from flocc_agent.runtime.driver import Driver
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.facts import JourneyEnded
from flocc_agent.runtime.given_keyframes import BadKeyframe as BadKeyframe
from flocc_agent.runtime.keyframes import KeyframeSelector
from flocc_agent.runtime.measurement_file import Stamped
from flocc_agent.runtime.metrics import MetricsServer
from flocc_agent.runtime.network_watch import look_at_network, say_how_others_are_found
from flocc_agent.runtime.new_journeys import began_anew, last_body, last_keyframe
from flocc_agent.runtime.operator_answers import OperatorAnswers
from flocc_agent.runtime.playback import play
from flocc_agent.runtime.pose_limits import MOUNT_MAX_M, PoseGate, pose_fault
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.robot_result import RobotResult, write_result
from flocc_agent.runtime.status import AgentStatus
from flocc_agent.runtime.store import Store
from flocc_agent.runtime.unmeasured_steps import StepWatch
from flocc_agent.runtime.workers import Workers
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId, LogId

if TYPE_CHECKING:
    from flocc_agent.runtime.ros2.adapter import Ros2Adapter

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]


class JourneyError(FloccError):
    """Another journey cannot begin here."""


class NotRunning(FloccError, RuntimeError):
    """The agent was not started, has stopped or failed, or is spoken to from another thread than its own."""


class Agent:
    """One robot's agent, for the robot's own program.

    Example::

        async with Agent(AgentConfig(name="r1"), camera=camera) as agent:
            await agent.add_keyframe(pixels, T_odom_body, stamp_s)      # (H, W, 3) uint8 RGB, (4, 4), seconds
            async for correction in agent.corrections():
                T_map_body = correction.T_map_odom @ T_odom_body
    """

    def __init__(
        self,
        config: AgentConfig,
        camera: Camera | None = None,
        T_body_camera: Float | None = None,
        on_report: Callable[[Reported[Fact]], None] | None = None,
        clock_s: Callable[[], float] | None = None,
        perception: Perception | None = None,
        map_fixed: bool = False,
        new_journey: bool = False,
        ros_args: Sequence[str] = (),
    ) -> None:
        """Prepare an agent; `async with` starts it.

        Args:
            config: Everything that can be turned.
            camera: Intrinsics of the images; None where a recording brings its own.
            T_body_camera: (4, 4) where the camera sits on the body; None is the identity.
            on_report: Takes each fact that the agent tells (`core/reports.py`); must not block. What it raises is
                logged, and the agent goes on.
            clock_s: Seconds since the start of the run; None counts from now.
            perception: What it sees with; None builds what `config.perception` names.
            map_fixed: The map of `config.map` does not move, whatever is measured in it.
            new_journey: The odometry began anew since the last start: write another log, joined to the earlier ones by
                closures.
            ros_args: What ROS 2 is started with: what stands behind `--ros-args` elsewhere.

        Raises:
            BadKeyframe: `T_body_camera` is no pose.
            FloccError: The recording, the store, a checkpoint or the network cannot be used.
        """
        started_s = time.monotonic()
        self.config = config
        self._on_report = _guarded(on_report, config.name)
        self._clock_s = clock_s or (lambda: time.monotonic() - started_s)
        self._perception = perception
        self._map_fixed = map_fixed
        self._new_journey = new_journey
        self._ros_args = tuple(ros_args)
        self._recording = recording_of(config)
        self._camera = self._recording.camera if self._recording else camera
        given = np.eye(4) if T_body_camera is None else _mounting(T_body_camera, config.name)
        self._T_body_camera = self._recording.T_body_camera if self._recording else given
        self._selector = KeyframeSelector(config.keyframes)
        self._gate, self._steps = PoseGate(), StepWatch(pauses_count=False)
        self._kept = True
        self._driver: Driver | None = None
        self._store: Store | None = None
        self._run: asyncio.Task[None] | None = None
        self._playing: asyncio.Task[None] | None = None
        self._looking: asyncio.Task[None] | None = None
        self._ros2: Ros2Adapter | None = None
        self._bridging: asyncio.Task[None] | None = None
        self._radio: Radio | None = None
        self._metrics: MetricsServer | None = None
        self._workers: Workers | None = None
        self._before: Float | None = None
        self._renewal = asyncio.Lock()
        self._entered = False
        self._thread = 0

    @property
    def log(self) -> LogId:
        """The log that this agent writes: its name and incarnation."""
        return self._started.robot.log

    async def __aenter__(self) -> "Agent":
        """Open the store and the network, restore what the disk holds, start the loop and the playback.

        Raises:
            RuntimeError: It runs already.
        """
        if self._entered:
            raise RuntimeError(f"robot {self.config.name}: this agent runs already; one Agent is one robot")
        self._entered, self._thread = True, threading.get_ident()
        try:
            say_how_others_are_found(self.config)
            self._driver = await asyncio.to_thread(self._compose)
            if self.config.metrics.port is not None:
                self._metrics = MetricsServer(self.config.metrics, self.config.name, lambda: self._started.look())
            await self._begin(self._driver)
        except BaseException:
            await self._close()
            raise
        self._looking = asyncio.create_task(
            look_at_network(self.config, lambda: self._started.robot.neighbours.names())
        )
        if self._recording is not None:
            self._playing = asyncio.create_task(self._play(self._recording))
        if self._ros2 is not None:
            self._bridging = asyncio.create_task(self._ros2.run(self._driver.subscribe()))
        return self

    async def __aexit__(self, *_: object) -> None:
        """Hand over, close everything; an error of the loop is raised here."""
        assert self._run is not None
        self.stop()
        for task in (self._playing, self._looking):
            if task is not None:
                task.cancel()
        try:
            await self._run
            fed = [task for task in (self._playing, self._bridging) if task is not None]
            await asyncio.gather(*fed, return_exceptions=True)
        finally:
            await self._close()

    async def _begin(self, driver: Driver) -> None:
        """Open the network, and start the loop."""
        self._run = asyncio.create_task(driver.run())
        await driver.opened(self._run)
        self._before = last_body(driver.robot, self._T_body_camera)

    async def begin_journey(self) -> None:
        """The odometry began anew, because the robot was carried or its odometry started again: write another log.

        The keyframes so far stay the robot's earlier journey, and closures join both. Keyframes that still wait for the
        encoder are lost. `corrections()` goes on, at first in a frame of the new journey's own.

        Raises:
            JourneyError: There is no folder to keep the earlier journey in, or frames do not come from this program.
            NotRunning: The agent has not started, or has ended.
        """
        self._require_running()
        if self.config.folder is None or self._recording is not None or self._ros2 is not None:
            reason = "has no folder (the key 'folder') that keeps what it did so far"
            fed = "is fed by a recording or by ROS 2, which begin journeys themselves"
            raise JourneyError(f"robot {self.config.name}: {reason if self.config.folder is None else fed}")
        async with self._renewal:
            assert self._run is not None
            self._new_journey = True
            self._started.stop()
            await self._run
            assert self._store is not None
            self._store.close()
            self._gate, self._steps = PoseGate(), StepWatch(pauses_count=False)
            self._selector = KeyframeSelector(self.config.keyframes)
            self._driver = await asyncio.to_thread(self._compose)
            await self._begin(self._driver)
        logger.info("robot %s: begins another journey, %s", self.config.name, self.log)

    async def _journey_of(self, T_odom_body: Float) -> None:
        """Begin another journey where the first pose after a start is that of odometry which began meanwhile."""
        if self._began_while_off(np.asarray(T_odom_body, dtype=float)):
            await self.begin_journey()
            self._before = None

    def _began_while_off(self, T_odom_body: Float) -> bool:
        """Whether the first pose (4, 4) after a start is that of odometry which began meanwhile; asked once."""
        before, self._before = self._before, None
        if not began_anew(before, T_odom_body):
            return False
        logger.warning("robot %s: its odometry began anew while it was off", self.config.name)
        return True

    async def add_keyframe(self, pixels: NDArray[np.uint8], T_odom_body: Float, stamp_s: float) -> None:
        """Give the agent a keyframe; waits while too many wait for the encoder.

        Args:
            pixels: (H, W, 3) uint8, RGB, of the size that the camera says.
            T_odom_body: (4, 4) metric odometry of the body at the time of the image.
            stamp_s: Time of the image on the robot's clock, seconds.

        Raises:
            BadKeyframe: The pose is not finite and rigid, over 10000 km from the origin, faster than 1 km/s or not
                newer than the one before; the image does not fit the camera, or there is no camera.
            NotRunning: The agent has not started, or has ended.
        """
        self._check(T_odom_body, stamp_s)
        await self._journey_of(T_odom_body)
        await self._add(pixels, np.asarray(T_odom_body, dtype=float), stamp_s)

    async def add_frame(
        self, pixels: NDArray[np.uint8], T_odom_body: Float, stamp_s: float, keep: bool = False
    ) -> bool:
        """Give the agent any frame; it becomes a keyframe when the robot moved enough, or where `keep` says so.

        Returns:
            Whether it became one; `keep` what something was seen in.

        Raises:
            BadKeyframe: As `add_keyframe`, of every frame.
            NotRunning: The agent has not started, or has ended.
        """
        self._check(T_odom_body, stamp_s)
        await self._journey_of(T_odom_body)
        T_odom_body = np.asarray(T_odom_body, dtype=float)
        if not keep and not self._selector.wants(T_odom_body):
            self._gate.let_in(T_odom_body, stamp_s, kept=False)
            return False
        await self._add(pixels, T_odom_body, stamp_s)
        self._selector.took(T_odom_body)
        return True

    def _check(self, T_odom_body: Float, stamp_s: float) -> None:
        """Refuse a pose that cannot be; what is measured next then belongs to no keyframe."""
        self._require_running()
        self._kept = False
        if self._camera is None:
            raise BadKeyframe(f"robot {self.config.name}: has no camera; give Agent(camera=...)")
        if (fault := self._gate.fault(T_odom_body, stamp_s)) is not None:
            raise BadKeyframe(f"robot {self.config.name}: keyframe at {stamp_s} s: {fault}")
        self._steps.saw(stamp_s, T_odom_body)

    async def _add(self, pixels: NDArray[np.uint8], T_odom_body: Float, stamp_s: float) -> None:
        """Take in a keyframe whose pose can be."""
        assert self._camera is not None
        try:
            image = Image(pixels, self._camera)
            self._gate.let_in(T_odom_body, stamp_s, kept=True)
            await self._started.add_keyframe(image, T_odom_body @ self._T_body_camera, stamp_s)
        except BadKeyframe as error:
            raise BadKeyframe(f"robot {self.config.name}: {error}") from error
        except ValueError as error:
            raise BadKeyframe(f"robot {self.config.name}: keyframe at {stamp_s} s: {error}") from error
        self._kept = True
        if (step := self._steps.of_keyframe(stamp_s)) is not None:
            logger.warning(
                "robot %s: its odometry jumped before %.3f s; loop closures decide where it was",
                self.config.name,
                stamp_s,
            )
            self._started.add_measurement(step.in_camera(self._T_body_camera), stamp_s)

    def add_fix(self, position_m: Float, covariance_m2: Float, stamp_s: float | None = None) -> None:
        """Give the agent an absolute position of the camera: `add_measurement(Fix(position_m, covariance_m2))`.

        Args:
            position_m: (3,) in a local frame such as ENU, within 1e7 m of its origin.
            covariance_m2: (3, 3), positive definite.
            stamp_s: Of its keyframe; None: it belongs to the one that was given last.

        Raises:
            BadMeasurement: It cannot be used, with the reason; the agent goes on without it.
        """
        try:
            self.add_measurement(Fix(np.asarray(position_m), np.asarray(covariance_m2)), stamp_s)
        except BadMeasurement as error:
            raise self._named(error) from error

    def add_measurement(self, measurement: Measurement, stamp_s: float | None = None) -> None:
        """Give the agent what was measured at a keyframe: docs/measurements.md names the kinds.

        Args:
            measurement: One of the classes of `flocc_agent.core.measurements`; it speaks of the robot's body.
            stamp_s: Of the keyframe that it belongs to; None: the frame that was given last.

        Raises:
            BadMeasurement: No keyframe has that stamp, the last frame did not become one, or no log may hold it.
            NotRunning: The agent has not started, or has ended.
        """
        self._require_running()
        if not isinstance(measurement, Measurement):
            raise self._named(BadMeasurement(f"{type(measurement).__name__} is no measurement"))
        try:
            in_camera = measurement.in_camera(self._T_body_camera)
            if stamp_s is None and not self._kept and not isinstance(measurement, StartPose):
                raise BadMeasurement(f"{measurement.kind}: the frame that was given last did not become a keyframe")
            self._started.add_measurement(in_camera, stamp_s)
        except BadMeasurement as error:
            raise self._named(error) from error

    def _named(self, error: BadMeasurement) -> BadMeasurement:
        named = f"robot {self.config.name}: "
        return error if str(error).startswith(named) else BadMeasurement(f"{named}{error}")

    async def corrections(self) -> AsyncIterator[Correction]:
        """Corrections as they come, the last one first; ends when the agent stops."""
        lived: Driver | None = None
        while self._started is not lived:
            lived = self._started
            queue = lived.subscribe()
            try:
                while (correction := await queue.get()) is not None:
                    yield correction
            finally:
                lived.unsubscribe(queue)
            await self._while_journey_begins()

    async def _while_journey_begins(self) -> None:
        """Wait as long as one journey has ended and the next has not begun."""
        async with self._renewal:
            return

    def follow_others(self) -> None:
        """Learn from now on how all robots' earlier poses were corrected (`Correction.others`), not only the last."""
        self._started.robot.corrections.follow_all()

    @property
    def robot(self) -> Robot:
        """The running core, for those who watch: to be read on the event loop's thread only, and never changed."""
        return self._started.robot

    def stop(self) -> None:
        """Ask the agent to hand over and end."""
        if self._driver is not None:
            self._driver.stop()

    async def finished(self) -> None:
        """Wait until the agent stops, by `stop` or by an order.

        Raises:
            FloccError: The recording cannot be played on.
        """
        ended: asyncio.Task[None] | None = None
        while self._run is not None and self._run is not ended:
            ended = self._run
            waiting = {ended, *(task for task in (self._playing, self._bridging) if task is not None)}
            while ended not in (done := (await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED))[0]):
                waiting -= done
                for task in done:
                    task.result()
            await self._while_journey_begins()

    async def fetch_latent(self, keyframe: KeyframeId, deadline_s: float) -> bool:
        """Bring another robot's latent into this one's store, where that robot is in range; whether it came."""
        return await self._started.fetch_latent(keyframe, deadline_s)

    def result(self) -> RobotResult | None:
        """What this robot knows (`result.json`), None before it started."""
        return None if self._driver is None else self._driver.result()

    def set_radio(self, config: RadioConfig) -> None:
        """Change the emulated links from now on."""
        if self._radio is not None:
            self._radio.parameters = config.parameters()

    def set_slowness(self, factor: float) -> None:
        """Make encoding, registration and optimisation take this many times as long, for tests."""
        if self._workers is not None:
            self._workers.slowdown = max(factor, 1.0)

    def status(self) -> AgentStatus:
        """What the agent does now, for tables and dashboards."""
        status = self._started.status()
        playing = self._playing is not None and not self._playing.done()
        failure = None if self._store is None else self._store.failure
        changed = {
            "refused": {**status.refused, **(self._ros2.counters() if self._ros2 is not None else {})},
            "playing": playing,
            "busy": status.busy or playing,
            "disk_failure": None if failure is None else str(failure),
        }
        return status.model_copy(update=changed)

    @property
    def _started(self) -> Driver:
        if self._driver is None:
            raise NotRunning("the agent is not running; use it in 'async with'")
        return self._driver

    def _require_running(self) -> None:
        """Refuse what nobody would take in any more.

        Raises:
            NotRunning: The agent has not started, or has ended; or this is not its loop's thread.
        """
        driver, name = self._started, self.config.name
        if threading.get_ident() != self._thread:
            hint = "use asyncio.run_coroutine_threadsafe, or the loop's call_soon_threadsafe"
            raise NotRunning(f"robot {name}: its agent runs on another thread; {hint}")
        if self._renewal.locked():
            return
        if self._run is not None and self._run.done() and not self._run.cancelled():
            error = self._run.exception()
            if error is not None:
                raise NotRunning(f"robot {name}: its agent has failed: {error}") from error
        if driver.is_stopping:
            raise NotRunning(f"robot {name}: its agent has stopped, and takes nothing more")

    def _compose(self) -> Driver:
        """Make everything that this agent is of, and keep what is reached later."""
        if self.config.ros2 is not None and self._ros2 is None:
            self._ros2 = self._adapter(self.config.ros2)
        answers = OperatorAnswers(
            self.config,
            self._clock_s,
            self._on_report,
            self.status,
            lambda: self._started,
            lambda: self._radio,
            self.set_slowness,
        )
        sight = Sight(
            self._perception,
            self._camera,
            self._T_body_camera,
            None if self._recording is None else self._recording.hidden,
        )
        parts = compose(
            self.config,
            sight,
            self._clock_s,
            self._on_report,
            answers.by_kind(),
            map_fixed=self._map_fixed,
            new_journey=self._new_journey,
        )
        self._store, self._workers, self._radio = parts.store, parts.workers, parts.radio
        return parts.driver

    async def _play(self, recording: Recording) -> None:
        source = self.config.source
        last = last_keyframe(self._started.robot)
        last_stamp_s = None if last is None else last.stamp_s

        async def add(image: Image, T_odom_body: Float, stamp_s: float) -> None:
            await self._started.add_keyframe(image, T_odom_body @ self._T_body_camera, stamp_s)

        def measure(stamped: Stamped, frame_s: float) -> None:
            try:
                measurement = stamped.made(lambda stamp_s: self._started.keyframe_at(stamp_s))
                self._started.add_measurement(measurement.in_camera(self._T_body_camera), frame_s)
            except BadMeasurement as error:
                logger.warning("robot %s: %s; left out", self.config.name, error)

        await play(recording, source, self._selector, add, measure, self._clock_s, self._on_position, last_stamp_s)

    def _adapter(self, config: Ros2Config) -> "Ros2Adapter":
        from flocc_agent.runtime.ros2.adapter import Host, Ros2Adapter
        from flocc_agent.runtime.ros2.markers import known_closures

        def report(fact: Fact) -> None:
            self._on_report(Reported(self._clock_s(), self.config.name, fact))

        host = Host(
            self._add_of_ros,
            lambda T_body_camera: self._started.mount_camera(T_body_camera),
            lambda: self._started.corrected_bodies(),
            lambda measurement, stamp_s: self._started.add_measurement(measurement, stamp_s),
            report,
            self._save_result,
            self._begin_anew,
            lambda: known_closures(self._started.robot, self.config.backend.steepness),
            self._state,
            lambda: self._started.corrected_logs(),
        )
        return Ros2Adapter(config, self.config.name, self._selector, host, self._ros_args)

    async def _add_of_ros(self, image: Image, T_odom_camera: Float, stamp_s: float) -> None:
        """A keyframe of the robot's ROS 2; odometry that began while the agent was off begins another journey."""
        if self._began_while_off(T_odom_camera @ inverse(self._T_body_camera)):
            self._begin_anew()
            return
        await self._started.add_keyframe(image, T_odom_camera, stamp_s)

    def _save_result(self) -> str:
        """Write what the robot knows now, and say where.

        Raises:
            OSError: There is no folder, or its disk does not take it.
        """
        if self.config.folder is None:
            raise FileNotFoundError("the agent has no folder (the key 'folder'), so nothing was written")
        return str(write_result(self.config.folder, self._started.result()).resolve())

    def _state(self) -> tuple[AgentStatus, tuple[str, ...]]:
        """What a robot monitor is told: the status, and what the last own solution warned of."""
        solved = self._started.solved
        return self.status(), () if solved is None else tuple(solved.warnings)

    def _begin_anew(self) -> None:
        """End this journey: who runs the agent starts it again, and it begins another log."""
        assert self._store is not None
        self._store.end_log()
        self._on_report(Reported(self._clock_s(), self.config.name, JourneyEnded()))
        self.stop()

    def _on_position(self, position_m: Float) -> None:
        if self._radio is not None:
            self._radio.update_position(self.config.name, position_m)

    async def _close(self) -> None:
        self._entered = False
        if self._metrics is not None:
            await self._metrics.close()
        if self._store is not None:
            self._store.close()


def _guarded(on_report: Callable[[Reported[Fact]], None] | None, robot: str) -> Callable[[Reported[Fact]], None]:
    """What a program does with facts, whose errors are its own and end no agent."""

    def told(reported: Reported[Fact]) -> None:
        try:
            if on_report is not None:
                on_report(reported)
        except Exception:
            logger.exception("robot %s: on_report failed; the agent goes on", robot)

    return told


def _mounting(T_body_camera: Float, robot: str) -> Float:
    """Where a camera sits, (4, 4).

    Raises:
        BadKeyframe: That is no pose, or over 1 km from the body.
    """
    fault = pose_fault(T_body_camera)
    if fault is None and float(np.linalg.norm(T_body_camera[:3, 3])) > MOUNT_MAX_M:
        fault = f"the camera sits over {MOUNT_MAX_M:g} m from the body"
    if fault is not None:
        raise BadKeyframe(f"robot {robot}: T_body_camera: {fault}")
    return np.asarray(T_body_camera, dtype=float)
