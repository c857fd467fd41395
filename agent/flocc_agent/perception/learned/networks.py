"""ALIKED, XFeat and LightGlue from kornia's classes and pinned weight files: pictures to features, features to matches.

Kornia's own loaders download; these read files whose hash is checked, with `weights_only`.
"""

import pickle
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.feature.aliked.aliked import ALIKED
from kornia.feature.lightglue import LightGlue
from kornia.feature.xfeat import XFeat
from numpy.typing import NDArray
from torch import Tensor, nn

from flocc_agent.perception.learned.keypoints import FEATURES_MAX, LearnedFeatures
from flocc_agent.perception.learned.weight_sources import (
    ALIKED_LIGHTGLUE,
    ALIKED_N16ROT,
    XFEAT_FEATURES,
    XFEAT_LIGHTERGLUE,
    BadWeights,
    WeightFile,
    checked,
)
from flocc_agent.perception.multiview.view_parameters import Matched

Float32 = NDArray[np.float32]

DERIVED = ("dkd.hw_grid", "confidence_thresholds")
"""Buffers that the classes compute themselves; nothing else may be missing from a file."""
LIGHTERGLUE = {
    "input_dim": 64,
    "descriptor_dim": 96,
    "n_layers": 6,
    "num_heads": 1,
    "depth_confidence": -1,
    "width_confidence": 0.95,
}
"""LighterGlue's sizes, as published with XFeat; LightGlue's are the class's own."""
HASH_DIGITS = 8
LENGTH_MIN = 1e-9


@dataclass(frozen=True, slots=True)
class Variant:
    """One model that users choose.

    Attributes:
        name: As `perception.learned.model` names it.
        extractor: Weight file of the features.
        matcher: Weight file of the matcher.
        descriptor_length: Numbers per feature.
    """

    name: str
    extractor: WeightFile
    matcher: WeightFile
    descriptor_length: int

    @property
    def identity(self) -> str:
        """What travels in latents: robots of one identity can register each other's."""
        hashes = f"{self.extractor.sha256[:HASH_DIGITS]}-{self.matcher.sha256[:HASH_DIGITS]}"
        return f"learned/{self.name}-1/{hashes}"


VARIANTS = {
    variant.name: variant
    for variant in (
        Variant("aliked-lightglue", ALIKED_N16ROT, ALIKED_LIGHTGLUE, 128),
        Variant("xfeat-lighterglue", XFEAT_FEATURES, XFEAT_LIGHTERGLUE, 64),
    )
}


