"""AgentConfig: everything that can be turned on an agent, with unit, default and effect. Read from TOML.

Parameters of the core are plain dataclasses in `core/parameters.py`; pydantic checks them here like the rest.
"""

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from flocc_agent.core.parameters import CoreParameters
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import NAME_PATTERN, checked_name

if TYPE_CHECKING:
    from flocc_agent.radio import LinkParameters, RadioParameters


class ConfigError(FloccError):
    """A configuration that cannot be used; the message names the file and the key."""


class Section(BaseModel):
    """Base of all sections: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, ser_json_inf_nan="constants")

    @field_validator("*", mode="after")
    @classmethod
    def _is_relative_to_its_file(cls, value: object, info: ValidationInfo) -> object:
        """Paths that a file names are relative to that file."""
        folder = (info.context or {}).get("folder")
        return folder / value if folder is not None and isinstance(value, Path) else value


class Formulation(StrEnum):
    """Which unknowns the loop closures' scales are (Sec. III-C)."""

    BASE = "base"
    INDEPENDENT = "independent"
    SMOOTHED = "smoothed"
    SHARED = "shared"


class Solver(StrEnum):
    """How the nonlinear least-squares problem is solved."""

    LM = "lm"
    GNC_TLS = "gnc-tls"
    GNC_GM = "gnc-gm"
    HUBER = "huber"
    CAUCHY = "cauchy"


class ScaleInitial(StrEnum):
    """Where a closure's first scale comes from."""

    RAW = "raw"
    ODOMETRY = "odometry"
    GROUND_TRUTH = "ground-truth"


class BackendMode(StrEnum):
    """Who optimises."""

    CENTRALISED = "centralised"
    DISTRIBUTED = "distributed"


class BackendConfig(Section):
    """The pose-graph optimiser."""

    mode: BackendMode = BackendMode.CENTRALISED
    """centralised: the elected leader optimises everything; distributed: every robot its own block (RBCD), with scales
    held at their initial values. All robots of a swarm need the same."""
    rank: int = Field(5, ge=3, le=5)
    """Dimensions to which distributed mode relaxes rotations; 3 relaxes nothing, more leave fewer local minima."""
    formulation: Formulation = Formulation.INDEPENDENT
    """Scales of closures: fixed, one each, one each but linked within a cluster, or one for all."""
    solver: Solver = Solver.GNC_TLS
    """lm is fastest and trusts every closure; gnc-* find and reject outliers."""
    pairwise_consistency: bool = False
    """Filter closures by pairwise consistency maximisation before solving; needs odometry covariances that are true."""
    closures_to_join_min: int = Field(2, ge=1)
    """Maps with fewer agreeing closures between them stay apart: a single wrong one would contradict nothing."""
    scale_initial: ScaleInitial = ScaleInitial.ODOMETRY
    """raw: network units are metres; odometry: Eq. (6); ground-truth: for ablations only."""
    steepness: float = Field(4.0, gt=0)
    """k of the logistic Eq. (2); larger trusts high match ratios more."""
    odometry_rotation_sigma_rad: float = Field(0.01, gt=0)
    """Standard deviation of one odometry edge's rotation where the source gives no covariance."""
    odometry_translation_sigma_m: float = Field(0.05, gt=0)
    """Standard deviation of one odometry edge's translation where the source gives no covariance."""
    closure_rotation_sigma_rad: float = Field(0.05, gt=0)
    """Standard deviation of a closure's rotation at probability one."""
    closure_translation_sigma_m: float = Field(0.2, gt=0)
    """Standard deviation of a closure's translation at probability one, metres."""
    cluster_keyframes_max: int = Field(10, ge=1)
    """Closures whose keyframes are fewer than this apart on both sides share a scale cluster."""
    scale_link_sigma_ratio: float = Field(0.2, gt=0)
    """Standard deviation of a scale around its cluster's scale, both relative to their initial values by Eq. (6)."""
    scale_link_unknown_sigma_ratio: float = Field(3.0, gt=0)
    """The same where no initial scale makes the closures' network units comparable."""
    scale_prior_sigma_ratio: float = Field(0.5, gt=0)
    """Prior on a scale that Eq. (6) initialises: standard deviation relative to its initial value. Robots that met at
    one place only are placed by it; much smaller rejects closures whose scale is far from its initial value."""
    scale_prior_unknown_sigma_ratio: float = Field(20.0, gt=0)
    """The same for closures without an initial scale, around one metre per network unit."""
    weight_by_probability: bool = True
    """Multiply each closure's information by the probability of Eq. (2); off for measurements that carry a trusted
    covariance of their own."""
    inlier_probability: float = Field(0.9999, gt=0, lt=1)
    """Chi-square quantile below which a closure counts as right; larger rejects less."""
    gnc_start_ratio: float = Field(1e-4, gt=0)
    """Control parameter at which GNC starts at the latest; smaller starts more convex and takes more solves."""
    gnc_step: float = Field(2.0, gt=1)
    """Factor of the control parameter per GNC round; smaller is more careful and slower."""
    gnc_inner_steps: int = Field(1, ge=1)
    """Linear solves per GNC round; more follows each round's optimum more closely."""
    relative_tolerance: float = Field(1e-5, gt=0)
    """Stop when a step lowers the cost by less than this part of it."""
    absolute_tolerance: float = Field(1e-9, ge=0)
    """Stop when the cost is below this."""
    covariances: bool = True
    """Compute the marginal covariance of every robot's T_map_odom."""
    iterations_max: int = Field(100, ge=1)
    """Linear solves in one optimisation."""

    @model_validator(mode="after")
    def _is_known_to_distributed_mode(self) -> Self:
        if self.mode is BackendMode.CENTRALISED:
            return self
        if self.formulation is not Formulation.BASE:
            raise ValueError("mode = 'distributed' holds scales constant; it needs formulation = 'base'")
        if self.solver not in (Solver.LM, Solver.GNC_TLS):
            raise ValueError("mode = 'distributed' knows the solvers 'lm' and 'gnc-tls'")
        return self


