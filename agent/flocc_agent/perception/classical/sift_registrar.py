"""The classical front end's registrar: mutual nearest neighbours of SIFT, and what a closure of them needs."""

import cv2

from flocc_agent.config import ClassicalConfig
from flocc_agent.perception.classical.encoder import decode_features
from flocc_agent.perception.classical.features import Features
from flocc_agent.perception.classical.matching import mutual_matches
from flocc_agent.perception.multiview.acceptance import NEVER, Acceptance, Needed
from flocc_agent.perception.multiview.registrar import PairRegistrar
from flocc_agent.perception.multiview.view_parameters import Geometry, Matched

DISTANCE_RATIO_MAX = 0.8
"""Lowe's ratio, as in his paper: lower keeps fewer and surer matches."""
ROTATION_SIGMA_MAX_RAD = 0.007
UPRIGHT = Needed(NEVER, 20, 0.014)
"""Chosen on pairs beyond 30 degrees of street, herz_jesu and the town (`flocc_lab.bench.gravity`)."""
ACCEPTANCE = Acceptance(Needed(30, 15, ROTATION_SIGMA_MAX_RAD), Needed(60, 30, ROTATION_SIGMA_MAX_RAD), 0.4, UPRIGHT)
"""Fitted on all scenes together: docs/classical.md has the command and what it keeps of scenes that were left out."""


def classical_registrar(config: ClassicalConfig) -> PairRegistrar[Features]:
    """Make the registrar of classical latents."""
    cv2.setNumThreads(1)

    def match(first: Features, second: Features) -> Matched:
        return mutual_matches(first.descriptors, second.descriptors, DISTANCE_RATIO_MAX)

    acceptance = ACCEPTANCE if config.acceptance == "fitted" else None
    return PairRegistrar(decode_features, match, Geometry(correspondences_min=config.correspondences_min), acceptance)
