"""What a closure of learned features needs, by model; fitted on all scenes together (docs/learned.md)."""

from flocc_agent.perception.multiview.acceptance import Acceptance, Needed
from flocc_agent.perception.multiview.view_parameters import Geometry

GEOMETRY = Geometry()
ACCEPTANCE = {
    "aliked-lightglue": Acceptance(Needed(40, 20, 0.017), Needed(80, 30, 0.017), 0.3),
    "xfeat-lighterglue": Acceptance(Needed(40, 20, 0.017), Needed(80, 30, 0.017), 0.3),
}
