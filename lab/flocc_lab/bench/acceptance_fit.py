"""Fits a front end's rule for closures on all scenes together, and judges it on each scene by the others' rule.

A rule keeps the most right pairs among those that keep hardly a wrong one, also where wrong ones had more evidence by a
margin than they happened to have here.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from flocc_agent.core.registration import match_ratio
from flocc_agent.perception.classical import sift_registrar as classical_registrar
from flocc_agent.perception.learned import acceptance_by_model
from flocc_agent.perception.multiview.acceptance import (
    NEVER,
    RATIO_CORRESPONDENCES_MIN,
    Acceptance,
    Evidence,
    Needed,
    OdometryNeighbour,
)
from flocc_lab.bench.acceptance_rows import ANGLES_DEG, AcceptanceRow

ALONE = (15, 20, 25, 30, 40, 50, 60, 80, 100, 130, 160, 200, NEVER)
AGREEING = (15, 20, 25, 30, 40, 50, 60, 80, 100, NEVER)
SIGMAS_DEG = (0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.7)
WRONG_COST = 50
"""Right pairs that one wrong pair outweighs in the fit: at most 2 % wrong among the pairs that a step adds."""
MARGINS = (1.15, 1.25, 1.35, 1.5)
"""A wrong pair counts with this many times its correspondences and certainty: another scene's may have more. The first
that keeps at most `WRONG_RATIO_MAX` wrong ones of the scenes left out, and one of each scene, is taken."""
WRONG_RATIO_MAX, WRONG_OF_SCENE_MAX = 0.01, 1
RATIOS = (0.2, 0.25, 0.3, 0.4, 0.5, 10.0)
RATIO_MIN = 0.3
"""The paper's rule, for comparison."""


@dataclass(frozen=True, slots=True)
class Kept:
    """What a rule keeps of some pairs."""

    right: int
    wrong: int
    possible: int
    """Right ones before the rule."""


def fitted(rows: Sequence[AcceptanceRow], margin: float) -> Acceptance:
    """The rule that fits these rows: the ratio first, then each kind of what it leaves."""
    posed = [(row, row.evidence) for row in rows if row.evidence is not None]
    ratio_min = max(RATIOS, key=lambda ratio: (ratio_score(rows, ratio, margin), ratio))
    left = [(row, e.has_scale) for row, e in posed if not has_ratio(row, ratio_min)]
    with_scale = best_needed([row for row, has_scale in left if has_scale], margin)
    without_scale = best_needed([row for row, has_scale in left if not has_scale], margin, no_less=with_scale)
    return Acceptance(with_scale, without_scale, ratio_min)


def ratio_score(rows: Sequence[AcceptanceRow], ratio_min: float, margin: float) -> int:
    """Right pairs that a threshold of Eq. (1) keeps, less what the wrong ones cost."""
    right = sum(row.is_right and has_ratio(row, ratio_min) for row in rows)
    return right - WRONG_COST * sum(not row.is_right and has_ratio(row, ratio_min / margin) for row in rows)


def has_ratio(row: AcceptanceRow, ratio_min: float) -> bool:
    """Whether the paper's rule accepts a pair with this threshold."""
    ratio = match_ratio(row.correspondences, row.odometry_correspondences)
    return row.evidence is not None and row.correspondences >= RATIO_CORRESPONDENCES_MIN and ratio >= ratio_min


def best_needed(rows: Sequence[AcceptanceRow], margin: float, no_less: Needed | None = None) -> Needed:
    """The numbers for one kind of pair that keep the most right ones, wrong ones outweighing many; ties go high.

    Args:
        rows: Of that kind.
        margin: With how many times their evidence wrong ones count.
        no_less: What another kind needs of which more is known: a pair without a third view that agrees has not shown
            as much, and scenes without places that look alike do not tell that.
    """
    table = AcceptanceTable(rows, margin)
    scored = [
        (table.score(needed), needed.alone, needed.agreeing, -needed.rotation_sigma_max_rad, needed)
        for needed in choices()
        if no_less is None or (needed.alone >= no_less.alone and needed.agreeing >= no_less.agreeing)
    ]
    return max(scored, key=lambda entry: entry[:4])[4]


def choices() -> Iterator[Needed]:
    """All rules that are tried."""
    return (Needed(a, g, float(np.radians(s))) for a in ALONE for g in AGREEING if g <= a for s in SIGMAS_DEG)


class AcceptanceTable:
    """Rows of one kind as arrays, for trying many rules."""

    def __init__(self, rows: Sequence[AcceptanceRow], margin: float) -> None:
        evidence = [row.evidence for row in rows if row.evidence is not None]
        self._right = np.array([row.is_right for row in rows], bool)
        factor = np.where(self._right, 1.0, margin)
        self._count = np.array([e.correspondences for e in evidence]) * factor
        self._sigma_rad = np.array([e.rotation_sigma_rad for e in evidence]) / factor
        self._agrees = np.array([e.neighbour is OdometryNeighbour.AGREES for e in evidence], bool)

    def score(self, needed: Needed) -> int:
        """Right pairs kept, less what the wrong ones cost."""
        least = np.where(self._agrees, needed.agreeing, needed.alone)
        kept = (self._count >= least) & (self._sigma_rad <= needed.rotation_sigma_max_rad)
        return int((kept & self._right).sum()) - WRONG_COST * int((kept & ~self._right).sum())


