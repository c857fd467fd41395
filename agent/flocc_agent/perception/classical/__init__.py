"""The classical front end: SIFT features, aggregated local descriptors, two- and three-view geometry. No weights."""

from flocc_agent.perception.classical.describer import ClassicalDescriber
from flocc_agent.perception.classical.encoder import ClassicalEncoder
from flocc_agent.perception.classical.sift_registrar import classical_registrar

__all__ = ["ClassicalDescriber", "ClassicalEncoder", "classical_registrar"]
