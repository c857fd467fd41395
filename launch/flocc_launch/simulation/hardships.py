"""What a campaign does to robots besides a scenario's faults: disks that fail, and names that are taken twice.

They are drawn by the seed as the faults are, and end with them. Of a disk that goes back in time nobody but other
robots can know: the robot then ends its log and begins another one, as `flocc agent` does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import assert_never

import numpy as np

from flocc_launch.simulation.overlays import Overlay
from flocc_launch.simulation.swarm import Swarm

HARDSHIPS_MAX = 2
RATIO = 0.5
"""Share of the seeds that have some."""
TWIN_RATIO, LIAR_RATIO, CLOCK_RATIO, OVERLAY_RATIO = 0.15, 0.1, 0.1, 0.2
CLOCK_STEP_MAX_S = 7200
OVERLAY_FROM_S, OVERLAY_LASTS_S = (0.5, 5.0), (4.0, 12.0)
"""Most robots of small swarms still walk then, and notice with their next keyframe."""


class HardshipKind(StrEnum):
    """What happens to a robot or its disk between two times."""

    OLDER = "older copy"
    FLIPPED = "flipped bit"
    FULL = "full disk"
    SLOW = "slow disk"
    TORN = "power cut"
    TWIN = "second robot of its name"
    LIAR = "a leader that lies"
    CLOCK = "a clock that steps"
    OVERLAY = "something on a camera"


@dataclass(frozen=True, slots=True)
class Hardship:
    """One of them.

    Attributes:
        kind: What.
        robot: To whom.
        from_s: When it begins; an older copy is made then.
        to_s: When it ends; an older copy takes the disk's place then.
        number: Which record, how slow in milliseconds, or by how many seconds a clock steps.
    """

    kind: HardshipKind
    robot: str
    from_s: float
    to_s: float
    number: int = 0


def drawn_hardships(seed: int, names: Sequence[str], end_s: float) -> tuple[Hardship, ...]:
    """Draw what a seed's robots suffer; all of it ends by then."""
    rng = np.random.default_rng([seed, 3])
    drawn = [_drawn(rng, names, end_s) for _ in range(int(rng.integers(1, HARDSHIPS_MAX + 1)))]
    drawn = drawn if rng.uniform() < RATIO else []
    if rng.uniform() < TWIN_RATIO:
        from_s, to_s = _times(rng, end_s)
        drawn.append(Hardship(HardshipKind.TWIN, str(rng.choice(names)), from_s, to_s))
    rng = np.random.default_rng([seed, 4])
    if rng.uniform() < LIAR_RATIO:
        from_s, to_s = _times(rng, end_s)
        drawn.append(Hardship(HardshipKind.LIAR, str(rng.choice(names)), from_s, to_s))
    rng = np.random.default_rng([seed, 6])
    if rng.uniform() < CLOCK_RATIO:
        from_s, to_s = _times(rng, end_s)
        step_s = round(math.exp(rng.uniform(0.0, math.log(CLOCK_STEP_MAX_S))))
        drawn.append(Hardship(HardshipKind.CLOCK, str(rng.choice(names)), from_s, to_s, step_s))
    rng = np.random.default_rng([seed, 7])
    if rng.uniform() < OVERLAY_RATIO:
        from_s = round(float(rng.uniform(*OVERLAY_FROM_S)), 3)
        to_s = round(from_s + float(rng.uniform(*OVERLAY_LASTS_S)), 3)
        drawn.append(Hardship(HardshipKind.OVERLAY, str(rng.choice(names)), from_s, to_s))
    return tuple(sorted(drawn, key=lambda hardship: hardship.from_s))


def _drawn(rng: np.random.Generator, names: Sequence[str], end_s: float) -> Hardship:
    apart = (HardshipKind.TWIN, HardshipKind.LIAR, HardshipKind.CLOCK, HardshipKind.OVERLAY)
    kinds = [kind for kind in HardshipKind if kind not in apart]
    kind = kinds[int(rng.integers(len(kinds)))]
    from_s, to_s = _times(rng, end_s)
    return Hardship(kind, str(rng.choice(names)), from_s, to_s, int(rng.integers(20, 600)))


def _times(rng: np.random.Generator, end_s: float) -> tuple[float, float]:
    from_s, to_s = sorted(rng.uniform(1.0, end_s - 1.0, size=2))
    return round(float(from_s), 3), round(float(to_s), 3)


def endure(swarm: Swarm, hardships: Sequence[Hardship]) -> None:
    """Enter all of it into a swarm's agenda."""
    for hardship in hardships:
        _enter(swarm, hardship)


def _enter(swarm: Swarm, hardship: Hardship) -> None:
    station = swarm.stations[hardship.robot]

    def at(time_s: float, what: str) -> None:
        swarm.agenda.at(time_s, lambda: getattr(swarm, what)(hardship.robot))

    match hardship.kind:
        case HardshipKind.OLDER:
            swarm.agenda.at(hardship.from_s, lambda: swarm.copy_disk(hardship.robot, hardship.to_s))
        case HardshipKind.FLIPPED:
            swarm.agenda.at(hardship.to_s, lambda: swarm.flip_bit(hardship.robot, hardship.number))
        case HardshipKind.FULL:
            swarm.agenda.at(hardship.from_s, lambda: station.disk.fill(True))
            swarm.agenda.at(hardship.to_s, lambda: station.disk.fill(False))
        case HardshipKind.SLOW:
            swarm.agenda.at(hardship.from_s, lambda: setattr(station.disk, "slow_s", hardship.number / 1000))
            swarm.agenda.at(hardship.to_s, lambda: setattr(station.disk, "slow_s", 0.0))
        case HardshipKind.TORN:
            at(hardship.to_s, "cut_power")
        case HardshipKind.TWIN:
            at(hardship.from_s, "add_twin")
            swarm.agenda.at(hardship.to_s, lambda: swarm.kill(f"{hardship.robot}-twin"))
        case HardshipKind.LIAR:
            swarm.agenda.at(hardship.from_s, lambda: setattr(station, "lies", True))
            at(hardship.to_s, "mend")
        case HardshipKind.CLOCK:
            swarm.agenda.at(hardship.to_s, lambda: station.step_clock(float(hardship.number)))
        case HardshipKind.OVERLAY:
            overlay = station.workers.overlay = Overlay()
            swarm.agenda.at(hardship.from_s, lambda: setattr(overlay, "is_there", True))
            swarm.agenda.at(hardship.to_s, lambda: setattr(overlay, "is_there", False))
        case _:
            assert_never(hardship.kind)