class Networks:
    """A variant's two networks on one device; from any thread, one run at a time.

    Two runs at once would only share the same cores and double the memory.
    """

    def __init__(self, variant: Variant, folder: Path, device: torch.device) -> None:
        """Load both networks.

        Raises:
            BadWeights: A file is missing, of another hash, or does not fit.
        """
        self.variant = variant
        self._device = device
        self._lock = threading.Lock()
        extractor = read_state(checked(variant.extractor, folder))
        matcher = read_state(checked(variant.matcher, folder))
        self._detect = self._extractor(extractor)
        sizes = LIGHTERGLUE if variant.descriptor_length == LIGHTERGLUE["input_dim"] else {"input_dim": 128}
        lightglue = LightGlue(None, **sizes)  # type: ignore[arg-type]  # None: its own sizes, and no download
        self._matcher = loaded(lightglue, as_kornia_names(matcher), variant.matcher).to(device)

    def detect(self, picture: NDArray[np.uint8]) -> tuple[Float32, Float32]:
        """Find features of a picture (H, W, 3), the strongest first.

        Returns:
            Positions (N, 2) in pixels, x right and y down, and descriptors (N, D) of unit length.
        """
        image = torch.from_numpy(np.ascontiguousarray(picture)).to(self._device).permute(2, 0, 1)[None].float() / 255.0
        with self._lock, torch.inference_mode():
            pixels, scores, descriptors = self._detect(image)
            order = torch.argsort(scores, descending=True, stable=True)
            return tuple(found[order].float().cpu().numpy() for found in (pixels, descriptors))  # type: ignore[return-value]

    def match(self, first: LearnedFeatures, second: LearnedFeatures) -> Matched:
        """Which features of two images show the same point, by LightGlue."""
        data = {"image0": self._input(first), "image1": self._input(second)}
        with self._lock, torch.inference_mode():
            pairs = self._matcher(data)["matches"][0].cpu().numpy().astype(np.intp)
        return pairs[:, 0], pairs[:, 1]

    def _input(self, features: LearnedFeatures) -> dict[str, Tensor]:
        arrays = {
            "keypoints": features.pixels,
            "descriptors": features.descriptors,
            "image_size": np.array(features.size_px, np.float32),
        }
        return {name: torch.from_numpy(array)[None].to(self._device) for name, array in arrays.items()}

    def _extractor(self, state: dict[str, Tensor]) -> Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]:
        file = self.variant.extractor
        if self.variant.descriptor_length == 128:
            name = file.name.removesuffix(".pth")
            # Threshold 0: the strongest features, however weak; the default leaves a third of them indoors.
            aliked = ALIKED(model_name=name, max_num_keypoints=FEATURES_MAX, detection_threshold=0.0)
            loaded(aliked, state, file).to(self._device)

            def by_aliked(image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
                found = aliked(image)[0]
                return found.keypoints, found.keypoint_scores, found.descriptors

            return by_aliked
        xfeat = XFeat(top_k=FEATURES_MAX)
        loaded(xfeat.net, state, file)
        xfeat.to(self._device).eval()
        logits: list[Tensor] = []
        xfeat.net.register_forward_hook(lambda _network, _image, maps: logits.append(maps[1]))

        def by_xfeat(image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            found = xfeat.detectAndCompute(image)[0]
            pixels = centred(found["keypoints"], logits.pop(), (image.shape[-1], image.shape[-2]))
            return pixels, found["scores"], found["descriptors"]

        return by_xfeat


def centred(pixels: Tensor, logits: Tensor, size_px: tuple[int, int]) -> Tensor:
    """XFeat's whole-pixel positions moved to the centre of mass of the 3 x 3 probabilities around them.

    Args:
        pixels: (N, 2) x and y in the picture.
        logits: (1, 65, h, w): for each cell of 8 x 8 pixels of the network's picture, its pixels and "none".
        size_px: Width and height of the picture.
    """
    heat = nn.functional.pixel_shuffle(torch.softmax(logits, 1)[:, :64], 8)[0, 0]
    factor = torch.tensor([size / of for size, of in zip(size_px, heat.shape[::-1], strict=True)], device=pixels.device)
    whole = torch.round(pixels / factor).long()
    padded = nn.functional.pad(heat, (1, 1, 1, 1))
    steps = torch.arange(3, device=pixels.device)
    around = padded[whole[:, 1, None, None] + steps[:, None], whole[:, 0, None, None] + steps]
    weights = around / around.sum((1, 2), keepdim=True).clamp(min=LENGTH_MIN)
    moved = torch.stack([(weights.sum(axis) * (steps - 1)).sum(1) for axis in (1, 2)], 1)
    return ((whole + moved) * factor).clamp(min=0.0)


def read_state(path: Path) -> dict[str, Tensor]:
    """The named tensors of a torch file; pickled code is never run.

    Raises:
        BadWeights: The file is damaged or holds something else.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        raise BadWeights(f"{path}: is damaged or no torch file") from error
    if not isinstance(state, Mapping):
        raise BadWeights(f"{path}: holds no table of named tensors")
    return dict(state)


def as_kornia_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A matcher's tensors under kornia's names; an extractor that the file holds as well is left out."""
    named: dict[str, Tensor] = {}
    for key, value in state.items():
        if key.startswith("extractor."):
            continue
        parts = key.removeprefix("matcher.").split(".")
        if parts[0] in ("self_attn", "cross_attn"):
            parts = ["transformers", parts[1], parts[0], *parts[2:]]
        named[".".join(parts)] = value
    return named


def loaded(network: Any, state: Mapping[str, Tensor], file: WeightFile) -> nn.Module:
    """The network with a file's tensors, for inference.

    Raises:
        BadWeights: A tensor is missing, too many or of another shape.
    """
    assert isinstance(network, nn.Module)
    try:
        missing, unexpected = network.load_state_dict(state, strict=False)
    except RuntimeError as error:
        raise BadWeights(f"{file.name}: its tensors do not fit kornia's network: {error}") from error
    wrong = [key for key in missing if key not in DERIVED] + list(unexpected)
    if wrong:
        raise BadWeights(f"{file.name}: does not fit kornia's network: {', '.join(wrong[:4])}")
    return network.eval().requires_grad_(False)
