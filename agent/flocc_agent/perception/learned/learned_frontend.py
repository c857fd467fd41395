"""Describer, Encoder and Registrar of the learned front end: one search for features serves descriptor and latent."""

import threading
from collections import OrderedDict

import numpy as np
import torch
from numpy.typing import NDArray

from flocc_agent.config import LearnedConfig
from flocc_agent.core.interfaces import Describer, Encoder, Image, Registrar
from flocc_agent.perception.learned.acceptance_by_model import ACCEPTANCE, GEOMETRY
from flocc_agent.perception.learned.keypoint_codebook import load_codebook
from flocc_agent.perception.learned.keypoints import SIDE_MAX_PX, LearnedFeatures, read_features, write_features
from flocc_agent.perception.learned.networks import VARIANTS, Networks
from flocc_agent.perception.learned.weight_sources import BadWeights, weights_folder
from flocc_agent.perception.multiview.picture import reduced_to
from flocc_agent.perception.multiview.registrar import PairRegistrar

Float32 = NDArray[np.float32]

PIXELS_MAX = 307_200
"""Larger images are shrunk to 640x480: what the networks were made for, and what bounds their time and memory."""
SEARCHES_KEPT_MAX = 4
"""Images whose features wait for the encoder after the describer took them."""


class FeatureSearch:
    """Finds an image's features once, for the describer and for the encoder."""

    def __init__(self, networks: Networks) -> None:
        self._networks = networks
        self._found: OrderedDict[int, tuple[Image, tuple[int, int], Float32, Float32]] = OrderedDict()
        self._lock = threading.Lock()

    def of(self, image: Image) -> tuple[tuple[int, int], Float32, Float32]:
        """Size of the searched picture, positions (N, 2) in it and descriptors (N, D)."""
        with self._lock:
            known = self._found.get(id(image))
            if known is not None and known[0] is image:
                return known[1:]
        picture = reduced_to(image.pixels, PIXELS_MAX, SIDE_MAX_PX)
        height, width = picture.shape[:2]
        pixels, descriptors = self._networks.detect(picture)
        with self._lock:
            self._found[id(image)] = (image, (width, height), pixels, descriptors)
            while len(self._found) > SEARCHES_KEPT_MAX:
                self._found.popitem(last=False)
        return (width, height), pixels, descriptors


class LearnedDescriber:
    """Image to global place descriptor: its features, aggregated."""

    def __init__(self, search: FeatureSearch, model: str) -> None:
        self._search = search
        self._codebook = load_codebook(model)

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        return self._codebook.dimension

    def describe(self, image: Image) -> Float32:
        """Compute a (D,) float32 descriptor of unit length; all images without features share one."""
        return self._codebook.describe(self._search.of(image)[2])


class LearnedEncoder:
    """Image to latent: its features."""

    def __init__(self, search: FeatureSearch, model: str) -> None:
        self._search = search
        self._model = model

    @property
    def model(self) -> str:
        """Identity of the networks' weights; latents of one identity can be registered with each other."""
        return self._model

    def encode(self, image: Image) -> bytes:
        """Compute the latent of an image."""
        size_px, pixels, descriptors = self._search.of(image)
        return write_features(self._model, pixels, descriptors, size_px, image.camera)


def build(config: LearnedConfig) -> tuple[Describer, Encoder, Registrar]:
    """Load the networks and give the three parts that the runtime asks for.

    Raises:
        BadWeights: A file is missing or is not the expected one, or the device is not there.
    """
    variant = VARIANTS[config.model]
    networks = Networks(variant, config.weights or weights_folder(), device_of(config.device))
    search = FeatureSearch(networks)

    def read(latent: bytes) -> LearnedFeatures:
        return read_features(latent, variant.identity, variant.descriptor_length)

    rule = ACCEPTANCE[variant.name] if config.acceptance == "fitted" else None
    registrar = PairRegistrar(read, networks.match, GEOMETRY, rule)
    return LearnedDescriber(search, variant.name), LearnedEncoder(search, variant.identity), registrar


def device_of(name: str) -> torch.device:
    """The device asked for, or the best there is.

    Raises:
        BadWeights: The device asked for is not there.
    """
    available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if name == "auto":
        return torch.device(next(kind for kind, there in available.items() if there))
    if not available[name]:
        raise BadWeights(f"perception.learned.device: torch has no '{name}' on this machine")
    return torch.device(name)
