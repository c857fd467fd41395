"""Maps that fell apart though all that was measured between them roughly agrees.

Few closures between two maps do not tell how exact they are. Where their errors are larger than stated, the first one
swings the other map about, the next one seems wrong, and one alone joins nothing: both maps are lost to each other. So
they are asked once more, with larger errors, and believed only where all of them agree then. Those without a length say
less, and two wrong ones may agree so far by chance: there must be one more of them.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from flocc_agent.backend.alarms import compared, said_by
from flocc_agent.backend.filtering import Filtered
from flocc_agent.backend.pair_closures import Way, by_logs, measured
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import LoopClosure
from flocc_protocol.ids import KeyframeId, LogId

UNDERSTATED_SIGMAS = 3.0
"""So many times larger than stated errors may be."""


def less_exact(whole: Filtered, parted: Filtered, config: BackendConfig) -> dict[int, LoopClosure]:
    """Closures between maps that fell apart, with larger errors; none of maps between which one does not fit.

    Args:
        whole: A component and its closures.
        parted: What was left of it once those that disagree were turned away.
        config: The noise model.
    """
    found: dict[int, LoopClosure] = {}
    for of_robots in _across(whole.taking_part, parted.groups):
        every = [k for ids in of_robots for k in ids]
        is_stated = all(k not in whole.held and whole.closures[k].covariance is not None for k in every)
        without_length = not all(whole.taking_part[k].metric for k in every)
        if (
            is_stated
            and len(every) >= whole.closures_min + without_length
            and all(_agree(whole, ids, config) for ids in of_robots)
        ):
            found |= {k: _less_exact(whole.closures[k]) for k in every}
    return found


def _agree(whole: Filtered, ids: list[int], config: BackendConfig) -> bool:
    """Whether each closure of two robots agrees with the next one, within errors that are larger."""
    c, k = measured(ids, whole.closures, config), np.arange(len(ids) - 1)
    low, high = (Way.of(whole.trajectories[end.log], config) for end in _ends(whole.closures[ids[0]]))
    bound = UNDERSTATED_SIGMAS**2 * float(chdtri(6.0, 1.0 - config.inlier_probability))
    return bool(np.all(compared(c, k, *said_by(low, high, c, k, k + 1)).squared <= bound))


def _ends(closure: LoopClosure) -> tuple[KeyframeId, KeyframeId]:
    return min(closure.query, closure.match), max(closure.query, closure.match)


def _across(closures: Mapping[int, LoopClosure], groups: tuple[tuple[LogId, ...], ...]) -> list[list[list[int]]]:
    """Of each two groups the closures between them, apart for each two robots."""
    group = {log: n for n, logs in enumerate(groups) for log in logs}
    found: dict[frozenset[int], list[list[int]]] = {}
    for (a, b), ids in by_logs(closures).items():
        if group[a] != group[b]:
            found.setdefault(frozenset((group[a], group[b])), []).append(ids)
    return list(found.values())


def _less_exact(closure: LoopClosure) -> LoopClosure:
    return replace(closure, covariance=UNDERSTATED_SIGMAS**2 * np.asarray(closure.covariance))


def sentence(closures: Mapping[int, LoopClosure]) -> str:
    """What people are told."""
    robots = sorted({end.log.robot for c in closures.values() for end in (c.query, c.match)})
    return (
        f"robots {', '.join(robots)}: the {len(closures)} closures between their maps agree only if errors are larger "
        f"than stated, and were used with {UNDERSTATED_SIGMAS:.0f} times their standard deviations"
    )
