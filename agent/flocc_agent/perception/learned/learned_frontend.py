"""Encoder and Registrar of the learned front end; places are described by the classical describer.

VLAD over the learned features recognises fewer places than the classical descriptor, whose projection is learnt from
pairs of views (docs/learned.md has the figures); it would cost no less on the wire.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from flocc_agent.config import ClassicalConfig, LearnedConfig
from flocc_agent.core.interfaces import Describer, Encoder, Image, Registrar
from flocc_agent.perception.classical.describer import ClassicalDescriber
from flocc_agent.perception.latent import pack, unpack
from flocc_agent.perception.learned.acceptance_by_model import ACCEPTANCE, GEOMETRY
from flocc_agent.perception.learned.keypoints import (
    POSITION_STEPS,
    SIDE_MAX_PX,
    LearnedFeatures,
    read_features,
    write_features,
)
from flocc_agent.perception.learned.networks import VARIANTS, Networks
from flocc_agent.perception.learned.weight_sources import weights_folder
from flocc_agent.perception.multiview.picture import at_pixels, reduced_to
from flocc_agent.perception.multiview.registrar import PairRegistrar
from flocc_agent.perception.torch_device import choose_device

PIXELS_MAX = 307_200
"""Larger images are shrunk to 640x480: what the networks were made for, and what bounds their time and memory."""


GREY = 127
EDGE_PX = 9
"""What is hidden is painted over; the edge of the paint has features that are none."""


class LearnedEncoder:
    """Image to latent: its features."""

    def __init__(self, networks: Networks) -> None:
        self._networks = networks

    @property
    def model(self) -> str:
        """Identity of the networks' weights; latents of one identity can be registered with each other."""
        return self._networks.variant.identity

    def encode(self, image: Image) -> bytes:
        """Compute the latent of an image."""
        picture = reduced_to(image.pixels, PIXELS_MAX, SIDE_MAX_PX)
        height, width = picture.shape[:2]
        if image.hidden is not None:
            hidden = cv2.resize(image.hidden.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
            picture = np.where(hidden[..., None], np.uint8(GREY), picture)
        pixels, descriptors = self._networks.detect(picture)
        if image.hidden is not None:
            shown = ~at_pixels(_with_edge(hidden), pixels)
            pixels, descriptors = pixels[shown], descriptors[shown]
        return write_features(self.model, pixels, descriptors, (width, height), image.camera, image.up)

    def without(self, latent: bytes, hidden: NDArray[np.bool_]) -> bytes:
        """Give a latent of its own without the features at hidden pixels (H, W) of the camera's picture."""
        content = unpack(latent, self.model)
        width, height = content.header["size_px"]
        reduced = cv2.resize(hidden.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
        pixels = content.arrays["pixels"].astype(np.float64) / POSITION_STEPS
        shown = ~at_pixels(_with_edge(reduced), pixels)
        return pack(self.model, content.header, {name: array[shown] for name, array in content.arrays.items()})


def _with_edge(hidden: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What is hidden, and what the edge of the paint over it may look like a feature to."""
    return np.asarray(cv2.dilate(hidden.astype(np.uint8), np.ones((EDGE_PX, EDGE_PX), np.uint8)) > 0)


def build(config: LearnedConfig) -> tuple[Describer, Encoder, Registrar]:
    """Load the networks and give the three parts that the runtime asks for.

    Raises:
        BadWeights: A file is missing or is not the expected one, or the device is not there.
    """
    variant = VARIANTS[config.model]
    networks = Networks(variant, config.weights or weights_folder(), choose_device(config.device))

    def read(latent: bytes) -> LearnedFeatures:
        return read_features(latent, variant.identity, variant.descriptor_length)

    rule = ACCEPTANCE[variant.name] if config.acceptance == "fitted" else None
    registrar = PairRegistrar(read, networks.match, GEOMETRY, rule)
    return ClassicalDescriber(ClassicalConfig()), LearnedEncoder(networks), registrar
