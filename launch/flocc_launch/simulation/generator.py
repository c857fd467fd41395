"""Faults drawn from a seed: a whole scenario that begins with faults and ends in peace."""

from dataclasses import dataclass

import numpy as np

from flocc_agent.config import (
    BackendConfig,
    BackendMode,
    KeyframeConfig,
    LinkOverrideConfig,
    PerceptionConfig,
    RadioConfig,
    SyntheticConfig,
)
from flocc_agent.core.parameters import CoreParameters, LoopClosingParameters, PlaceRecognitionParameters
from flocc_launch.scenarios.scenario import (
    Fault,
    FaultKind,
    RobotScenario,
    Scenario,
    SensorsScenario,
    TracksScenario,
)

FAULTS_END_S = 30.0
ROBOTS_MAX = 5
FAULTS_MAX = 6
CLOSURES_ENOUGH = 3
"""By default small teams spare no pair; here they do, so that what it needs is checked."""
WALKS = 8
LENGTHS_M = (8.0, 14.0, 20.0)
"""Few walks, so that a process draws each once; faults differ from seed to seed."""
NOISELESS_RATIO = 0.5
NOISY = SyntheticConfig(dimension=16, outlier_probability=0.0, alias_probability=0.0)
NOISELESS = NOISY.model_copy(
    update=dict.fromkeys(
        ("rotation_sigma_rad", "translation_sigma_ratio", "scale_sigma_ratio", "scale_drift_sigma_ratio"), 0.0
    )
)
"""Half of the swarms see and measure without noise, so that what comes out can be held against the truth."""
SENSING_RATIO = 0.25
SENSORS = SensorsScenario(
    tags={"7": (6.0, 6.0, 1.5)},
    tag_range_m=6.0,
    fix_robots=("r1",),
    start_robots=("r2",),
    closure_every_s=6.0,
    odometry_every_s=6.0,
)
"""What a quarter of the swarms measures besides: at every keyframe, now and then, and before the first one."""


@dataclass(frozen=True, slots=True)
class Family:
    """How large drawn swarms are.

    Attributes:
        robots: Fewest and most robots.
        faults_end_s: From then on nothing goes wrong any more.
        faults_max: Most faults of one run.
        lengths_m: Lengths of walks.
        area_m: Edge of the area.
        flaps: The best-ranked robot may come and go.
        distributed: Nobody solves for the others.
    """

    robots: tuple[int, int]
    faults_end_s: float
    faults_max: int
    lengths_m: tuple[float, ...]
    area_m: float = 12.0
    flaps: bool = False
    distributed: bool = False


FAMILIES = {
    "small": Family((2, ROBOTS_MAX), FAULTS_END_S, FAULTS_MAX, LENGTHS_M),
    "distributed": Family((2, ROBOTS_MAX), FAULTS_END_S, FAULTS_MAX, LENGTHS_M, distributed=True),
    "large": Family((20, 20), 540.0, 40, (40.0,), area_m=24.0, flaps=True),
    "hour": Family((20, 20), 3540.0, 80, (40.0,), area_m=24.0, flaps=True),
}
"""`flocc simulate --seeds N --family NAME`: small swarms for half a minute, with a leader or distributed, large ones
for ten minutes or an hour."""
SMALL = FAMILIES["small"]
DISTRIBUTED = BackendConfig(mode=BackendMode.DISTRIBUTED)
FLAPS, FLAP_S = 6, 7.0


def calm_s(scenario: Scenario) -> float:
    """When faults end."""
    return max((fault.at_s for fault in scenario.faults if fault.kind is FaultKind.CALM), default=0.0)


def drawn_scenario(seed: int, family: Family = SMALL) -> Scenario:
    """Draw robots, clocks, links and a timeline of faults; from a time on nothing goes wrong any more."""
    rng = np.random.default_rng([seed, 0])
    count = int(rng.integers(family.robots[0], family.robots[1] + 1))
    names = [f"r{k + 1}" for k in range(count)]
    return Scenario(
        name="campaign",
        seed=seed,
        tracks=TracksScenario(
            robots=count,
            seed=int(rng.integers(WALKS)),
            area_m=family.area_m,
            speed_m_s=0.8,
            length_m=float(rng.choice(family.lengths_m)),
        ),
        robots={name: _robot(rng) for name in names},
        radio=_radio(rng, names),
        core=CoreParameters(
            place_recognition=PlaceRecognitionParameters(similarity_threshold=0.5),
            loop_closing=LoopClosingParameters(closures_enough=CLOSURES_ENOUGH, sparing_logs_min=0),
        ),
        keyframes=KeyframeConfig(distance_m=1.5, rotation_rad=1.2),
        perception=PerceptionConfig(
            method="synthetic", synthetic=NOISELESS if _draws(seed, 2, NOISELESS_RATIO) else NOISY
        ),
        backend=DISTRIBUTED if family.distributed else BackendConfig(),
        faults=_faults(rng, names, family),
        sensors=SENSORS if _draws(seed, 1, SENSING_RATIO) else None,
    )


def _draws(seed: int, purpose: int, ratio: float) -> bool:
    """Whether a seed has something that a share of all seeds has; one more purpose changes no other draw."""
    return bool(np.random.default_rng([seed, purpose]).uniform() < ratio)


