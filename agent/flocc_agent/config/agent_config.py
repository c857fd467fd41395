"""AgentConfig: everything that can be turned on an agent, with unit, default and effect. Read from TOML.

Parameters of the core are plain dataclasses in `core/parameters.py`; pydantic checks them here like the rest.
"""

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, PlainSerializer, field_validator, model_validator

from flocc_agent.config.backend import BackendConfig, BackendMode
from flocc_agent.config.emulated_radio import RadioConfig
from flocc_agent.config.network import UNNAMED_SWARM, MetricsConfig, TransportConfig
from flocc_agent.config.perception import PerceptionConfig
from flocc_agent.config.ros2 import Ros2Config
from flocc_agent.config.section import (
    ConfigError,
    Section,
    parsed_change,
    put_value,
    read_json,
    read_toml,
    validated,
)
from flocc_agent.core.parameters import INNER, CoreParameters
from flocc_protocol.ids import checked_name


def written(value: Any) -> Any:
    """Parameters of the core as a file may hold them: without those that are no keys."""
    if not is_dataclass(value):
        return value
    return {f.name: written(getattr(value, f.name)) for f in fields(value) if INNER not in f.metadata}


CoreSection = Annotated[CoreParameters, PlainSerializer(written)]


NO_MAPS = "a map needs a leader that solves: backend.mode = 'distributed' knows no maps"


class KeyframeConfig(Section):
    """Which images become keyframes: the robot moved or turned enough since the last one."""

    distance_m: float = Field(0.5, ge=0)
    """Distance since the last keyframe that calls for a new one; smaller finds more closures and costs more."""
    rotation_rad: float = Field(0.35, ge=0)
    """Rotation since the last keyframe that calls for a new one."""


class SourceConfig(Section):
    """Where keyframes come from when no program feeds the agent."""

    recording: Path | None = None
    """Folder of images, odometry and camera (docs/data-sets.md), played by its stamps, after a restart from the
    last keyframe on; None: the program's own."""
    rate: float = Field(1.0, gt=0)
    """Playback speed relative to the stamps."""
    start_s: float = Field(0.0, ge=0)
    """Pause before the first frame."""


class StoreConfig(Section):
    """What a robot keeps on disk."""

    latent_bytes_max: int = Field(2 * 1024**3, ge=1024 * 1024)
    """Latents kept, bytes; beyond it the oldest go first and can no longer be fetched."""
    record_bytes_max: int = Field(1024**3, ge=1024 * 1024)
    """Records of other robots kept, bytes, and as much for what left memory; more is held in memory only. Own records
    are always written."""


class AgentConfig(Section):
    """One robot's agent."""

    name: Annotated[str, AfterValidator(checked_name)]
    """Name of the robot, unique in its swarm: 1 to 32 of a-z, 0-9, '-' and '_'."""
    swarm: Annotated[str, AfterValidator(checked_name)] = UNNAMED_SWARM
    """Name of the swarm; robots of different swarms ignore each other. Without a name none is found by multicast."""
    compute_class: int = Field(0, ge=0, le=9)
    """0: small robot, 9: server with a GPU; the highest leads and registers for the others."""
    incarnation: int | None = Field(None, ge=0)
    """Number of this robot's life when it has no disk yet; None draws it from the wall clock."""
    seed: int = Field(0, ge=0)
    """Seed of emulated links and synthetic perception; the same for all robots of a swarm."""
    folder: Path | None = None
    """Where the robot's log, latents and events are kept; None keeps them in memory."""
    map: Path | None = None
    """A saved map (docs/maps.md) in which the robot finds itself, and which it serves to others."""
    core: CoreSection = CoreParameters()
    """Neighbours, election, gossip, place recognition, loop closing, rounds."""
    keyframes: KeyframeConfig = KeyframeConfig()
    """Keyframe selection."""
    source: SourceConfig = SourceConfig()
    """A recording to play."""
    ros2: Ros2Config | None = None
    """A ROS 2 robot with rmw_zenoh as source and sink; a table [ros2], even an empty one, turns it on."""
    perception: PerceptionConfig = PerceptionConfig()
    """Descriptors, latents, registration."""
    backend: BackendConfig = BackendConfig()
    """Pose-graph optimisation."""
    transport: TransportConfig = TransportConfig()
    """zenoh sessions."""
    store: StoreConfig = StoreConfig()
    """Bounds of what is kept on disk."""
    radio: RadioConfig = RadioConfig()
    """Emulated links, for tests on one machine."""
    bandwidth_bytes_s: float | None = Field(None, gt=0)
    """What the robot lets itself use of the network: messages always pass and count, latents get the rest."""
    metrics: MetricsConfig = MetricsConfig()
    """Figures for Prometheus."""

    @model_validator(mode="after")
    def _knows_how_to_use_a_map(self) -> "AgentConfig":
        if self.map is not None and self.backend.mode is BackendMode.DISTRIBUTED:
            raise ValueError(NO_MAPS)
        return self

    @field_validator("folder", mode="before")
    @classmethod
    def _is_named(cls, folder: object) -> object:
        if folder == "":
            raise ValueError("a folder needs a name ('.' is the one where the agent is started)")
        return folder

    @model_validator(mode="after")
    def _has_one_source(self) -> "AgentConfig":
        if self.source.recording is not None and self.ros2 is not None and self.ros2.image_topic:
            raise ValueError("images come from source.recording or from ros2.image_topic, not from both")
        return self

    def with_map(self, folder: Path | None) -> "AgentConfig":
        """The same in a map, where one is given here.

        Raises:
            ConfigError: The back end knows no maps.
        """
        changed = self if folder is None else self.model_copy(update={"map": folder})
        if changed.map is not None and changed.backend.mode is BackendMode.DISTRIBUTED:
            raise ConfigError(NO_MAPS)
        return changed

    @classmethod
    def read(cls, path: Path, changes: Iterable[str] = ()) -> "AgentConfig":
        """Read and check a TOML file, or JSON as `flocc launch` leaves it; paths in it are relative to the file.

        Args:
            path: The file.
            changes: Keys with other values, as `name=r2` or `radio.loss_ratio=0.3`.

        Raises:
            ConfigError: The file cannot be used; the message names it and the key.
        """
        fields = read_json(path) if path.suffix == ".json" else read_toml(path)
        for change in changes:
            put_value(fields, *parsed_change(change))
        return validated(cls, fields, str(path), path.resolve().parent)
