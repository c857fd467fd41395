"""What a closure of learned features needs, by model; docs/learned.md has the scenes and what is kept of them.

XFeat's numbers are fitted (60), then raised to 80 since a whole run on street accepted a false closure of 61;
ALIKED's are set by hand, and were raised from 60 and 40: a whole run on street accepted five false ones of 61 to 143,
of which neighbours confirmed those of 61 and 78 and contradicted those of 66, 129 and 143. What suffices with gravity
was measured for XFeat only (`flocc_lab.bench.gravity`).

Their wrong pairs have as many correspondences as right ones (repeated facades, the other side of a street), but the
odometry neighbour contradicts them, so it is asked nearly always.
"""

from flocc_agent.perception.multiview.acceptance import NEVER, Acceptance, Needed
from flocc_agent.perception.multiview.view_parameters import Geometry

GEOMETRY = Geometry()
NO_RATIO = float("inf")
"""Eq. (1) alone suffices nowhere: with a poor odometry pair ALIKED's wrong pairs reach 2.7."""
ACCEPTANCE = {
    "aliked-lightglue": Acceptance(Needed(200, 80, 0.0087), Needed(NEVER, 80, 0.007), NO_RATIO),
    "xfeat-lighterglue": Acceptance(
        Needed(NEVER, 80, 0.0087), Needed(NEVER, 80, 0.007), 0.4, upright=Needed(NEVER, 40, 0.0087)
    ),
}