class ClassicalConfig(Section):
    """The classical front end: SIFT features, mutual matching, essential matrix, three-view scale."""

    features_max: int = Field(1000, ge=50, le=10_000)
    """Features per image; a latent has 136 bytes for each."""
    pixels_max: int = Field(180_000, ge=10_000)
    """Larger images are shrunk to this many pixels before features are sought (480x375); more cost more time."""
    contrast_threshold: float = Field(0.02, gt=0)
    """SIFT's contrast threshold; lower finds features in dim images, and more that do not repeat."""
    distance_ratio_max: float = Field(0.8, gt=0, le=1)
    """Lowe's ratio; lower keeps fewer and surer matches."""
    inlier_threshold_px: float = Field(2.0, gt=0)
    """A correspondence this close to its epipolar line is verified."""
    sigma_px: float = Field(0.7, gt=0)
    """Noise of a correspondence; weights the covariance."""
    correspondences_min: int = Field(15, ge=8)
    """Fewer verified correspondences are no registration."""
    iterations_max: int = Field(2000, ge=100)
    """Hypotheses of the robust estimator."""
    common_points_min: int = Field(10, ge=6)
    """Points seen in the neighbour, the query and the match that fix the closure's scale; with fewer it has none."""
    scale_sigma_ratio_max: float = Field(0.3, gt=0)
    """A scale more uncertain than this is not given."""
    direction_sigma_max_rad: float = Field(0.35, gt=0)
    """A closure without scale whose direction is more uncertain than this is degenerate."""
    odometry_rotation_sigma_rad: float = Field(0.03, gt=0)
    """How far odometry's rotation between neighbours may be from the images', calibration error included."""
    odometry_direction_sigma_rad: float = Field(0.2, gt=0)
    """How far odometry's direction of motion between neighbours may be from the images'."""
    odometry_pairs_max: int = Field(256, ge=1)
    """Odometry-pair results kept in memory."""


