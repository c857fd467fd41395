"""The composition root: names the concrete perception back-ends, the optimiser and the runtime.

Everything heavy that may not be needed (GTSAM, torch, the chosen perception) is imported where it is used.
"""

import logging
import os
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flocc_agent.backend import build_optimiser, build_stepper
from flocc_agent.config import AgentConfig, BackendMode, ConfigError
from flocc_agent.core.interfaces import Camera, ImageWatch, Perception
from flocc_agent.core.reports import Fact
from flocc_agent.core.robot import Robot
from flocc_agent.perception.backends import build_perception
from flocc_agent.radio import Radio
from flocc_agent.runtime.certificate_faults import check_certificate
from flocc_agent.runtime.driver import Driver
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.jobs import Tools
from flocc_agent.runtime.kept_for_maps import keep_back_end, keep_camera, keep_front_end, keep_map, lens_of
from flocc_agent.runtime.map_folder import MapFolder
from flocc_agent.runtime.page_file import PageFile
from flocc_agent.runtime.persistence import restore
from flocc_agent.runtime.recording import Recording
from flocc_agent.runtime.reporting import Reporter, result_of
from flocc_agent.runtime.robot_result import RobotResult
from flocc_agent.runtime.security import RecordSealer, check_member
from flocc_agent.runtime.store import Store
from flocc_agent.runtime.workers import Workers
from flocc_agent.runtime.zenoh_transport import ZenohTransport
from flocc_protocol.keys import Admin

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sight:
    """What a robot sees with.

    Attributes:
        perception: A program's own; None builds what `config.perception` names.
        camera: Intrinsics of the images; None where frames bring none yet.
        T_body_camera: (4, 4) where the camera sits on the body.
        hidden: Parts of each image that the robot itself hides, as its recording says.
    """

    perception: Perception | None
    camera: Camera | None
    T_body_camera: Float
    hidden: NDArray[np.bool_] | None

    def watch(self, odometry_up: tuple[float, float, float] | None) -> ImageWatch:
        """What looks at this robot's images."""
        from flocc_agent.perception.watch.camera_watch import CameraWatch

        return CameraWatch(self.hidden, odometry_up)


@dataclass(frozen=True, slots=True)
class Parts:
    """What an agent is made of, where it is reached after the start."""

    driver: Driver
    store: Store
    workers: Workers
    radio: Radio


def compose(
    config: AgentConfig,
    sight: Sight,
    clock_s: Callable[[], float],
    on_report: Callable[[Reported[Fact]], None],
    answers: Mapping[Admin, Callable[[bytes], bytes]],
    *,
    map_fixed: bool,
    new_journey: bool,
) -> Parts:
    """Name every concrete class.

    Args:
        config: Everything that can be turned.
        sight: What the robot sees with.
        clock_s: Seconds since the start of the run.
        on_report: Takes each fact that the agent tells.
        answers: What operators ask for, and who answers.
        map_fixed: The map of `config.map` does not move, whatever is measured in it.
        new_journey: The odometry began anew since the last start.

    Raises:
        FloccError: The map, the keys, the store or a checkpoint cannot be used.
    """
    opened = None if config.map is None else MapFolder.open(config.map)
    perception = sight.perception or build_perception(config.perception, config.seed)
    sealer = _sealer(config)  # before a store is begun: by keys of another robot nothing is written
    store = _open_store(config)
    try:
        if new_journey:
            store.begin_journey()
        _keep_for_maps(store, config, sight, perception)
        if opened is not None:
            _use_map(store, opened, config, sight, perception, map_fixed)
        workers = Workers()
        radio = Radio(config.radio.parameters(), np.random.default_rng([config.seed, zlib.crc32(config.name.encode())]))
        core = Robot(
            store.identity.log,
            _compute_class(config, sealer),
            int.from_bytes(os.urandom(6)),
            config.core.under(config.bandwidth_bytes_s),
            clock_s(),
            restore(store, sealer, opened, map_fixed),
            sealer,
            config.backend.mode is BackendMode.DISTRIBUTED,
            None if sealer is None else sealer.compute_classes,
            PageFile(config.folder, config.store.record_bytes_max),
        )
        transport = ZenohTransport(
            config.swarm, config.name, config.transport, radio, clock_s, config.bandwidth_bytes_s
        )
        for asked, answer in answers.items():
            transport.serve_admin(asked, answer)
        tools = Tools(
            perception,
            sight.watch(config.perception.odometry_up),
            build_optimiser(config.backend),
            build_stepper(config.backend),
            workers,
            store,
            transport,
            clock_s,
            sealer=sealer,
        )
    except BaseException:
        store.close()
        raise
    reporter = Reporter(config.name, sight.T_body_camera, config.backend.steepness)
    return Parts(Driver(core, tools, reporter, on_report), store, workers, radio)


