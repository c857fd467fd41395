"""How surely pictures tell the order of a quaternion: windows of recordings, thresholds chosen without the tested one.

Every window of a recording is read rightly, and with the quaternions moved round by one place either way, as a wrong
header would have them read. A *false word* is a right reading that is refused; a *miss* is a wrong one that is not, or
for which another order than the right one is named. For each recording the two thresholds are chosen anew on all others
(fewest false words, then fewest misses, the middle of those that are as good), and judged on it.

    python -m flocc_lab.bench.picture_orders ../shared/data/street/r1 ../shared/data/sevenscenes
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from flocc_agent.geometry import between
from flocc_agent.perception.watch.camera_verdict import WatchedPair, shows_camera
from flocc_agent.perception.watch.mount_fit import motions_of, trimmed
from flocc_launch.datasets.detect import read_source
from flocc_launch.datasets.picture_check import (
    BETTER_MIN_RATIO,
    ORDERS,
    PREFER_MIN_RATIO,
    WRONG_MIN,
    Float,
    PosedPair,
    least_costs,
    posed_pairs,
    verdict_of,
)
from flocc_launch.datasets.source import Source
from flocc_protocol.errors import FloccError

WINDOW = 60
"""Pictures of a window."""
PLACES = (0, *ORDERS)
"""By how far the numbers of quaternions were moved round before they were read; 0 is right."""
WRONG_TRIED = np.arange(1.0, 12.01, 0.25)
BETTER_TRIED = np.arange(1.25, 6.01, 0.25)


@dataclass(frozen=True, slots=True)
class OrderWindow:
    """What pictures of one window say of a trajectory that was read in one of three orders.

    Attributes:
        places: One of `PLACES`.
        left: (N,) costs as it was read.
        others: (N,) costs of each other order, by the places that bring it there.
    """

    places: int
    left: Float
    others: dict[int, Float]

    def said(self, wrong_min: float, better_min_ratio: float) -> int | None:
        """The order that the two thresholds name, as `picture_check.verdict_of` does."""
        if trimmed(self.left) <= wrong_min:
            return None
        for places, other in self.others.items():
            is_better = better_min_ratio * trimmed(other) < trimmed(self.left)
            if is_better and float(np.mean(other < self.left)) >= PREFER_MIN_RATIO:
                return places
        return None

    def is_wrong(self, wrong_min: float, better_min_ratio: float) -> bool:
        """Whether that is a false word or a miss."""
        return self.said(wrong_min, better_min_ratio) != (-self.places if self.places else None)


@dataclass(frozen=True, slots=True)
class OrdersSeen:
    """A recording's windows.

    Attributes:
        name: Of the recording.
        windows: Three of each window that shows enough.
        silent: Windows that show too little.
        doubts: What else was said of a right reading.
    """

    name: str
    windows: tuple[OrderWindow, ...]
    silent: int
    doubts: tuple[str, ...]

    def wrong(self, thresholds: tuple[float, float]) -> tuple[int, int]:
        """False words and misses."""
        false = sum(w.is_wrong(*thresholds) for w in self.windows if not w.places)
        return false, sum(w.is_wrong(*thresholds) for w in self.windows if w.places)


def windows_of(source: Source, limit: int) -> OrdersSeen:
    """Windows from all over a recording, in each of three orders."""
    trajectory = source.odometry or source.truth
    assert trajectory is not None
    starts = range(0, max(len(source.images) - WINDOW // 2, 1), WINDOW)
    chosen = [starts[k] for k in np.unique(np.linspace(0, len(starts) - 1, min(limit, len(starts))).astype(int))]
    windows, silent, doubts = list[OrderWindow](), 0, list[str]()
    for start in chosen:
        part = replace(source, images=source.images[start : start + WINDOW])
        pairs = posed_pairs(part, trajectory) or []
        if not pairs or not shows_camera([WatchedPair(pair.flow) for pair in pairs]):
            silent += 1
            continue
        windows += [_window(pairs, places) for places in PLACES]
        verdict = verdict_of(pairs)
        if verdict is not None and verdict.camera is not None:
            doubts.append(verdict.camera.fault.value)
    return OrdersSeen(source.path.name, tuple(windows), silent, tuple(doubts))


def _window(pairs: Sequence[PosedPair], places: int) -> OrderWindow:
    seen = [WatchedPair(pair.flow).motion(1.0, False) for pair in pairs]

    def left(moved: int) -> Float:
        given = [
            pair.shifted(moved) if moved else between(pair.flow.T_odom_before, pair.flow.T_odom_now) for pair in pairs
        ]
        return least_costs(motions_of(seen, given))

    return OrderWindow(places, left(places), {order: left(places + order) for order in ORDERS})


def chosen_on(looked: Sequence[OrdersSeen]) -> tuple[float, float]:
    """The middle of the thresholds with the fewest false words, and of those with the fewest misses."""
    tried = [(float(a), float(b)) for a, b in product(WRONG_TRIED, BETTER_TRIED)]
    costs = [tuple(np.sum([each.wrong(pair) for each in looked], axis=0).tolist()) for pair in tried]
    best = np.array([pair for pair, cost in zip(tried, costs, strict=True) if cost == min(costs)])
    return float(np.median(best[:, 0])), float(np.median(best[:, 1]))


def told(looked: Sequence[OrdersSeen]) -> dict[str, object]:
    """A row for each recording: how it fares with flocc's thresholds, and with those chosen without it."""
    rows: dict[str, object] = {}
    for each in looked:
        others = chosen_on([other for other in looked if other is not each])
        right = [float(trimmed(w.left)) for w in each.windows if not w.places]
        wrong = [float(trimmed(w.left)) for w in each.windows if w.places]
        rows[each.name] = {
            "windows": len(right),
            "silent": each.silent,
            "left, right": [round(min(right, default=0), 2), round(max(right, default=0), 2)],
            "left, wrong": [round(min(wrong, default=0), 2), round(max(wrong, default=0), 2)],
            "false, missed": each.wrong((WRONG_MIN, BETTER_MIN_RATIO)),
            "chosen without it": others,
            "false, missed with those": each.wrong(others),
            "doubts": each.doubts,
        }
    return rows


def main() -> None:
    """Print the table as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--windows", type=int, default=5, help="of each recording, at most")
    given = parser.parse_args()
    if len(given.recordings) < 2:
        parser.error("thresholds are chosen on the other recordings: name two at least")
    looked = []
    for path in given.recordings:
        try:
            looked.append(windows_of(replace(read_source(path), path=path), given.windows))
        except FloccError as error:
            sys.stderr.write(f"{error}\n")
    sys.stdout.write(json.dumps(told(looked), indent=1) + "\n")


if __name__ == "__main__":
    main()