class SyntheticConfig(Section):
    """The synthetic front end: ground truth plus a seeded noise, outlier and scale model."""

    dimension: int = Field(128, ge=8, le=4096)
    """Length of a descriptor; a longer one has less accidental similarity, about 1/sqrt(dimension)."""
    place_distance_m: float = Field(3.0, gt=0)
    """Distance at which the similarity of two descriptors has fallen to 0.6."""
    place_angle_rad: float = Field(0.7, gt=0)
    """Angle between viewing directions at which the similarity of two descriptors has fallen to about 0.6."""
    descriptor_noise_ratio: float = Field(0.2, ge=0)
    """Length of a descriptor's own noise relative to the place's signature."""
    alias_probability: float = Field(0.05, ge=0, le=1)
    """Share of places that look like one of a few others."""
    alias_places: int = Field(4, ge=1)
    """Number of looks that aliased places share; fewer means more mistaken candidates."""
    alias_cell_m: float = Field(10.0, gt=0)
    """Edge of the cubes that are aliased as a whole."""
    visibility_distance_m: float = Field(4.0, gt=0)
    """Distance at which the correspondences have fallen to 0.6 of the typical number."""
    visibility_angle_rad: float = Field(0.6, gt=0)
    """Angle between viewing directions at which the correspondences have fallen to 0.6 of the typical number."""
    correspondences_typical: int = Field(400, ge=20)
    """Correspondences of two images of one place."""
    correspondences_min: int = Field(20, ge=1)
    """Fewer correspondences are no registration."""
    rotation_sigma_rad: float = Field(0.01, ge=0)
    """Rotation noise at the typical number of correspondences; grows as they become few."""
    translation_sigma_ratio: float = Field(0.05, ge=0)
    """Translation noise per distance, at the typical number of correspondences."""
    outlier_probability: float = Field(0.05, ge=0, le=1)
    """Share of registrations that give a wrong pose, with fewer correspondences than a right one."""
    outlier_distance_m: float = Field(10.0, gt=0)
    """Typical length of a wrong translation."""
    scale_sigma_ratio: float = Field(0.3, ge=0)
    """Spread of metres per network unit between registrations (log-normal)."""
    scale_drift_sigma_ratio: float = Field(0.1, ge=0)
    """How much the odometry pair's metres per network unit differ from the loop pair's (log-normal)."""
    latent_bytes: int = Field(0, ge=0, le=64 * 1024 * 1024)
    """Latents are padded to this size, to load links like another method's; MASt3R's are 1.5 MB."""


class RecordedConfig(Section):
    """Candidates and registrations that are looked up in a file, such as a benchmark's."""

    file: Path | None = None
    """The file of recorded registrations (`perception/recorded.py`)."""
    scale: Literal["removed", "kept"] = "removed"
    """removed: translations have length one and no scale is known; kept: they are in metres."""


class Mast3rConfig(Section):
    """The paper's front end: CosPlace and MASt3R on checkpoints that the user provides."""

    weights: Path | None = None
    """MASt3R checkpoint (.pth or .safetensors); `flocc weights` says which, and under which licence."""
    place_weights: Path | None = None
    """CosPlace checkpoint; backbone and dimension are read from it."""
    network: Literal["full", "small", "tiny"] = "full"
    """full: the official network; small and tiny: reduced ones that `flocc weights synthesize` writes for tests."""
    encode_only: bool = False
    """Load the encoder only (1.2 of 2.7 GB in fp32): this robot serves latents and others decode."""
    device: Literal["auto", "cuda", "mps", "cpu"] = "auto"
    """Where the networks run; auto takes the best that is there."""
    dtype: Literal["auto", "fp32", "bf16", "fp16"] = "auto"
    """Number format; auto: bf16 where the machine has it, fp16 on older GPUs and mps, else fp32."""
    threads: int = Field(0, ge=0, le=256)
    """CPU threads of the networks; fewer leave more to the rest of the robot; 0: torch's choice."""
    compile: bool = False
    """Compile the networks at start: half a minute once, then up to a third faster with bf16."""
    warm_up: bool = False
    """Run the networks once at start, so that the first keyframe is not slower."""
    memory_check: bool = True
    """Refuse to start where the networks will not fit in the memory that is free."""
    image_size_px: Literal[512, 224] = 512
    """Longer side of the network's input; 224 (square) is five times cheaper and less accurate."""
    exchange: Literal["latent", "image", "auto"] = "latent"
    """latent: others decode what this robot encoded; image: send a JPEG that the receiver encodes; auto: keep both."""
    latent_dtype: Literal["fp16", "int8"] = "fp16"
    """Number format of a sent latent; int8 (per channel) halves it to 0.8 MB."""
    jpeg_quality: int = Field(90, ge=50, le=100)
    """Quality of sent images; lower is smaller and less exact."""
    place_input: Literal["native", "shorter-side", "swarm-slam"] = "swarm-slam"
    """What CosPlace sees: the picture, the picture resized, or Swarm-SLAM's central square; equal on all robots."""
    subsample_px: int = Field(8, ge=1, le=64)
    """Distance of the matcher's seeds; 16 is four times faster with a quarter of the matches; equal on all robots."""
    border_px: int = Field(3, ge=0)
    """Matches nearer to a border than this are dropped."""
    match_confidence_min: float = Field(0.0, ge=0)
    """Matches whose descriptor confidence is below this are dropped; the authors use 1.001 for localisation."""
    match_both_directions: bool = False
    """Match from both images' seeds; about twice the matches in twice the time."""
    count: Literal["matches", "inliers"] = "matches"
    """Correspondences of Eq. (1): all reciprocal matches as in the paper, or only those that agree with the pose."""
    calibrated: bool = True
    """Use the camera's calibration; false estimates focal lengths from the pointmaps, with a second decode."""
    consistency_check: bool = False
    """Decode (match, query) too and reject closures on which the two disagree; doubles the time."""
    consistency_rotation_rad: float = Field(0.2, gt=0)
    """How far the two decodes' rotations, and directions of translation, may differ."""
    reprojection_px: float = Field(5.0, gt=0)
    """Matches that reproject within this, at the network's resolution, agree with a pose."""
    iterations: int = Field(2000, ge=1000)
    """Samples of PnP's RANSAC; below 1000 it fails at 70 % outliers."""
    inliers_min: int = Field(12, ge=6)
    """Fewer agreeing matches are no pose."""
    odometry_pairs_max: int = Field(256, ge=1)
    """Odometry-pair results kept in memory."""
    encoded_images_max: int = Field(8, ge=1)
    """Latents of received images kept in memory, 1.5 to 3 MB each."""
    batch_max: int = Field(1, ge=1, le=64)
    """Images encoded, or pairs decoded, at once; more is faster on a GPU and takes about 1 GB each."""


