"""From a weights file to a network: MASt3R of a named size, or a CosPlace that the file itself describes."""

import re
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from flocc_agent.perception.mast3r.checkpoint import (
    ENCODER_PREFIXES,
    BadCheckpoint,
    Checkpoint,
    identity,
    load_strictly,
    read_checkpoint,
)
from flocc_agent.perception.mast3r.cosplace import CosPlace
from flocc_agent.perception.mast3r.sizes import FULL, Mast3rSizes
from flocc_agent.perception.mast3r.transformer_blocks import AttentionKind
from flocc_agent.perception.mast3r.two_view_network import Mast3r

CPU = torch.device("cpu")
STAGE_2_BLOCKS = {2: "ResNet18", 4: "ResNet50", 8: "ResNet152"}
"""Blocks of a ResNet's second stage; 50 and 101 differ in the third only."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadedMast3r:
    """A network in use and the identity of its encoder's weights."""

    network: Mast3r
    model: str


@dataclass(frozen=True, slots=True, eq=False)
class LoadedCosPlace:
    """A place descriptor in use, what it is, and the identity of its weights."""

    network: CosPlace
    backbone: str
    model: str


def refuse_other_models(checkpoint: Checkpoint) -> None:
    """Say what a well-known file of the wrong kind is.

    Raises:
        BadCheckpoint: A DUSt3R, CroCo, CosPlace or 224-pixel file, or one without the second decoder.
    """
    path, keys = checkpoint.path, checkpoint.state.keys()
    if any(key.startswith("aggregation.") for key in keys):
        raise BadCheckpoint(f"{path}: is a CosPlace checkpoint, not MASt3R")
    if not any(key.startswith("enc_blocks.") for key in keys):
        raise BadCheckpoint(f"{path}: holds no MASt3R encoder: it is another model")
    if any(key.startswith(("downstream_head1.proj.", "prediction_head.")) for key in keys):
        raise BadCheckpoint(f"{path}: is a DUSt3R or CroCo checkpoint with a linear head (224 px), not MASt3R")
    if any(key.startswith("dec_blocks.") for key in keys) and not any(key.startswith("dec_blocks2.") for key in keys):
        raise BadCheckpoint(f"{path}: lacks the second decoder (dec_blocks2); the first is never copied in its place")
    if any(".dpt." in key for key in keys) and not any("head_local_features" in key for key in keys):
        raise BadCheckpoint(f"{path}: is a DUSt3R checkpoint: it has no descriptor head (head_local_features)")
    trained = re.search(r"img_size\s*=\s*\(\s*(\d+)\s*,\s*(\d+)\s*\)", checkpoint.model)
    if trained and (int(trained[1]), int(trained[2])) != (512, 512):
        raise BadCheckpoint(f"{path}: was trained at {trained[1]}x{trained[2]} pixels, not at 512x512")


def encoder_part(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors that a robot needs which only encodes."""
    return {key: value for key, value in state.items() if key.startswith(ENCODER_PREFIXES)}


def load_mast3r(
    path: Path,
    sizes: Mast3rSizes = FULL,
    *,
    with_decoder: bool = True,
    dtype: torch.dtype = torch.float32,
    device: torch.device = CPU,
    attention: AttentionKind = AttentionKind.SDPA,
) -> LoadedMast3r:
    """Load MASt3R strictly, built on the meta device and mapped from the file.

    Args:
        path: `.pth` or `.safetensors`; the whole model, or the encoder alone where `with_decoder` is false.
        sizes: What the file must hold exactly.
        with_decoder: False loads the encoder only, from either kind of file.
        dtype: Of all parameters.
        device: Where they go.
        attention: How attention is computed.

    Raises:
        BadCheckpoint: The file is damaged, unsafe or not this network.
    """
    checkpoint = read_checkpoint(path)
    refuse_other_models(checkpoint)
    if not with_decoder:
        checkpoint = Checkpoint(path, encoder_part(checkpoint.state), checkpoint.model)
    with torch.device("meta"):
        network = Mast3r(sizes, with_decoder, attention)
    load_strictly(network, checkpoint, dtype, device)
    encoder = encoder_part(checkpoint.state)
    return LoadedMast3r(network, f"mast3r-{identity(encoder, list(encoder))}")


def backbone_of(checkpoint: Checkpoint) -> str:
    """Which backbone a CosPlace file holds, from its keys.

    Raises:
        BadCheckpoint: None that is known.
    """
    keys = checkpoint.state.keys()
    if "backbone.28.weight" in keys:
        return "VGG16"
    second, third = (len({key.split(".")[2] for key in keys if key.startswith(f"backbone.{k}.")}) for k in (5, 6))
    name = STAGE_2_BLOCKS.get(second, "")
    if name == "ResNet50" and third == 23:
        name = "ResNet101"
    if not name:
        raise BadCheckpoint(f"{checkpoint.path}: holds no backbone that CosPlace uses")
    return name


def load_cosplace(path: Path, dtype: torch.dtype = torch.float32, device: torch.device = CPU) -> LoadedCosPlace:
    """Load a CosPlace file strictly; backbone and dimension come from the file.

    Raises:
        BadCheckpoint: The file is damaged, unsafe or no CosPlace network.
    """
    checkpoint = read_checkpoint(path)
    last = checkpoint.state.get("aggregation.3.weight")
    if last is None or last.ndim != 2:
        raise BadCheckpoint(f"{path}: is no CosPlace checkpoint (no 'aggregation.3.weight')")
    backbone = backbone_of(checkpoint)
    with torch.device("meta"):
        network = CosPlace(backbone, last.shape[0])
    load_strictly(network, checkpoint, dtype, device)
    return LoadedCosPlace(network, backbone, f"cosplace-{identity(checkpoint.state, list(checkpoint.state))}")
