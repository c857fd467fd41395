"""What a closure of learned features needs, by model; fitted on all scenes together (docs/learned.md)."""

from flocc_agent.perception.multiview.acceptance import NEVER, Acceptance, Needed
from flocc_agent.perception.multiview.view_parameters import Geometry

GEOMETRY = Geometry()
ROTATION_SIGMA_MAX_RAD = 0.007
ACCEPTANCE = {
    "aliked-lightglue": Acceptance(
        Needed(130, 40, ROTATION_SIGMA_MAX_RAD), Needed(NEVER, 60, ROTATION_SIGMA_MAX_RAD), 0.4
    ),
    "xfeat-lighterglue": Acceptance(
        Needed(130, 40, ROTATION_SIGMA_MAX_RAD), Needed(NEVER, 60, ROTATION_SIGMA_MAX_RAD), 0.4
    ),
}