class PerceptionConfig(Section):
    """Which perception back-end, and its parameters."""

    method: str = "classical"
    """classical: OpenCV, no weights; synthetic: ground truth plus noise; recorded: looked up in a file; mast3r:
    CosPlace and MASt3R checkpoints; or the name of one that an installed package brings."""
    options: dict[str, Any] = Field(default_factory=dict)
    """What an installed package's perception is to know; flocc hands it on as it is."""
    classical: ClassicalConfig = ClassicalConfig()
    synthetic: SyntheticConfig = SyntheticConfig()
    recorded: RecordedConfig = RecordedConfig()
    mast3r: Mast3rConfig = Mast3rConfig()


ENDPOINT_PATTERN = re.compile(r"(tcp|tls|quic|udp)/(\[[0-9a-fA-F:.]+\]|[^/:#?\s]+):([0-9]{1,5})([#?]\S*)?")
PORT_MAX = 65535


def checked_endpoint(text: str) -> str:
    """Return the endpoint, or say how one looks.

    Raises:
        ValueError: Not PROTOCOL/HOST:PORT.
    """
    match = ENDPOINT_PATTERN.fullmatch(text)
    if match is None or int(match[3]) > PORT_MAX:
        raise ValueError(f"{text!r} is no endpoint; one looks like tcp/10.0.0.7:7447 or tls/[::]:0#iface=wlan0")
    return text


Endpoint = Annotated[str, AfterValidator(checked_endpoint)]


class PeerEndpoints(Section):
    """Where one known robot listens."""

    control: tuple[Endpoint, ...] = ()
    """Its control session: heartbeats, records, elections, corrections."""
    bulk: tuple[Endpoint, ...] = ()
    """Its bulk session: latents."""


class TlsConfig(Section):
    """Mutual TLS, one writer per key, and signed records: with the folder that `flocc keys` made for this robot."""

    folder: Path
    """Holds ca.crt, robot.crt, robot.key, signing.key and members.json."""
    names_verified: bool = False
    """True also demands that the dialled address stands in the peer's certificate."""


