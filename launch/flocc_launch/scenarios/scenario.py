"""Scenario files: robots, their data, radio, faults over time and expectations, in one TOML file.

The same file runs under `flocc launch` (processes over zenoh) and `flocc simulate` (virtual time).
"""

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from flocc_agent.config import (
    AgentConfig,
    BackendConfig,
    CoreSection,
    KeyframeConfig,
    PartitionConfig,
    PerceptionConfig,
    RadioConfig,
    Section,
    StoreConfig,
    put_value,
    read_toml,
    validated,
)
from flocc_agent.core.parameters import CoreParameters
from flocc_launch.datasets.drift import DriftKind
from flocc_protocol.ids import checked_name
from flocc_protocol.records import TAG_LENGTH_MAX

RobotName = Annotated[str, AfterValidator(checked_name)]


def checked_route(corners_m: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """Return the corners of a walk, or say why nobody can walk it.

    Raises:
        ValueError: Fewer than two corners, two equal ones in a row, or one that is not finite.
    """
    steps_m = [math.dist(a, b) for a, b in pairwise(corners_m)]
    if not steps_m or not all(0 < step_m < math.inf for step_m in steps_m):
        raise ValueError("a route has at least two corners, each away from the one before")
    return corners_m


Route = Annotated[tuple[tuple[float, float], ...], AfterValidator(checked_route)]


class RobotScenario(Section):
    """One robot of a scenario."""

    recording: Path | None = None
    """Its recording, or a data set or bag to make one of; None takes its part of [world], [dataset] or [tracks]."""
    compute_class: int = Field(0, ge=0, le=9)
    """0: small robot, 9: server with a GPU."""
    start_s: float = Field(0.0, ge=0)
    """When it is switched on, seconds after the start of the run."""
    clock_offset_s: float = Field(0.0, ge=0)
    """How far its clock is ahead (simulate only)."""
    clock_drift_ratio: float = Field(0.0, gt=-0.1, lt=0.1)
    """How much faster its clock runs than the true one (simulate only)."""


class WorldScenario(Section):
    """A generated world (docs/data-sets.md)."""

    robots: int = Field(3, ge=1, le=8)
    """Robots that walk through it."""
    seed: int = Field(7, ge=0)
    """Another seed is another world, other routes and other drift."""


class DatasetScenario(Section):
    """A recorded data set, cut into robots by time; odometry that it lacks is made from ground truth, with drift."""

    source: Path
    """Folder of the data set (7-Scenes, TUM RGB-D, KITTI, EuRoC or plain), or a bag."""
    robots: int = Field(3, ge=1, le=16)
    """Pieces it is cut into."""
    seed: int = Field(7, ge=0)
    """Seed of the odometry drift."""
    drift: DriftKind | None = None
    """What carried the camera, where odometry is made: handheld, wheeled, car or drone; None tells it by the data."""


class TracksScenario(Section):
    """Robots without images, for synthetic perception: closed walks in one area, with seeded odometry drift."""

    robots: int = Field(10, ge=1, le=200)
    """Robots that walk."""
    seed: int = Field(7, ge=0)
    """Seed of the walks and of the drift."""
    area_m: float = Field(40.0, gt=0)
    """Edge of the square area; smaller means more meetings."""
    speed_m_s: float = Field(0.7, gt=0)
    """Walking speed."""
    length_m: float = Field(80.0, gt=0)
    """Length of each walk that is drawn."""
    routes_m: dict[RobotName, Route] = Field(default_factory=dict)
    """Robot to the corners of its walk, `[[x, y], ...]` in metres; a robot without one gets a drawn walk."""

    @model_validator(mode="after")
    def _routes_are_of_its_robots(self) -> Self:
        unknown = set(self.routes_m) - {f"r{i + 1}" for i in range(self.robots)}
        if unknown:
            raise ValueError(f"routes_m names robot '{min(unknown)}', which is not one of r1 to r{self.robots}")
        return self


TagName = Annotated[str, Field(min_length=1, max_length=TAG_LENGTH_MAX)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Origin = tuple[
    Annotated[float, Field(ge=-90, le=90)],
    Annotated[float, Field(ge=-180, le=180)],
    Annotated[float, Field(ge=-1e4, le=5e4)],
]


class SensorsScenario(Section):
    """What robots measure besides odometry and images, drawn of their true poses (docs/measurements.md)."""

    seed: int = Field(7, ge=0)
    """Seed of the noise."""
    tags: dict[TagName, tuple[Coordinate, Coordinate, Coordinate]] = Field(default_factory=dict)
    """Tag to its place in the world, `[x, y, z]` in metres."""
    tag_range_m: float = Field(4.0, gt=0)
    """How far a robot sees a tag, all round."""
    tag_wrong_ratio: float = Field(0.0, ge=0, le=1)
    """Share of the tag sightings that are wrong by metres."""
    robot_range_m: float | None = Field(None, gt=0)
    """How far robots see each other, with their whole pose; None: they do not. All must start at once."""
    bearing_range_m: float | None = Field(None, gt=0)
    """The same for bearing and range alone."""
    fix_robots: tuple[RobotName, ...] = ()
    """Robots with positions in the world (`fix`), one at every frame."""
    gnss_robots: tuple[RobotName, ...] = ()
    """Robots with GNSS (`gnss`), one fix at every frame."""
    gnss_origin: Origin = (48.0, 11.0, 500.0)
    """Latitude and longitude in degrees and height in metres of the world's origin, whose x looks east."""
    start_robots: tuple[RobotName, ...] = ()
    """Robots that know where they start."""
    closure_every_s: float | None = Field(None, gt=0)
    """How often a robot registers itself with where it was that long ago (`closure`)."""
    odometry_every_s: float | None = Field(None, gt=0)
    """How often a robot says how exact its odometry is (`odometry`)."""
    sighting_every_s: float = Field(2.0, gt=0)
    """Least pause between two sightings of one thing by one robot."""
    rotation_sigma_rad: float = Field(0.01, ge=1e-6, le=1)
    """Noise of every rotation and direction."""
    translation_sigma_m: float = Field(0.05, ge=1e-6, le=1e3)
    """Noise of every distance and relative position."""
    position_sigma_m: float = Field(0.3, ge=1e-6, le=1e3)
    """Noise of every fix."""


class Rendezvous(Section):
    """Robots that are in range of each other for a while; without any, everybody always is."""

    robots: tuple[RobotName, ...] = Field(min_length=2)
    """Who meets."""
    from_s: float = Field(ge=0)
    """Begin, seconds after the start of the run."""
    to_s: float = Field(gt=0)
    """End, seconds after the start of the run."""

    @model_validator(mode="after")
    def _ends_after_it_begins(self) -> Self:
        if self.to_s <= self.from_s:
            raise ValueError(f"a rendezvous from {self.from_s:g} s ends at {self.to_s:g} s")
        return self


class FaultKind(StrEnum):
    """What goes wrong, or right again.

    `start` switches dead robots on, `leave` stops them in order; `calm` makes every link perfect but for its range
    and every worker as fast as it was (`calm` and `mute` in simulate only).
    """

    KILL = "kill"
    RESTART = "restart"
    PARTITION = "partition"
    BLACKOUT = "blackout"
    HEAL = "heal"
    LOSS = "loss"
    LATENCY = "latency"
    RANGE = "range"
    SLOW = "slow"
    MUTE = "mute"
    START = "start"
    LEAVE = "leave"
    CALM = "calm"


LinkFault = Literal[
    FaultKind.PARTITION, FaultKind.BLACKOUT, FaultKind.HEAL, FaultKind.LOSS, FaultKind.LATENCY, FaultKind.RANGE
]
"""Faults that concern links; the others concern robots."""


LEADER = "leader"
"""As a robot of a fault: whom most robots follow when it happens, unless a robot bears the name."""


class Fault(Section):
    """One entry of the timeline."""

    at_s: float = Field(ge=0)
    """When, seconds after the start of the run."""
    kind: FaultKind
    """What happens."""
    robots: tuple[RobotName, ...] = ()
    """Whom it concerns: kill, restart, blackout, slow, start, leave; `leader` is whom most robots follow then."""
    groups: tuple[tuple[RobotName, ...], ...] = ()
    """Groups of a partition; robots that no group names are one more group."""
    value: float | None = None
    """Loss ratio, latency in seconds, range in metres, or the factor by which robots are slow; of a kill in simulate:
    effects of the robot's next step that still happen."""
    message: str | None = None
    """Kind of message that a mute swallows, with probability `value` (simulate only)."""
    disk_lost: bool = False
    """A restart comes without the disk, as a new incarnation."""

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        needs_robots = {
            FaultKind.KILL, FaultKind.RESTART, FaultKind.BLACKOUT, FaultKind.SLOW, FaultKind.START, FaultKind.LEAVE
        }  # fmt: skip
        needs_value = {FaultKind.LOSS, FaultKind.LATENCY, FaultKind.RANGE, FaultKind.SLOW, FaultKind.MUTE}
        if self.kind in needs_robots and not self.robots:
            raise ValueError(f"a fault '{self.kind.value}' names its robots")
        if self.kind in needs_value and self.value is None:
            raise ValueError(f"a fault '{self.kind.value}' has a value")
        if self.kind is FaultKind.PARTITION and not self.groups:
            raise ValueError("a partition names its groups")
        if self.kind is FaultKind.MUTE and self.message is None:
            raise ValueError("a mute names the kind of message that it swallows")
        return self

    def names_leader(self, robots: Sequence[str]) -> bool:
        """Whether it concerns whoever leads; a robot of that name is meant where the scenario has one."""
        return LEADER not in robots and LEADER in {name for names in (self.robots, *self.groups) for name in names}

    def with_leader(self, name: str) -> Self:
        """The same fault of a robot that is known to lead."""

        def named(robots: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(dict.fromkeys(name if robot == LEADER else robot for robot in robots))

        return self.model_copy(update={"robots": named(self.robots), "groups": tuple(map(named, self.groups))})


class SimulationScenario(Section):
    """What only virtual time has: workers that are faster or slower than real ones."""

    optimiser: Literal["backend", "quick"] = "backend"
    """backend: the real one; quick: rigid odometry hung onto closures, where only who and when matter."""
    encode_s: float = Field(0.1, gt=0)
    """Mean time to encode an image; drawn between half and one and a half of it."""
    register_s: float = Field(0.25, gt=0)
    """Mean time of a registration."""
    optimise_s: float = Field(0.15, gt=0)
    """Mean time of an optimisation."""


class Expectations(Section):
    """What must come true; a run that misses one ends with exit code 1."""

    merged_within_s: float | None = Field(None, gt=0)
    """All robots share one map frame at the latest this long after the start, and until the end."""
    ate_max_m: float | None = Field(None, gt=0)
    """Joint ATE, one SE(3) alignment for all robots."""
    ate_ratio_max: float | None = Field(None, gt=0)
    """Joint ATE over the odometry's."""
    closures_min: int | None = Field(None, ge=0)
    """Accepted closures between robots."""
    leader_changes_max: int | None = Field(None, ge=0)
    """Changes of the leader, as most robots saw them, after the first."""
    frames_max: int | None = Field(None, ge=1)
    """Map frames at the end."""
    leader: RobotName | None = None
    """Who leads at the end."""
    leader_registered_ratio_min: float | None = Field(None, ge=0, le=1)
    """Share of the accepted closures that the leader of the end registered."""
    deaths_max: int = Field(0, ge=0)
    """Agents that died without a fault of the scenario or an operator's order."""

    def limits(self) -> dict[str, float | str]:
        """What was asked for, by name."""
        return self.model_dump(exclude_none=True)


class Scenario(Section):
    """A whole scenario; exactly one of world, dataset, tracks and robots with recordings gives the data."""

    name: RobotName = "scenario"
    """Name of the scenario."""
    seed: int = Field(1, ge=0)
    """Seed of links, boots and worker answers."""
    duration_s: float | None = Field(None, gt=0)
    """When the run ends; None: when all recordings are played and everything has settled."""
    settle_s: float = Field(8.0, ge=0)
    """How long a run without a duration must be quiet after the last frame before it ends."""
    rate: float = Field(1.0, gt=0)
    """Playback speed of recordings."""
    world: WorldScenario | None = None
    """Data from a generated world."""
    dataset: DatasetScenario | None = None
    """Data from a recorded data set."""
    tracks: TracksScenario | None = None
    """Poses only, for synthetic perception."""
    sensors: SensorsScenario | None = None
    """What else robots measure."""
    robots: dict[RobotName, RobotScenario] = Field(default_factory=dict)
    """Robots by name; those of world, dataset and tracks are r1, r2, ... and may be listed to change them."""
    radio: RadioConfig = RadioConfig()
    """Emulated links."""
    bandwidth_bytes_s: float | None = Field(None, gt=0)
    """What each robot lets itself use of the network; see the agent's."""
    core: CoreSection = CoreParameters()
    """Parameters of all robots' cores."""
    keyframes: KeyframeConfig = KeyframeConfig()
    """Keyframe selection of all robots."""
    perception: PerceptionConfig = PerceptionConfig()
    """Perception of all robots."""
    backend: BackendConfig = BackendConfig()
    """Back end of all robots."""
    store: StoreConfig = StoreConfig()
    """Bounds of all robots' disks."""
    simulation: SimulationScenario = SimulationScenario()
    """Workers on virtual time."""
    rendezvous: tuple[Rendezvous, ...] = ()
    """Who meets when; with it, robots outside of any rendezvous hear nobody."""
    faults: tuple[Fault, ...] = ()
    """What goes wrong, and when."""
    expectations: Expectations = Expectations()
    """What must come true."""

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        sources = [name for name in ("world", "dataset", "tracks") if getattr(self, name) is not None]
        if len(sources) > 1:
            raise ValueError(f"{' and '.join(sources)} exclude each other")
        lacking = [name for name, robot in self.robots.items() if robot.recording is None and robot.compute_class == 0]
        if not sources and (not self.robots or lacking):
            who = f"robot '{lacking[0]}' has no recording" if lacking else "there is no robot"
            raise ValueError(f"{who}; give [world], [dataset], [tracks] or recordings")
        self._names_robots_that_are_there()
        return self

    def _names_robots_that_are_there(self) -> None:
        faults = {robot for fault in self.faults for robots in (fault.robots, *fault.groups) for robot in robots}
        meetings = {robot for meeting in self.rendezvous for robot in meeting.robots}
        leader = {self.expectations.leader} - {None}
        given = self.sensors or SensorsScenario()
        sensing = {*given.fix_robots, *given.gnss_robots, *given.start_robots}
        for what, named in (
            ("a fault", faults),
            ("a rendezvous", meetings),
            ("expectations.leader", leader),
            ("[sensors]", sensing),
        ):
            unknown = named - set(self.names()) - ({LEADER} if named is faults else set())
            if unknown:
                raise ValueError(f"{what} names robot '{min(map(str, unknown))}', which is not in the scenario")

    @model_validator(mode="after")
    def _sees_robots_on_one_clock(self) -> Self:
        given = self.sensors or SensorsScenario()
        sees = given.robot_range_m is not None or given.bearing_range_m is not None
        late = [name for name, robot in self.robots.items() if robot.start_s > 0 and name not in self.servers()]
        if sees and late:
            raise ValueError(f"robots that see each other start at once, but robot '{late[0]}' starts later")
        return self

    @model_validator(mode="after")
    def _has_one_schedule(self) -> Self:
        divides = {FaultKind.PARTITION, FaultKind.HEAL} & {fault.kind for fault in self.faults}
        if self.rendezvous and (divides or self.radio.partitions):
            raise ValueError("a schedule of rendezvous and partitions exclude each other")
        return self

    def settings(self) -> dict[str, object]:
        """Settings worth reading beside a result."""
        return {
            "perception": self.perception.method,
            "similarity_min": self.core.place_recognition.similarity_threshold,
            "match_ratio_min": self.core.loop_closing.match_ratio_threshold,
            "formulation": self.backend.formulation.value,
            "solver": self.backend.solver.value,
            "keyframe_distance_m": self.keyframes.distance_m,
            "rate": self.rate,
        }

    def names(self) -> list[str]:
        """Names of all robots, sorted."""
        return sorted({*self._made(), *self.robots})

    def servers(self) -> list[str]:
        """Robots without a camera, sorted: they take no keyframes and are in no map."""
        return [name for name in self.names() if name not in self._made() and self.robot(name).recording is None]

    def _made(self) -> list[str]:
        """Names of the robots of the world, data set or tracks."""
        source = self.world or self.dataset or self.tracks
        return [f"r{i + 1}" for i in range(source.robots)] if source else []

    def robot(self, name: str) -> RobotScenario:
        """What the scenario says of one robot."""
        return self.robots.get(name, RobotScenario())

    def links(self) -> RadioConfig:
        """The emulated links, with the schedule of rendezvous as partitions."""
        partitions = separations(self.rendezvous, self.names())
        return self.radio.model_copy(update={"partitions": partitions}) if partitions else self.radio

    @classmethod
    def read(cls, path: Path, changes: Mapping[str, object] | None = None) -> "Scenario":
        """Read and check a scenario; paths in it are relative to the file.

        Args:
            path: The TOML file.
            changes: Keys that the command line overrides, as `radio.loss_ratio`.

        Raises:
            ConfigError: The file cannot be used; the message names it and the key.
        """
        return cls.of(read_toml(path), changes or {}, path)

    @classmethod
    def of(cls, fields: dict[str, object], changes: Mapping[str, object], path: Path) -> "Scenario":
        """Check fields that a file, or a folder of data in its place, gave; arguments and errors as of `read`."""
        for key, value in changes.items():
            put_value(fields, key, value)
        return validated(cls, fields, str(path), path.resolve().parent)


def agent_config(scenario: Scenario, name: str, **changes: object) -> AgentConfig:
    """The configuration of one robot of a scenario."""
    return AgentConfig(
        name=name,
        swarm=scenario.name,
        compute_class=scenario.robot(name).compute_class,
        incarnation=changes.pop("incarnation", 0),
        seed=scenario.seed,
        core=scenario.core,
        keyframes=scenario.keyframes,
        perception=scenario.perception,
        backend=scenario.backend,
        radio=scenario.links(),
        store=scenario.store,
        bandwidth_bytes_s=scenario.bandwidth_bytes_s,
        **changes,
    )


def separations(meetings: Sequence[Rendezvous], names: Sequence[str]) -> tuple[PartitionConfig, ...]:
    """The partitions that leave only the rendezvous, one for each time in which nobody comes or goes.

    Args:
        meetings: Who meets when; those that share a robot at one time are one meeting.
        names: All robots.
    """
    if not meetings:
        return ()
    times_s = sorted({0.0, *(time_s for meeting in meetings for time_s in (meeting.from_s, meeting.to_s)), math.inf})
    return tuple(
        PartitionConfig(groups=_groups(meetings, names, from_s), from_s=from_s, to_s=to_s)
        for from_s, to_s in pairwise(times_s)
    )


def _groups(meetings: Sequence[Rendezvous], names: Sequence[str], at_s: float) -> tuple[tuple[str, ...], ...]:
    """Who is together at a time; a robot that meets nobody is a group of its own."""
    groups = [{name} for name in names]
    for meeting in meetings:
        if meeting.from_s <= at_s < meeting.to_s:
            joined = [group for group in groups if group & set(meeting.robots)]
            groups = [group for group in groups if group not in joined] + [set().union(*joined)]
    return tuple(sorted(tuple(sorted(group)) for group in groups))
