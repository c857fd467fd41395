"""Which pairs of keyframes the report shows as pictures: what can be learnt from comes first."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from flocc_launch.runs.closure_table import Pair
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.right_closures import verdicts
from flocc_protocol.ids import KeyframeId, LogId

PAIRS_SHOWN = 24
VIEWS_PER_ROBOT = 6
VIEWS_MAX = 48


class Fate(Enum):
    """What became of a pair, in the order of the page."""

    WRONG = "Accepted, and wrong by ground truth"
    UNUSED = "Accepted, and rejected by the solver"
    REFUSED = "Looked alike, and rejected"
    ACCEPTED = "Accepted"


@dataclass(frozen=True, slots=True)
class ShownPair:
    """A pair that is worth a picture.

    Attributes:
        pair: The pair.
        fate: What became of it.
        right: Whether it is right by ground truth; None where that is not known.
    """

    pair: Pair
    fate: Fate
    right: bool | None

    @property
    def name(self) -> str:
        """Its name within the page."""
        return f"pair-{anchor(self.pair.query)}-{anchor(self.pair.match)}"


def anchor(keyframe: KeyframeId) -> str:
    """A keyframe as part of a name within the page."""
    return str(keyframe).replace("/", ".").replace("~", "..")


def shown_pairs(loaded: LoadedRun, pairs_max: int = PAIRS_SHOWN) -> list[ShownPair]:
    """At most so many pairs: every fate gets an equal share, and what one does not need goes to the others.

    Within a fate the surprising ones come first: wrong and refused ones with a high ratio, accepted ones with a low.
    """
    right = verdicts(loaded)
    found: dict[Fate, list[ShownPair]] = {fate: [] for fate in Fate}
    for pair in loaded.pairs:
        known = right.get((pair.query, pair.match))
        fate = fate_of(pair, known)
        if fate is not None:
            found[fate].append(ShownPair(pair, fate, known))
    for fate, shown in found.items():
        sign = 1.0 if fate is Fate.ACCEPTED else -1.0
        shown.sort(key=lambda each: (sign * (each.pair.ratio or 0.0), each.name))
    counts = shares([len(shown) for shown in found.values()], pairs_max)
    return [each for shown, count in zip(found.values(), counts, strict=True) for each in shown[:count]]


def fate_of(pair: Pair, right: bool | None) -> Fate | None:
    """What became of a pair; None of one that nobody registered or that gave no ratio."""
    if pair.accepted:
        return Fate.WRONG if right is False else Fate.UNUSED if pair.used is False else Fate.ACCEPTED
    return Fate.REFUSED if pair.rejected and pair.ratio else None


def shares(wanted: Sequence[int], total_max: int) -> list[int]:
    """Divide a total as evenly as the wishes allow; what is left over goes to the first ones."""
    given = [0] * len(wanted)
    for _ in range(total_max):
        open_ = [k for k in range(len(wanted)) if given[k] < wanted[k]]
        if not open_:
            break
        given[min(open_, key=lambda k: given[k])] += 1
    return given


def views(loaded: LoadedRun) -> list[KeyframeId]:
    """Keyframes along each robot's way, at even distances, at most `VIEWS_MAX` of all robots together."""
    robots = [robot for robot, track in loaded.tracks.items() if len(track)]
    each = min(VIEWS_PER_ROBOT, VIEWS_MAX // max(len(robots), 1))
    found: list[KeyframeId] = []
    for robot in robots if each else ():
        track = loaded.tracks[robot]
        log = LogId(robot, track.incarnation)
        found += [KeyframeId(log, k) for k in evenly(track.T_odom_body[:, :3, 3], each)]
    return found


def evenly(positions_m: NDArray[np.float64], count: int) -> list[int]:
    """Indices of so many positions (N, 3) at even distances along their way, the first among them."""
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    wanted_m = (np.arange(count) / count) * along_m[-1]
    return sorted({int(np.argmin(np.abs(along_m - at_m))) for at_m in wanted_m})


def keyframes_of(shown: Iterable[ShownPair]) -> list[KeyframeId]:
    """All keyframes of the pairs, each once, sorted."""
    return sorted({keyframe for each in shown for keyframe in (each.pair.query, each.pair.match)})