class TransportConfig(Section):
    """How a robot reaches others over zenoh. Latents have their own session, so that they never delay heartbeats."""

    control_listen: tuple[Endpoint, ...] = ("tcp/0.0.0.0:0",)
    """Where this robot listens for control; port 0 takes a free one, for which scouting must be on."""
    bulk_listen: tuple[Endpoint, ...] = ("tcp/0.0.0.0:0",)
    """Where this robot listens for latents."""
    roster: dict[str, PeerEndpoints] = Field(default_factory=dict)
    """Known robots by name. Of each pair the higher name dials, for ever, also after a partition."""
    multicast: bool = True
    """Find robots of the same network by multicast; needs no roster, but many Wi-Fi access points drop it."""
    multicast_control: str = "224.0.0.224:7446"
    """Group and port for finding control sessions; swarms that share a network may take different ones."""
    multicast_bulk: str = "224.0.0.224:7447"
    """Group and port for finding bulk sessions; must differ from the one for control."""
    interface: str = "auto"
    """Network interface of multicast: auto, or one such as wlan0 (lo on a single machine)."""
    gossip: bool = True
    """Learn robots from robots; such links are not dialled again after a cut, the roster's are."""
    lease_s: float = Field(3.0, ge=1.0)
    """A silent TCP link is given up after this; at least twice the outage to ride through, more under load."""
    open_timeout_s: float = Field(2.0, gt=0)
    """Time for one attempt to open a link; longer leaves pairs apart for longer under heavy loss."""
    retry_max_s: float = Field(1.0, gt=0)
    """Longest pause between two attempts to dial a robot of the roster."""
    bulk_send_buffer_bytes: int = Field(65536, ge=4096)
    """Kernel buffer of the bulk session; larger is faster on long links and delays control more on slow ones."""
    message_bytes_max: int = Field(1024 * 1024, ge=1024)
    """Larger messages are neither sent nor accepted; latents have their own limit."""
    latent_bytes_max: int = Field(8 * 1024 * 1024, ge=1024)
    """Larger latents are neither served nor fetched."""
    chunk_bytes: int = Field(256 * 1024, ge=1024, le=4 * 1024 * 1024)
    """A latent travels in pieces of this size; a fetch that was cut goes on with the piece that is missing."""
    chunk_timeout_s: float = Field(5.0, gt=0)
    """One piece that takes longer is asked for again."""
    fetches_max: int = Field(2, ge=1, le=8)
    """Latents in flight at once; more share the same link and make each later."""
    inbox_messages_max: int = Field(4096, ge=16)
    """Messages of one kind that wait for the robot; the oldest is dropped for a new one."""
    inbox_bytes_max: int = Field(32 * 1024 * 1024, ge=1024 * 1024)
    """Bytes of one kind that wait for the robot."""
    peers_max: int = Field(256, ge=1)
    """Different senders; messages of any further one are dropped."""
    peer_messages_per_s: float = Field(2000.0, gt=0)
    """What one sender may sustain, with bursts of two seconds' worth; the rest is dropped and counted."""
    peer_bytes_per_s: float = Field(16.0 * 1024 * 1024, gt=0)
    """The same in bytes."""
    tls: TlsConfig | None = None
    """Mutual TLS and one writer per key; None is for trusted networks and emulation."""
    chaos: bool = False
    """Take orders of `flocc chaos`: partitions, loss, kills. For tests; without tls anybody in reach may order."""

    @model_validator(mode="after")
    def _is_consistent(self) -> "TransportConfig":
        misnamed = [name for name in self.roster if not NAME_PATTERN.fullmatch(name)]
        if misnamed:
            raise ValueError(f"the roster's {misnamed[0]!r} cannot be a robot's name")
        endpoints = [*self.control_listen, *self.bulk_listen]
        endpoints += [e for peer in self.roster.values() for e in (*peer.control, *peer.bulk)]
        wrong = [e for e in endpoints if not e.startswith("tls/")] if self.tls else []
        if wrong:
            raise ValueError(f"with tls every endpoint begins with tls/, but there is {wrong[0]!r}")
        if self.multicast_control == self.multicast_bulk:
            raise ValueError("multicast_control and multicast_bulk must differ")
        return self


class StoreConfig(Section):
    """What a robot keeps on disk."""

    latent_bytes_max: int = Field(2 * 1024**3, ge=1024 * 1024)
    """Latents kept, bytes; beyond it the oldest go first and can no longer be fetched."""
    record_bytes_max: int = Field(1024**3, ge=1024 * 1024)
    """Records of other robots kept, bytes; more are held in memory only. Own records are always written."""


