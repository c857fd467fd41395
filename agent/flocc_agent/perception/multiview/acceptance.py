"""When a registered pair is a loop closure: by what its front end's wrong pairs never have.

A count alone is no evidence: repeated facades give wrong pairs with many correspondences. What separates them is
whether a third image agrees: the neighbour in the three-view refinement that gives the scale, or, where the count is
in doubt, the neighbour registered with the match by itself. The numbers are fitted on all scenes together
(docs/learned.md).
"""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.registration import Registration, RegistrationFailed, RegistrationFailure
from flocc_agent.geometry import angle_rad, inverse
from flocc_agent.perception.multiview.parameters import Rays
from flocc_agent.perception.multiview.two_view import TwoView

Float = NDArray[np.float64]

CELL = 0.15
"""Side of a cell of the picture, as x/z: 9 degrees, a ninth of a 70 degree wide picture."""
ROTATION_AGREES_RAD = float(np.radians(5.0))
"""Both pairs' rotations are right within 1 to 3 degrees where they are right at all."""
DIRECTION_AGREES_RAD = float(np.radians(15.0))


class Neighbour(Enum):
    """What the query's neighbour says of the pair."""

    NOT_ASKED = "not asked"
    SEES_NOTHING = "sees nothing"
    AGREES = "agrees"
    CONTRADICTS = "contradicts"


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a verdict rests on.

    Attributes:
        correspondences: Verified ones of the loop pair.
        has_scale: Whether three views agree on the length.
        cells: Cells of the picture that hold verified correspondences, in the image where they are fewer.
        neighbour: What the neighbour says.
        neighbour_correspondences: Verified ones of the neighbour with the match.
    """

    correspondences: int
    has_scale: bool
    cells: int
    neighbour: Neighbour = Neighbour.NOT_ASKED
    neighbour_correspondences: int = 0


@dataclass(frozen=True, slots=True)
class Needed:
    """What pairs of one kind need.

    Attributes:
        alone: Correspondences that suffice.
        agreeing: Correspondences that suffice where the neighbour agrees.
        cells: Cells of the picture that they must spread over.
    """

    alone: int
    agreeing: int
    cells: int


@dataclass(frozen=True, slots=True)
class Acceptance:
    """A front end's rule.

    Attributes:
        with_scale: What a pair needs whose length three views agree on.
        without_scale: What another one needs.
    """

    with_scale: Needed
    without_scale: Needed

    def needed(self, evidence: Evidence) -> Needed:
        """What a pair of this kind needs."""
        return self.with_scale if evidence.has_scale else self.without_scale

    def needs_neighbour(self, evidence: Evidence) -> bool:
        """Whether the neighbour's word decides."""
        needed = self.needed(evidence)
        return needed.agreeing <= evidence.correspondences < needed.alone and evidence.cells >= needed.cells

    def accepts(self, evidence: Evidence) -> bool:
        """Whether the evidence suffices."""
        needed = self.needed(evidence)
        agrees = evidence.neighbour is Neighbour.AGREES
        enough = needed.agreeing if agrees else needed.alone
        return evidence.correspondences >= enough and evidence.cells >= needed.cells

    def judged(self, result: Registration, evidence: Evidence) -> Registration | RegistrationFailed:
        """The registration, marked as judged, or why it is not trusted."""
        if self.accepts(evidence):
            return replace(result, is_judged=True)
        needed = self.needed(evidence)
        kind = "with" if evidence.has_scale else "without"
        detail = (
            f"{evidence.correspondences} correspondences in {evidence.cells} cells {kind} scale, "
            f"{needed.alone} in {needed.cells} needed; neighbour {evidence.neighbour.value}"
        )
        counts = result.correspondences, result.odometry_correspondences
        return RegistrationFailed(RegistrationFailure.UNCONVINCING, detail, *counts)


def cells(query: Rays, pair: TwoView) -> int:
    """Cells that hold a pair's correspondences, in the image where they are fewer."""
    return min(_cells(query.points[pair.query_indices]), _cells(pair.view.observed))


def _cells(points: NDArray[np.floating]) -> int:
    return len(np.unique(np.floor(points / CELL).astype(np.int64), axis=0))


def evidence_of_neighbour(
    evidence: Evidence, neighbour_pair: TwoView | int, result: Registration, T_neighbour_query: Float
) -> Evidence:
    """The evidence with what the neighbour, registered with the match by itself, says.

    Args:
        evidence: Without the neighbour.
        neighbour_pair: The match as a view of the neighbour, or the count where there is no pose.
        result: The loop pair's pose.
        T_neighbour_query: (4, 4) from odometry, metres.
    """
    if isinstance(neighbour_pair, int):
        return replace(evidence, neighbour=Neighbour.SEES_NOTHING, neighbour_correspondences=neighbour_pair)
    agrees = agree(inverse(neighbour_pair.view.T_view_query), result, T_neighbour_query)
    word = Neighbour.AGREES if agrees else Neighbour.CONTRADICTS
    return replace(evidence, neighbour=word, neighbour_correspondences=neighbour_pair.correspondences)


def agree(T_neighbour_match_unscaled: Float, result: Registration, T_neighbour_query: Float) -> bool:
    """Whether two registrations of one match, of neighbours joined by odometry, can both be right."""
    T = result.T_query_match_unscaled
    R = T_neighbour_query[:3, :3]
    if angle_rad((R @ T[:3, :3]).T @ T_neighbour_match_unscaled[:3, :3]) > ROTATION_AGREES_RAD:
        return False
    along = R @ T[:3, 3]
    if result.scale_initial is not None:
        return _angle(T_neighbour_query[:3, 3] + result.scale_initial * along, T_neighbour_match_unscaled[:3, 3])
    return _is_between(T_neighbour_match_unscaled[:3, 3], T_neighbour_query[:3, 3], along)


def _angle(expected: Float, found: Float) -> bool:
    """Whether two directions agree."""
    lengths = float(np.linalg.norm(expected) * np.linalg.norm(found))
    return float(expected @ found) >= float(np.cos(DIRECTION_AGREES_RAD)) * lengths


def _is_between(found: Float, first: Float, second: Float) -> bool:
    """Whether a direction is one of `first + k second`, k >= 0: the fan that an unknown length leaves."""
    shares = np.linspace(0.0, 1.0, 50)[:, None]
    unit_first, unit_second = (v / max(float(np.linalg.norm(v)), 1e-9) for v in (first, second))
    fan = (1.0 - shares) * unit_first + shares * unit_second
    return any(_angle(direction, found) for direction in fan)
