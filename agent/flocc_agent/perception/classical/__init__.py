"""The classical front end: SIFT, aggregated local descriptors, two- and three-view geometry. No weights needed."""

from flocc_agent.perception.classical.describer import ClassicalDescriber
from flocc_agent.perception.classical.encoder import ClassicalEncoder
from flocc_agent.perception.classical.registrar import ClassicalRegistrar

__all__ = ["ClassicalDescriber", "ClassicalEncoder", "ClassicalRegistrar"]