class LinkConfig(Section):
    """The emulated quality of a link; the default is perfect. `flocc_agent.radio` says what each one does."""

    loss_ratio: float = Field(0.0, ge=0, le=1)
    """Probability that a message is lost, independently of others."""
    burst_ratio: float = Field(0.0, ge=0, le=1)
    """Share of messages that fall into bursts of loss."""
    burst_messages_mean: float = Field(5.0, ge=1)
    """Mean length of such a burst, messages."""
    latency_s: float = Field(0.0, ge=0)
    """Least delay of a message."""
    jitter_s: float = Field(0.0, ge=0)
    """Further delay, uniform between 0 and this."""
    duplicate_ratio: float = Field(0.0, ge=0, le=1)
    """Probability that a message arrives twice."""
    reorder_ratio: float = Field(0.0, ge=0, le=1)
    """Probability that a message may be overtaken."""
    reorder_delay_s: float = Field(0.2, ge=0)
    """How long such a message is held back."""
    bandwidth_bytes_s: float | None = Field(None, gt=0)
    """Capacity of each directed link; None is unlimited."""
    queue_bytes_max: int = Field(4 * 1024 * 1024, ge=0)
    """What may wait for a link before messages are lost."""

    def link(self) -> "LinkParameters":
        """The same as the link model takes it."""
        from flocc_agent.radio import LinkParameters

        return LinkParameters(**{name: getattr(self, name) for name in LinkConfig.model_fields})


class LinkOverrideConfig(LinkConfig):
    """Another quality for links of one direction."""

    sender: str = "*"
    """Robot that speaks, '*' for any."""
    receiver: str = "*"
    """Robot that hears, '*' for any."""


class PartitionConfig(Section):
    """Groups that do not hear each other for a while; robots that no group names are one more group."""

    groups: tuple[tuple[str, ...], ...]
    """Names, group by group."""
    from_s: float = Field(0.0, ge=0)
    """Begin, seconds after the start of the run."""
    to_s: float = Field(float("inf"), gt=0)
    """End, seconds after the start of the run."""


class BlackoutConfig(Section):
    """Robots whose radio is dead for a while."""

    robots: tuple[str, ...]
    """Their names."""
    from_s: float = Field(0.0, ge=0)
    """Begin, seconds after the start of the run."""
    to_s: float = Field(float("inf"), gt=0)
    """End, seconds after the start of the run."""


class RadioConfig(LinkConfig):
    """The emulated radio: the quality of every link, exceptions, range, and scheduled outages."""

    range_m: float | None = Field(None, gt=0)
    """Robots whose true positions are further apart do not hear each other; None is unlimited."""
    overrides: tuple[LinkOverrideConfig, ...] = ()
    """Links of another quality; the first match counts."""
    partitions: tuple[PartitionConfig, ...] = ()
    """Scheduled separations."""
    blackouts: tuple[BlackoutConfig, ...] = ()
    """Scheduled silences."""

    def parameters(self) -> "RadioParameters":
        """The same as the link model takes it."""
        from flocc_agent.radio import Blackout, LinkOverride, Partition, RadioParameters

        return RadioParameters(
            link=self.link(),
            overrides=tuple(LinkOverride(o.sender, o.receiver, o.link()) for o in self.overrides),
            range_m=self.range_m,
            partitions=tuple(Partition(p.groups, p.from_s, p.to_s) for p in self.partitions),
            blackouts=tuple(Blackout(b.robots, b.from_s, b.to_s) for b in self.blackouts),
        )


class MetricsConfig(Section):
    """Figures for Prometheus (docs/metrics.md); needs the extra `metrics`."""

    port: int | None = Field(None, ge=1, le=PORT_MAX)
    """Where `/metrics` is served over HTTP; None serves nothing."""
    host: str = "127.0.0.1"
    """Address that is listened on; 0.0.0.0 lets other machines scrape. There is neither encryption nor a password."""

    @classmethod
    def at(cls, text: str, robots: int = 1) -> "tuple[MetricsConfig, ...]":
        """Read [HOST:]PORT, and take one port after the other for several robots.

        Raises:
            ConfigError: It is not that, or the ports do not suffice.
        """
        host, _, port = text.rpartition(":")
        if not port.isdecimal() or not 1 <= int(port) <= PORT_MAX:
            raise ConfigError(f"metrics: {text!r} is not [HOST:]PORT, such as 9100 or 0.0.0.0:9100")
        if int(port) + robots - 1 > PORT_MAX:
            raise ConfigError(f"metrics: from port {port} there are no ports for {robots} robots")
        known = {"host": host.strip("[]")} if host else {}
        return tuple(cls(port=int(port) + k, **known) for k in range(robots))