def _keep_for_maps(store: Store, config: AgentConfig, sight: Sight, perception: Perception) -> None:
    """Write down what a map that is made of this store will have to say of it."""
    keep_front_end(store, _method(config, sight), config.perception, perception)
    keep_back_end(store, config.backend)
    if sight.camera is not None:
        keep_camera(store, sight.camera, sight.T_body_camera)


def _use_map(
    store: Store, opened: MapFolder, config: AgentConfig, sight: Sight, perception: Perception, map_fixed: bool
) -> None:
    """Serve a map's latents, if this robot's own can be compared with them."""
    opened.check_front_end(_method(config, sight), perception.encoder.model)
    if sight.camera is not None:
        warning = opened.other_lens(lens_of(sight.camera))
        if warning is not None:
            logger.warning("robot %s: %s", config.name, warning)
    store.open_map(opened)
    keep_map(store, opened, map_fixed)


def _method(config: AgentConfig, sight: Sight) -> str | None:
    """What the front end is called; a program's own has no name."""
    return config.perception.method if sight.perception is None else None


def stored_result(config: AgentConfig) -> RobotResult:
    """What a robot knew when it was killed (`result.json`), from its store."""
    recording = recording_of(config)
    T_body_camera = np.eye(4) if recording is None else recording.T_body_camera
    store = _open_store(config)
    try:
        sealer = _sealer(config)
        opened = None if config.map is None else MapFolder.open(config.map)
        restored = restore(store, sealer, opened)
        robot = Robot(store.identity.log, config.compute_class, 0, config.core, 0.0, restored, sealer)
    finally:
        store.close()
    return result_of(robot, T_body_camera)


def _sealer(config: AgentConfig) -> RecordSealer | None:
    """What signs for this robot, once its keys are known to be its own, of its swarm, and whole."""
    tls = config.transport.tls
    if tls is None:
        return None
    sealer = RecordSealer.of(tls, config.name)
    check_member(tls, config.swarm, config.name)
    check_certificate(tls, config.name)
    return sealer


def _compute_class(config: AgentConfig, sealer: RecordSealer | None) -> int:
    """The configured one, but where the swarm's list of members says what this robot has."""
    if sealer is None or sealer.compute_classes is None:
        return config.compute_class
    listed = sealer.compute_classes.get(config.name, 0)
    if listed != config.compute_class:
        logger.warning(
            "compute_class %d of the configuration does not count: the list of members says %d",
            config.compute_class,
            listed,
        )
    return listed


def _open_store(config: AgentConfig) -> Store:
    """The store of a robot; a disk that fails is gone on without, a folder that can never be is a slip.

    Raises:
        ConfigError: The configuration's folder cannot be made.
    """
    if config.folder is not None:
        try:
            config.folder.mkdir(parents=True, exist_ok=True)
        except (FileNotFoundError, FileExistsError, NotADirectoryError, PermissionError) as error:
            raise ConfigError(f"{config.folder}: cannot be made (the key 'folder'): {error.strerror}") from error
        except OSError:
            pass
    return Store.open(
        None if config.folder is None else config.folder / "store",
        config.name,
        config.store,
        incarnation=_drawn_incarnation() if config.incarnation is None else config.incarnation,
        incarnation_after_loss=_drawn_incarnation(),
    )


def recording_of(config: AgentConfig) -> Recording | None:
    """What plays its frames to the agent, where that is configured."""
    path = config.source.recording
    return None if path is None else Recording.open(path)


def _drawn_incarnation() -> int:
    """A number that no earlier life of this robot had: the wall clock, in milliseconds."""
    return time.time_ns() // 1_000_000