def kept(rows: Sequence[AcceptanceRow], rule: Acceptance | None) -> Kept:
    """What a rule keeps; None is the paper's, Eq. (1) against R_thr."""
    accepted = [row for row in rows if accepts(row, rule)]
    right = sum(row.is_right for row in accepted)
    return Kept(right, len(accepted) - right, sum(row.is_right for row in rows))


def accepts(row: AcceptanceRow, rule: Acceptance | None) -> bool:
    """Whether a rule accepts a pair; the neighbour is heard only where the rule asks it."""
    if row.evidence is None:
        return False
    if rule is None:
        return has_ratio(row, RATIO_MIN)
    return rule.accepts(heard(row.evidence, rule))


def heard(evidence: Evidence, rule: Acceptance) -> Evidence:
    """The evidence as the registrar would have it."""
    return evidence if rule.needs_neighbour(evidence) else replace(evidence, neighbour=OdometryNeighbour.NOT_ASKED)


def leave_one_out(rows: Sequence[AcceptanceRow], margin: float) -> dict[str, Kept]:
    """By scene: what the rule of all other scenes keeps of it."""
    names = sorted({row.scene for row in rows})
    return {
        name: kept(
            [row for row in rows if row.scene == name], fitted([row for row in rows if row.scene != name], margin)
        )
        for name in names
    }


def chosen_margin(rows: Sequence[AcceptanceRow]) -> tuple[float, dict[str, Kept]]:
    """The smallest margin with few wrong pairs in scenes left out, or the largest, and what is kept of them."""
    left_out: dict[str, Kept] = {}
    for margin in MARGINS:
        left_out = leave_one_out(rows, margin)
        found = list(left_out.values())
        wrong, kept_all = sum(each.wrong for each in found), sum(each.right + each.wrong for each in found)
        is_each_few = all(each.wrong <= WRONG_OF_SCENE_MAX for each in found)
        if is_each_few and wrong <= WRONG_RATIO_MAX * kept_all:
            break
    return margin, left_out


def by_angle(rows: Sequence[AcceptanceRow], rule: Acceptance | None) -> list[Kept]:
    """What a rule keeps, by the angle between the viewing directions."""
    return [kept([row for row in rows if low <= row.angle_deg < high], rule) for low, high in pairwise(ANGLES_DEG)]


def rule_in_use(front_end: str) -> Acceptance:
    """The rule that a front end ships with."""
    return classical_registrar.ACCEPTANCE if front_end == "classical" else acceptance_by_model.ACCEPTANCE[front_end]


def report(rows: Sequence[AcceptanceRow], in_use: Acceptance) -> dict[str, Any]:
    """The rule of all scenes, and tables by scene and angle, for the paper's rule, both others and leave-one-out."""
    margin, left_out = chosen_margin(rows)
    rule = fitted(rows, margin)
    return {
        "rule": {
            "with_scale": _plain(rule.with_scale),
            "without_scale": _plain(rule.without_scale),
            "match_ratio_min": rule.match_ratio_min,
            "margin": margin,
        },
        "pairs": len(rows),
        "scenes": {
            name: {
                "pairs": sum(row.scene == name for row in rows),
                "by_ratio": _plain(kept([row for row in rows if row.scene == name], None)),
                "in_use": _plain(kept([row for row in rows if row.scene == name], in_use)),
                "fitted": _plain(kept([row for row in rows if row.scene == name], rule)),
                "left_out": _plain(left_out[name]),
            }
            for name in left_out
        },
        "angles": {
            f"{low:.0f}-{min(high, 180.0):.0f}": {
                "by_ratio": _plain(ratio),
                "in_use": _plain(used),
                "fitted": _plain(by_rule),
            }
            for (low, high), ratio, used, by_rule in zip(
                pairwise(ANGLES_DEG),
                by_angle(rows, None),
                by_angle(rows, in_use),
                by_angle(rows, rule),
                strict=True,
            )
        },
    }


def text(name: str, found: dict[str, Any]) -> str:
    """A report as lines for people: right/wrong of possible."""
    rule = found["rule"]
    lines = [f"{name}: {found['pairs']} pairs; with scale {rule['with_scale']}"]
    lines.append(f"  without {rule['without_scale']}, ratio {rule['match_ratio_min']}, margin {rule['margin']}")
    totals = {key: [0, 0, 0] for key in ("by_ratio", "in_use", "fitted", "left_out")}
    for scene, entry in found["scenes"].items():
        shown = []
        for key, total in totals.items():
            counts = [entry[key][part] for part in ("right", "wrong", "possible")]
            totals[key] = [a + b for a, b in zip(total, counts, strict=True)]
            shown.append(f"{key} {counts[0]}+{counts[1]}w")
        lines.append(f"  {scene:16} {entry['pairs']:5} pairs, possible {counts[2]:4}: {', '.join(shown)}")
    lines.append("  all: " + ", ".join(f"{key} {t[0]}+{t[1]}w of {t[2]}" for key, t in totals.items()))
    for angle, entry in found["angles"].items():
        shown = [f"{key} {entry[key]['right']}+{entry[key]['wrong']}w" for key in ("by_ratio", "in_use", "fitted")]
        lines.append(f"  {angle:8} possible {entry['fitted']['possible']:4}: {', '.join(shown)}")
    return "\n".join(lines)


def _plain(value: Needed | Kept) -> dict[str, Any]:
    return {name: getattr(value, name) for name in value.__slots__}