class KeyframeConfig(Section):
    """Which images become keyframes: the robot moved or turned enough since the last one."""

    distance_m: float = Field(0.5, ge=0)
    """Distance since the last keyframe that calls for a new one; smaller finds more closures and costs more."""
    rotation_rad: float = Field(0.35, ge=0)
    """Rotation since the last keyframe that calls for a new one."""


class SourceConfig(Section):
    """Where keyframes come from when no program feeds the agent."""

    recording: Path | None = None
    """Folder of images, odometry and camera (docs/data-sets.md), played by its stamps; None: the program's own."""
    rate: float = Field(1.0, gt=0)
    """Playback speed relative to the stamps."""
    start_s: float = Field(0.0, ge=0)
    """Pause before the first frame."""
    hold_s: float = Field(0.0, ge=0)
    """How long the agent goes on after its last frame; 0: until it is stopped."""


TOPIC_PATTERN = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def checked_topic(text: str) -> str:
    """Return the name of a ROS topic or namespace, or nothing, or say how one looks.

    Raises:
        ValueError: It is no such name.
    """
    if text and not TOPIC_PATTERN.fullmatch(text):
        raise ValueError(f"{text!r} is no ROS name; one looks like /r1/odom, or odom within the namespace")
    return text


RosName = Annotated[str, AfterValidator(checked_topic)]


class Ros2Config(Section):
    """A ROS 2 robot with rmw_zenoh, without a bridge node (docs/ros2.md). Relative topics lie in the namespace."""

    router: Endpoint = "tcp/localhost:7447"
    """Where the robot's rmw_zenohd listens."""
    domain_id: int = Field(0, ge=0, le=232)
    """The robot's ROS_DOMAIN_ID."""
    namespace: RosName = ""
    """Namespace of relative topics, such as /r1."""
    image_topic: RosName = "camera/image_raw"
    """sensor_msgs/Image or CompressedImage; empty where a program or a recording feeds the agent."""
    image_type: Literal["auto", "raw", "compressed"] = "auto"
    """Type of the image topic; auto: compressed where the topic's name ends with compressed."""
    camera_info_topic: RosName = "camera/camera_info"
    """sensor_msgs/CameraInfo with the intrinsics of the images."""
    rectified: bool = False
    """Images are rectified already (image_rect): the P of CameraInfo counts, and no distortion."""
    odometry_topic: RosName = "odom"
    """nav_msgs/Odometry, of base_frame in odom_frame; empty where a program or a recording feeds the agent."""
    map_frame: str = Field("map", min_length=1)
    """Frame that odom_frame is placed in, on /tf (REP 105)."""
    odom_frame: str = Field("odom", min_length=1)
    """Frame of the odometry; messages of another one are refused."""
    base_frame: str = Field("base_link", min_length=1)
    """Body of the odometry; messages of another one are refused."""
    camera_frame: str = ""
    """Optical frame of the images; images of another one are refused. Empty takes what the images say."""
    camera_mounting: tuple[float, float, float, float, float, float, float] | None = None
    """Optical frame in base_frame: x y z qx qy qz qw, metres; None takes it from tf_static_topic."""
    tf_topic: RosName = "/tf"
    """Where map_frame to odom_frame is published."""
    tf_static_topic: RosName = "/tf_static"
    """Where the camera's mounting is read."""
    path_topic: RosName = "flocc/path"
    """Where the corrected path is published, nav_msgs/Path."""
    pose_topic: RosName = "flocc/pose"
    """Where the corrected pose is published, geometry_msgs/PoseWithCovarianceStamped."""
    map_frame_topic: RosName = "flocc/map_frame"
    """Where the name of the swarm's map frame is published, std_msgs/String; when it changes, every pose jumps."""
    tf_period_s: float = Field(0.05, gt=0)
    """Least time between two transforms, and between two poses."""
    tf_tolerance_s: float = Field(0.1, ge=0, le=60)
    """The transform is dated so far ahead, so that it can be looked up until the next one."""
    path_period_s: float = Field(1.0, gt=0)
    """Least time between two paths."""
    odometry_gap_max_s: float = Field(0.5, gt=0)
    """Images in a longer pause of the odometry are left out."""
    images_max: int = Field(8, ge=1, le=256)
    """Images that wait for odometry or for the encoder; the oldest gives way."""
    path_poses_max: int = Field(1000, ge=2, le=100_000)
    """A longer path is thinned out evenly."""

    def is_compressed(self) -> bool:
        """Whether images are CompressedImage messages."""
        by_name = self.image_topic.endswith("compressed")
        return by_name if self.image_type == "auto" else self.image_type == "compressed"

    @model_validator(mode="after")
    def _is_consistent(self) -> "Ros2Config":
        if self.image_topic and not (self.odometry_topic and self.camera_info_topic):
            raise ValueError("images need odometry_topic and camera_info_topic")
        outputs = ("tf_topic", "tf_static_topic", "path_topic", "pose_topic", "map_frame_topic")
        missing = [name for name in outputs if not getattr(self, name)]
        if missing:
            raise ValueError(f"{missing[0]} must not be empty")
        if self.map_frame == self.odom_frame:
            raise ValueError("map_frame and odom_frame must differ")
        q = self.camera_mounting[3:] if self.camera_mounting else (1.0,)
        if abs(sum(part * part for part in q) - 1.0) > 1e-2:
            raise ValueError("camera_mounting is x y z qx qy qz qw with a quaternion of unit length")
        return self


