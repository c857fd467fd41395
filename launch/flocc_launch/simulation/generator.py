"""Faults drawn from a seed: a whole scenario that begins with faults and ends in peace."""

import numpy as np

from flocc_agent.config import KeyframeConfig, LinkOverrideConfig, PerceptionConfig, RadioConfig, SyntheticConfig
from flocc_agent.core.parameters import CoreParameters, PlaceRecognitionParameters
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


def drawn_scenario(seed: int) -> Scenario:
    """Draw robots, clocks, links and a timeline of faults; from `FAULTS_END_S` on nothing goes wrong any more."""
    rng = np.random.default_rng([seed, 0])
    count = int(rng.integers(2, ROBOTS_MAX + 1))
    names = [f"r{k + 1}" for k in range(count)]
    return Scenario(
        name="campaign",
        seed=seed,
        tracks=TracksScenario(
            robots=count,
            seed=int(rng.integers(WALKS)),
            area_m=12.0,
            speed_m_s=0.8,
            length_m=float(rng.choice(LENGTHS_M)),
        ),
        robots={name: _robot(rng) for name in names},
        radio=_radio(rng, names),
        core=CoreParameters(place_recognition=PlaceRecognitionParameters(similarity_threshold=0.5)),
        keyframes=KeyframeConfig(distance_m=1.5, rotation_rad=1.2),
        perception=PerceptionConfig(
            method="synthetic", synthetic=NOISELESS if _draws(seed, 2, NOISELESS_RATIO) else NOISY
        ),
        faults=_faults(rng, names),
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


def _faults(rng: np.random.Generator, names: list[str]) -> tuple[Fault, ...]:
    drawn: list[Fault] = []
    for _ in range(int(rng.integers(0, FAULTS_MAX + 1))):
        drawn += _fault(rng, names, round(float(rng.uniform(1.0, FAULTS_END_S - 2.0)), 3))
    calm = [Fault(at_s=FAULTS_END_S, kind=FaultKind.CALM)]
    if rng.uniform() < 0.8:
        calm += [Fault(at_s=FAULTS_END_S, kind=FaultKind.START, robots=tuple(names))]
    return (*sorted(drawn, key=lambda fault: fault.at_s), *calm)


def _fault(rng: np.random.Generator, names: list[str], at_s: float) -> list[Fault]:
    """One fault, with its end where it has one."""
    victim = (str(rng.choice(names)),)
    end_s = round(min(at_s + float(rng.uniform(0.5, 20.0)), FAULTS_END_S), 3)
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
