"""Shared by the tests of the MASt3R front end: golden vectors, keyed networks, pictures."""

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch", reason="torch, an optional extra, is not installed")

from flocc_agent.core.interfaces import Camera, Image  # noqa: E402
from flocc_agent.perception.mast3r.cosplace import CosPlace  # noqa: E402
from flocc_agent.perception.mast3r.keyed import (  # noqa: E402
    COSPLACE_SEED,
    MAST3R_SEED,
    keyed_image,
    keyed_state,
)
from flocc_agent.perception.mast3r.sizes import Mast3rSizes  # noqa: E402
from flocc_agent.perception.mast3r.two_view_network import Mast3r  # noqa: E402

SHARED = Path(os.environ.get("FLOCC_SHARED", Path(__file__).resolve().parents[4] / "shared"))


def golden_folder() -> Path:
    """The golden vectors, or a skip with the reason."""
    folder = SHARED / "golden"
    if not folder.is_dir():
        pytest.skip(f"golden vectors are not at {folder}")
    return folder


def golden(name: str) -> Any:
    """One golden file."""
    return torch.load(golden_folder() / name, weights_only=True)


def deviation(found: Any, expected: Any) -> float:
    """max |d| / (1 + |ref|), the measure of the golden vectors."""
    assert found.shape == expected.shape
    return float(((found - expected).abs() / (1 + expected.abs())).max())


def keyed_mast3r(sizes: Mast3rSizes, with_decoder: bool = True) -> Mast3r:
    """A network with keyed random weights."""
    with torch.device("meta"):
        network = Mast3r(sizes, with_decoder)
    network.load_state_dict(keyed_state(network, MAST3R_SEED), strict=True, assign=True)
    return network.eval().requires_grad_(False)


def keyed_cosplace(backbone: str = "ResNet18", dimension: int = 64) -> CosPlace:
    """A place descriptor with keyed random weights."""
    with torch.device("meta"):
        network = CosPlace(backbone, dimension)
    network.load_state_dict(keyed_state(network, COSPLACE_SEED), strict=True, assign=True)
    return network.eval().requires_grad_(False)


def write_pth(path: Path, state: dict[str, Any], model: str = "img_size=(512, 512)") -> Path:
    """A checkpoint in the official format."""
    torch.save({"model": state, "args": argparse.Namespace(model=model)}, path)
    return path


def picture(key: str, width: int = 160, height: int = 120) -> Image:
    """A smooth keyed picture and a plausible camera."""
    pixels = keyed_image(MAST3R_SEED, key, 1, height, width)[0].transpose(1, 2, 0)
    as_bytes: NDArray[np.uint8] = ((pixels + 1) * 127.5).astype(np.uint8)
    return Image(as_bytes, Camera(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2))