class AgentConfig(Section):
    """One robot's agent."""

    name: Annotated[str, AfterValidator(checked_name)]
    """Name of the robot, unique in its swarm: 1 to 32 of a-z, 0-9, '-' and '_'."""
    swarm: Annotated[str, AfterValidator(checked_name)] = "swarm"
    """Name of the swarm; robots of different swarms ignore each other."""
    compute_class: int = Field(0, ge=0, le=9)
    """0: small robot, 9: server with a GPU; the highest leads and registers for the others."""
    incarnation: int | None = Field(None, ge=0)
    """Number of this robot's life when it has no disk yet; None draws it from the wall clock."""
    seed: int = Field(0, ge=0)
    """Seed of emulated links and synthetic perception; the same for all robots of a swarm."""
    folder: Path | None = None
    """Where the robot's log, latents and events are kept; None keeps them in memory."""
    core: CoreParameters = CoreParameters()
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
    def _has_one_source(self) -> "AgentConfig":
        if self.source.recording is not None and self.ros2 is not None and self.ros2.image_topic:
            raise ValueError("images come from source.recording or from ros2.image_topic, not from both")
        return self

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


def parsed_change(text: str) -> tuple[str, object]:
    """Key and value of `KEY=VALUE`; the value is TOML, or text as it stands.

    Raises:
        ConfigError: There is no key.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"{text!r} is no change of the configuration; one looks like radio.loss_ratio=0.3")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def put_value(fields: dict[str, object], key: str, value: object) -> None:
    """Put a value at a dotted key, such as `radio.loss_ratio`.

    Raises:
        ConfigError: A part of the key is no table.
    """
    *tables, name = key.split(".")
    for table in tables:
        inner = fields.setdefault(table, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"{key}: {table} is no table")
        fields = inner
    fields[name] = value


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file.

    Raises:
        ConfigError: It is missing, unreadable or not TOML; the message names the file (and line).
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from error


def read_json(path: Path) -> dict[str, object]:
    """Read a JSON file that holds an object.

    Raises:
        ConfigError: It is missing, unreadable or no such file; the message names it.
    """
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: holds no JSON object")
    return content


def first_error(error: ValidationError, source: str) -> str:
    """Put pydantic's first complaint into one sentence that names the source and the key."""
    complaint = error.errors()[0]
    key = ".".join(str(part) for part in complaint["loc"]) or "(top level)"
    if complaint["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{source}: the key '{key}' does not exist"
    if complaint["type"] in ("missing", "missing_argument"):
        return f"{source}: the key '{key}' is missing"
    return f"{source}: {key}: {complaint['msg'].removeprefix('Value error, ')}"


M = TypeVar("M", bound=BaseModel)


def validated(model: type[M], fields: Mapping[str, object], source: str, folder: Path | None = None) -> M:
    """Check fields against a model.

    Args:
        model: What they should be.
        fields: As they were read.
        source: Where they come from, for the error's sentence.
        folder: What relative paths in them start from; None leaves them as they are.

    Raises:
        ConfigError: One sentence that names the source and the key.
    """
    try:
        return model.model_validate(fields, context={"folder": folder})
    except (ValidationError, FloccError) as error:
        raise ConfigError(
            first_error(error, source) if isinstance(error, ValidationError) else f"{source}: {error}"
        ) from error
