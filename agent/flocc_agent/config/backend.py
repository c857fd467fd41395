"""The back end's section: who optimises, which formulation, which solver, which noise."""

from enum import StrEnum
from typing import Self

from pydantic import Field, model_validator

from flocc_agent.config.section import Section, inner


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
    """centralised: the elected leader optimises everything; distributed: every robot its own part, and neighbours agree
    on the poses that both have. All robots of a swarm need the same."""
    formulation: Formulation = Formulation.INDEPENDENT
    """Scales of closures: fixed, one each, one each but linked within a cluster, or one for all."""
    solver: Solver = Solver.GNC_TLS
    """lm is fastest and trusts every closure; gnc-* find and reject outliers."""
    pairwise_consistency: bool = inner(False)
    """Filter closures by pairwise consistency maximisation before solving; needs odometry covariances that are true."""
    closures_to_join_min: int = Field(2, ge=1)
    """Maps with fewer agreeing closures between them stay apart: a single wrong one would contradict nothing."""
    scale_initial: ScaleInitial = inner(ScaleInitial.ODOMETRY)
    """raw: network units are metres; odometry: Eq. (6); ground-truth: for ablations only."""
    steepness: float = Field(4.0, gt=0)
    """k of the logistic Eq. (2); larger trusts high match ratios more."""
    odometry_rotation_sigma_rad: float = Field(0.01, gt=0)
    """Standard deviation of one odometry edge's rotation where the source gives no covariance."""
    odometry_translation_sigma_m: float = Field(0.05, gt=0)
    """Standard deviation of one odometry edge's translation where the source gives no covariance."""
    closure_rotation_sigma_rad: float = inner(0.05, gt=0)
    """Standard deviation of a closure's rotation at probability one."""
    closure_translation_sigma_m: float = inner(0.2, gt=0)
    """Standard deviation of a closure's translation at probability one, metres."""
    cluster_keyframes_max: int = inner(10, ge=1)
    """Closures whose keyframes are fewer than this apart on both sides share a scale cluster."""
    scale_link_sigma_ratio: float = inner(0.2, gt=0)
    """Standard deviation of a scale around its cluster's scale, both relative to their initial values by Eq. (6)."""
    scale_link_unknown_sigma_ratio: float = inner(3.0, gt=0)
    """The same where no initial scale makes the closures' network units comparable."""
    scale_prior_sigma_ratio: float = inner(0.5, gt=0)
    """Prior on a scale that Eq. (6) initialises: standard deviation relative to its initial value. Robots that met at
    one place only are placed by it; much smaller rejects closures whose scale is far from its initial value."""
    scale_prior_unknown_sigma_ratio: float = inner(20.0, gt=0)
    """The same for closures without an initial scale, around one metre per network unit."""
    weight_by_probability: bool = True
    """Multiply each closure's information by the probability of Eq. (2); off for measurements that carry a trusted
    covariance of their own."""
    inlier_probability: float = inner(0.9999, gt=0, lt=1)
    """Chi-square quantile below which closures, or a closure and odometry, agree with each other."""
    kept_probability: float = inner(0.9999, gt=0, lt=1)
    """Chi-square quantile below which GNC keeps a closure; larger rejects less. Real noise has heavier tails than its
    covariance: 0.9999999999 is nearer to the truth on recordings, and lets one group of closures set a wrong scale."""
    gnc_start_ratio: float = inner(1e-4, gt=0)
    """Control parameter at which GNC starts at the latest; smaller starts more convex and takes more solves."""
    gnc_step: float = inner(2.0, gt=1)
    """Factor of the control parameter per GNC round; smaller is more careful and slower."""
    gnc_inner_steps: int = inner(1, ge=1)
    """Linear solves per GNC round; more follows each round's optimum more closely."""
    relative_tolerance: float = inner(1e-5, gt=0)
    """Stop when a step lowers the cost by less than this part of it."""
    absolute_tolerance: float = inner(1e-9, ge=0)
    """Stop when the cost is below this."""
    covariances: bool = True
    """Compute the marginal covariance of every robot's T_map_odom; false saves time above 10,000 closures."""
    iterations_max: int = inner(100, ge=1)
    """Linear solves in one optimisation."""

    @model_validator(mode="after")
    def _is_known_to_distributed_mode(self) -> Self:
        if self.mode is BackendMode.DISTRIBUTED and self.formulation is Formulation.SHARED:
            raise ValueError("mode = 'distributed' has no scale that all robots share, as formulation = 'shared' has")
        return self