def _robot(rng: np.random.Generator) -> RobotScenario:
    return RobotScenario(
        compute_class=int(rng.choice([0, 0, 0, 3])),
        start_s=round(float(rng.choice([0.0, 0.0, rng.uniform(0, 10)])), 3),
        clock_offset_s=round(float(rng.choice([0.0, rng.uniform(0, 1000)])), 3),
        clock_drift_ratio=float(rng.choice([0.0, rng.uniform(-0.02, 0.02)])),
    )


def _radio(rng: np.random.Generator, names: list[str]) -> RadioConfig:
    overrides = [_override(rng, names) for _ in range(int(rng.integers(0, 3)))]
    ranged = rng.uniform() < 0.2
    return RadioConfig(
        **_link(rng), overrides=tuple(overrides), range_m=round(float(rng.uniform(5, 12)), 2) if ranged else None
    )


def _link(rng: np.random.Generator) -> dict[str, float | None]:
    """Quality of a link; half of all links are good in each respect."""

    def sometimes(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 4) if rng.uniform() < 0.5 else 0.0

    return {
        "loss_ratio": sometimes(0.0, 0.5),
        "burst_ratio": sometimes(0.0, 0.3),
        "latency_s": sometimes(0.0, 0.3),
        "jitter_s": sometimes(0.0, 0.3),
        "duplicate_ratio": sometimes(0.0, 0.3),
        "reorder_ratio": sometimes(0.0, 0.3),
        "bandwidth_bytes_s": round(float(rng.uniform(4000, 50000))) if rng.uniform() < 0.2 else None,
    }


def _override(rng: np.random.Generator, names: list[str]) -> LinkOverrideConfig:
    """One direction of one link is of another quality, perhaps dead."""
    sender, receiver = (str(name) for name in rng.choice(names, size=2, replace=False))
    link = {"loss_ratio": 1.0} if rng.uniform() < 0.3 else _link(rng)
    return LinkOverrideConfig(sender=sender, receiver=receiver, **link)


def _faults(rng: np.random.Generator, names: list[str], family: Family) -> tuple[Fault, ...]:
    drawn: list[Fault] = []
    end_s = family.faults_end_s
    for _ in range(int(rng.integers(0, family.faults_max + 1))):
        drawn += _fault(rng, names, round(float(rng.uniform(1.0, end_s - 2.0)), 3), end_s)
    if family.flaps and rng.uniform() < 0.5:
        drawn += _flapping(names[0], float(rng.uniform(1.0, end_s - FLAPS * FLAP_S)))
    calm = [Fault(at_s=end_s, kind=FaultKind.CALM)]
    if rng.uniform() < 0.8:
        calm += [Fault(at_s=end_s, kind=FaultKind.START, robots=tuple(names))]
    return (*sorted(drawn, key=lambda fault: fault.at_s), *calm)


def _flapping(name: str, at_s: float) -> list[Fault]:
    """A robot that dies and comes back, again and again; by its name it outranks all of its class."""
    times_s = [round(at_s + FLAP_S * k, 3) for k in range(FLAPS)]
    return [Fault(at_s=time_s, kind=FaultKind.RESTART, robots=(name,)) for time_s in times_s]


def _fault(rng: np.random.Generator, names: list[str], at_s: float, last_s: float) -> list[Fault]:
    """One fault, with its end where it has one."""
    victim = (str(rng.choice(names)),)
    end_s = round(min(at_s + float(rng.uniform(0.5, 20.0)), last_s), 3)
    kind = rng.choice(["kill", "kill", "restart", "disk", "partition", "blackout", "slow", "loss", "mute", "leave"])
    match kind:
        case "kill":
            effects = None if rng.uniform() < 0.5 else float(rng.integers(1, 4))
            return [Fault(at_s=at_s, kind=FaultKind.KILL, robots=victim, value=effects)]
        case "restart" | "disk":
            return [Fault(at_s=at_s, kind=FaultKind.RESTART, robots=victim, disk_lost=kind == "disk")]
        case "partition":
            cut = int(rng.integers(1, len(names)))
            shuffled = [str(name) for name in rng.permutation(names)]
            heal = Fault(at_s=end_s, kind=FaultKind.HEAL)
            groups = (tuple(shuffled[:cut]), tuple(shuffled[cut:]))
            return [Fault(at_s=at_s, kind=FaultKind.PARTITION, groups=groups), heal]
        case "blackout":
            return [
                Fault(at_s=at_s, kind=FaultKind.BLACKOUT, robots=victim),
                Fault(at_s=end_s, kind=FaultKind.HEAL),
            ]
        case "slow":
            return [Fault(at_s=at_s, kind=FaultKind.SLOW, robots=victim, value=float(rng.uniform(2, 30)))]
        case "mute":
            message = str(rng.choice(["correction", "records", "candidates", "coordinator", "election", "heartbeat"]))
            return [Fault(at_s=at_s, kind=FaultKind.MUTE, message=message, value=float(rng.uniform(0.3, 1.0)))]
        case "leave":
            return [Fault(at_s=at_s, kind=FaultKind.LEAVE, robots=victim)]
        case _:
            return [Fault(at_s=at_s, kind=FaultKind.LOSS, value=float(rng.uniform(0.0, 0.9)))]
