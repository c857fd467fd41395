"""The composition root: names the concrete perception back-ends, the optimiser and the runtime.

Everything heavy (OpenCV, GTSAM, torch, zenoh) is imported in the function that needs it.
"""

from collections.abc import Callable
from dataclasses import dataclass

from flocc_agent.config import BackendConfig, PerceptionConfig
from flocc_agent.core.interfaces import Describer, Encoder, Image, OdometryPair, Registrar
from flocc_agent.core.pose_graph import GraphSolution, OptimisationFailed, PoseGraph
from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_protocol.arrays import Array

Optimiser = Callable[[PoseGraph, GraphSolution | None], GraphSolution | OptimisationFailed]


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """An image's place descriptor (int8) and its latent."""

    descriptor: Array
    latent: bytes


@dataclass(frozen=True, slots=True)
class Perception:
    """A perception back-end, whole."""

    describer: Describer
    encoder: Encoder
    registrar: Registrar

    def encode(self, image: Image) -> EncodedImage:
        """Describe and encode one image, once per keyframe."""
        return EncodedImage(Array.int8(self.describer.describe(image)), self.encoder.encode(image))

    def register(self, query: bytes, match: bytes, odometry: OdometryPair | None) -> Registration | RegistrationFailed:
        """Register the match's latent with the query's."""
        return self.registrar.register(query, match, odometry)


def build_perception(config: PerceptionConfig, seed: int = 0) -> Perception:
    """Make the configured perception back-end.

    Raises:
        FloccError: A checkpoint or an extra is missing.
    """
    match config.method:
        case "classical":
            from flocc_agent.perception.classical import ClassicalDescriber, ClassicalEncoder, ClassicalRegistrar

            classical = config.classical
            return Perception(ClassicalDescriber(classical), ClassicalEncoder(classical), ClassicalRegistrar(classical))
        case "synthetic":
            from flocc_agent.perception.synthetic import SyntheticPerception

            synthetic = SyntheticPerception(config.synthetic, seed)
            return Perception(synthetic, synthetic, synthetic)
        case "mast3r":
            from flocc_agent.perception.mast3r import build

            return Perception(*build(config.mast3r))


def build_optimiser(config: BackendConfig) -> Optimiser:
    """Make the pose-graph optimiser."""
    from flocc_agent.backend.optimiser import optimise

    return lambda graph, initial: optimise(graph, config, initial)
