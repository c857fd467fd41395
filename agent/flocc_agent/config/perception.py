"""The sections of the perception back-ends, and which of them is used."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from flocc_agent.config.section import Section, inner


def _is_direction(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if not all(map(math.isfinite, value)) or not any(value):
        raise ValueError("a direction is three finite numbers, not all of them 0")
    return value


class ClassicalConfig(Section):
    """The classical front end: SIFT features, mutual matching; two- and three-view geometry."""

    features_max: int = Field(1000, ge=50, le=10_000)
    """Features per image; a latent has 136 bytes for each."""
    pixels_max: int = Field(180_000, ge=10_000)
    """Larger images are shrunk to this many pixels before features are sought (480x375); more cost more time."""
    correspondences_min: int = Field(15, ge=8)
    """Fewer verified correspondences are no registration; lower registers more pairs, and more of them wrongly."""
    acceptance: Literal["fitted", "ratio"] = "fitted"
    """fitted: the front end's own rule for closures; ratio: Eq. (1) against core.loop_closing.match_ratio_threshold."""


class LearnedConfig(Section):
    """The learned front end: free networks find and match features; the geometry is the classical one's."""

    model: Literal["aliked-lightglue", "xfeat-lighterglue"] = "aliked-lightglue"
    """aliked-lightglue: sees most; xfeat-lighterglue: costs what SIFT costs; the same on all robots of a swarm."""
    weights: Path | None = None
    """Folder with the networks' files; none: where `flocc weights get learned` puts them."""
    device: Literal["auto", "cuda", "mps", "cpu"] = "auto"
    """Where the networks run; auto takes the best that is there."""
    acceptance: Literal["fitted", "ratio"] = "fitted"
    """fitted: the front end's own rule for closures; ratio: Eq. (1) against core.loop_closing.match_ratio_threshold."""


class SyntheticConfig(Section):
    """The synthetic front end: ground truth plus a seeded noise, outlier and scale model."""

    dimension: int = Field(128, ge=8, le=4096)
    """Length of a descriptor; a longer one has less accidental similarity, about 1/sqrt(dimension)."""
    descriptor_noise_ratio: float = inner(0.2, ge=0)
    """Length of a descriptor's own noise relative to the place's signature."""
    alias_probability: float = Field(0.05, ge=0, le=1)
    """Share of places that look like one of a few others."""
    alias_places: int = inner(4, ge=1)
    """Number of looks that aliased places share; fewer means more mistaken candidates."""
    rotation_sigma_rad: float = inner(0.01, ge=0)
    """Rotation noise at the typical number of correspondences; grows as they become few."""
    translation_sigma_ratio: float = inner(0.05, ge=0)
    """Translation noise per distance, at the typical number of correspondences."""
    outlier_probability: float = Field(0.05, ge=0, le=1)
    """Share of registrations that give a wrong pose, with fewer correspondences than a right one."""
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
    image_size_px: Literal[512, 224] = 512
    """Longer side of the network's input; 224 (square) is five times cheaper and less accurate."""
    exchange: Literal["latent", "image", "auto"] = "latent"
    """latent: others decode what this robot encoded; image: send a JPEG that the receiver encodes; auto: keep both."""
    latent_dtype: Literal["fp16", "int8"] = "fp16"
    """Number format of a sent latent; int8 (per channel) halves it to 0.8 MB."""
    place_input: Literal["native", "shorter-side", "swarm-slam"] = inner("swarm-slam")
    """What CosPlace sees: the picture, the picture resized, or Swarm-SLAM's central square; equal on all robots."""
    subsample_px: int = inner(8, ge=1, le=64)
    """Distance of the matcher's seeds; 16 is four times faster with a quarter of the matches; equal on all robots."""
    calibrated: bool = True
    """Use the camera's calibration; false estimates focal lengths from the pointmaps, with a second decode."""
    consistency_check: bool = inner(False)
    """Decode (match, query) too and reject closures on which the two disagree; doubles the time."""
    odometry_pairs_max: int = inner(256, ge=1)
    """Odometry-pair results kept in memory."""
    batch_max: int = inner(1, ge=1, le=64)
    """Images encoded, or pairs decoded, at once; more is faster on a GPU and takes about 1 GB each."""


class PerceptionConfig(Section):
    """Which perception back-end, and its parameters."""

    method: str = "classical"
    """classical: OpenCV, no weights; learned: ALIKED or XFeat with LightGlue; mast3r: CosPlace and MASt3R checkpoints;
    synthetic: ground truth plus noise; recorded: looked up in a file; or the name of one that an installed package
    brings."""
    options: dict[str, Any] = Field(default_factory=dict)
    """What an installed package's perception is to know; flocc hands it on as it is."""
    odometry_up: Annotated[tuple[float, float, float], AfterValidator(_is_direction)] | None = None
    """Direction against gravity in the odometry frame where odometry keeps roll and pitch, as a VIO does: [0, 0, 1] by
    ROS's convention. The classical and the learned front end then register with gravity; none: it is not known."""
    classical: ClassicalConfig = ClassicalConfig()
    learned: LearnedConfig = LearnedConfig()
    synthetic: SyntheticConfig = SyntheticConfig()
    recorded: RecordedConfig = RecordedConfig()
    mast3r: Mast3rConfig = Mast3rConfig()
