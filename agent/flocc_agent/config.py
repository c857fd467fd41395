"""AgentConfig: everything that can be turned on an agent, with unit, default and effect. Read from TOML.

Parameters of the core are plain dataclasses in `core/parameters.py`; pydantic checks them here like the rest.
"""

import tomllib
from enum import Enum
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flocc_protocol.errors import FloccError


class ConfigError(FloccError):
    """A configuration that cannot be used; the message names the file and the key."""


class Section(BaseModel):
    """Base of all sections: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class Formulation(str, Enum):
    """Which unknowns the loop closures' scales are (Sec. III-C)."""

    BASE = "base"
    INDEPENDENT = "independent"
    SMOOTHED = "smoothed"
    SHARED = "shared"


class Solver(str, Enum):
    """How the nonlinear least-squares problem is solved."""

    LM = "lm"
    GNC_TLS = "gnc-tls"
    GNC_GM = "gnc-gm"
    HUBER = "huber"
    CAUCHY = "cauchy"


class ScaleInitial(str, Enum):
    """Where a closure's first scale comes from."""

    RAW = "raw"
    ODOMETRY = "odometry"
    GROUND_TRUTH = "ground-truth"


class BackendConfig(Section):
    """The pose-graph optimiser."""

    formulation: Formulation = Formulation.SMOOTHED
    """Scales of closures: fixed, one each, one each but linked within a cluster, or one for all."""
    solver: Solver = Solver.GNC_TLS
    """lm is fastest and trusts every closure; gnc-* find and reject outliers."""
    pairwise_consistency: bool = True
    """Filter closures by pairwise consistency maximisation before solving."""
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
    scale_link_sigma_ratio: float = Field(0.1, gt=0)
    """Standard deviation of the difference of two linked scales, relative to their size."""
    scale_prior_sigma_ratio: float = Field(5.0, gt=0)
    """Weak prior on each scale around its initial value, relative to it; keeps unobservable scales finite."""
    iterations_max: int = Field(100, ge=1)
    """Linear solves in one optimisation."""


class ClassicalConfig(Section):
    """The classical front end: SIFT features, mutual matching, essential matrix, three-view scale."""

    features_max: int = Field(1000, ge=50, le=10_000)
    """Features per image; a latent has 136 bytes for each."""
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


class PerceptionConfig(Section):
    """Which perception back-end, and its parameters."""

    method: Literal["classical", "synthetic", "mast3r"] = "classical"
    """classical: OpenCV, no weights; synthetic: ground truth plus noise; mast3r: CosPlace and MASt3R checkpoints."""
    classical: ClassicalConfig = ClassicalConfig()


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


def first_error(error: ValidationError, source: str) -> str:
    """Put pydantic's first complaint into one sentence that names the source and the key."""
    complaint = error.errors()[0]
    key = ".".join(str(part) for part in complaint["loc"]) or "(top level)"
    if complaint["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{source}: the key '{key}' does not exist"
    if complaint["type"] in ("missing", "missing_argument"):
        return f"{source}: the key '{key}' is missing"
    return f"{source}: {key}: {complaint['msg']}"
