"""Reading checkpoints: `.pth` without running pickled code, and `.safetensors`; strict, mapped, never guessed.

A file that is not exactly the network asked for is refused with one sentence that says what it seems to be.
"""

import argparse
import hashlib
import json
import pickle
import re
import struct
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from flocc_agent.perception.mast3r.keyed import canonical
from flocc_protocol.errors import FloccError

SAFETENSORS_HEADER_BYTES_MAX = 100 * 1024 * 1024
SAFETENSORS_DTYPES = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
    "I32": torch.int32,
    "U8": torch.uint8,
}
ENCODER_PREFIXES = ("patch_embed.", "enc_blocks.", "enc_norm.")
IDENTITY_LENGTH = 16
KEYS_NAMED_MAX = 3

State = dict[str, Tensor]


class BadCheckpoint(FloccError):
    """A weights file that is damaged, unsafe or of another network."""


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """Tensors of a file, mapped from disk where the format allows it.

    Attributes:
        path: The file.
        state: Tensors by name.
        model: The training command's model string where the file holds one; never evaluated.
    """

    path: Path
    state: State
    model: str


def read_checkpoint(path: Path) -> Checkpoint:
    """Open a `.pth` or `.safetensors` file.

    Raises:
        BadCheckpoint: Missing, truncated, not a checkpoint, or with pickled code.
    """
    if path.exists() and not path.is_file():
        raise BadCheckpoint(f"{path}: is not a file")
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise BadCheckpoint(f"{path}: cannot be read: {error.strerror}") from error
    if path.suffix == ".safetensors" or start[8:9] == b"{":
        return Checkpoint(path, read_safetensors(path), "")
    return _read_pth(path)


def _read_pth(path: Path) -> Checkpoint:
    """Load a torch file; only tensors, containers and argparse.Namespace are let through."""
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            loaded = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path) or None)
    except pickle.UnpicklingError as error:
        raise BadCheckpoint(f"{path}: {_unpickling_complaint(str(error))}") from error
    except (RuntimeError, EOFError, OSError, ValueError, LookupError, AttributeError, TypeError) as error:
        raise BadCheckpoint(f"{path}: is truncated, damaged or no torch checkpoint ({_line(error)})") from error
    model = ""
    if isinstance(loaded, Mapping) and isinstance(loaded.get("model"), Mapping):
        model = str(getattr(loaded.get("args"), "model", ""))
        loaded = loaded["model"]
    if not isinstance(loaded, Mapping) or not all(
        isinstance(key, str) and isinstance(value, Tensor) for key, value in loaded.items()
    ):
        raise BadCheckpoint(f"{path}: holds no table of named tensors")
    return Checkpoint(path, dict(loaded), model)


def _line(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return (text[0] if text else type(error).__name__)[:160]


def _unpickling_complaint(message: str) -> str:
    """Tell pickled code from plain damage."""
    found = re.search(r"unsupported global:? (?:global )?([\w.]+)", message, re.IGNORECASE)
    if found:
        return f"holds pickled code ({found[1]}), which is never run; only plain weights are loaded"
    return "is truncated, damaged or no torch checkpoint"


def read_safetensors(path: Path) -> State:
    """Map a safetensors file: an 8-byte length, a JSON table, raw little-endian data.

    Raises:
        BadCheckpoint: Truncated, with overlapping or misplaced tensors, or of an unknown data type.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        prefix = file.read(8)
        length = struct.unpack("<Q", prefix)[0] if len(prefix) == 8 else 0
        if not 2 <= length <= min(SAFETENSORS_HEADER_BYTES_MAX, size - 8):
            raise BadCheckpoint(f"{path}: is truncated or no safetensors file")
        try:
            table = json.loads(file.read(length))
        except (ValueError, RecursionError) as error:
            raise BadCheckpoint(f"{path}: its safetensors header is not JSON") from error
    if not isinstance(table, dict):
        raise BadCheckpoint(f"{path}: its safetensors header is no table")
    # A mapped file, private: nothing is read before it is used, and nothing is ever written back.
    data = torch.from_file(str(path), shared=False, size=size, dtype=torch.uint8)[8 + length :]
    return {name: _mapped(path, name, entry, data) for name, entry in table.items() if name != "__metadata__"}


def _mapped(path: Path, name: str, entry: Any, data: Tensor) -> Tensor:
    """One tensor of the table, its bounds checked."""
    try:
        dtype = SAFETENSORS_DTYPES[entry["dtype"]]
        shape = [int(side) for side in entry["shape"]]
        begin, end = (int(offset) for offset in entry["data_offsets"])
    except (KeyError, TypeError, ValueError) as error:
        raise BadCheckpoint(f"{path}: the tensor '{name[:80]}' has an unknown data type or no bounds") from error
    count = 1
    for side in shape:
        count *= side
    if min([*shape, 0]) < 0 or not 0 <= begin <= end <= len(data) or end - begin != count * dtype.itemsize:
        raise BadCheckpoint(f"{path}: is truncated: the tensor '{name[:80]}' lies outside the file")
    raw = data[begin:end]
    return (raw if raw.data_ptr() % dtype.itemsize == 0 else raw.clone()).view(dtype).view(shape)


def with_aliases(state: State, expected: Mapping[str, Any]) -> State:
    """Add the DPT's second names, which safetensors files drop; nothing else is filled in."""
    missing = [key for key in expected if key not in state and canonical(key) != key and canonical(key) in state]
    return {**state, **{key: state[canonical(key)] for key in missing}}


def named(keys: list[str]) -> str:
    """The first few of a list of keys, for a message."""
    more = f" and {len(keys) - KEYS_NAMED_MAX} more" if len(keys) > KEYS_NAMED_MAX else ""
    return ", ".join(repr(key[:120]) for key in keys[:KEYS_NAMED_MAX]) + more


def check_fits(path: Path, state: State, expected: Mapping[str, Tensor]) -> None:
    """Compare names, shapes and kinds of numbers with a network's.

    Raises:
        BadCheckpoint: A key is missing or extra, or a shape differs; the message names the first of them.
    """
    missing = [key for key in expected if key not in state]
    if missing:
        raise BadCheckpoint(f"{path}: lacks {len(missing)} of {len(expected)} tensors: {named(missing)}")
    extra = [key for key in state if key not in expected]
    if extra:
        raise BadCheckpoint(f"{path}: holds {len(extra)} tensors that the network does not have: {named(extra)}")
    for key, like in expected.items():
        if state[key].shape != like.shape:
            shapes = f"{tuple(state[key].shape)}, not {tuple(like.shape)}"
            raise BadCheckpoint(f"{path}: the tensor '{key}' is {shapes}: another model or size")
        if state[key].is_floating_point() != like.is_floating_point():
            raise BadCheckpoint(f"{path}: the tensor '{key}' is {state[key].dtype}, not {like.dtype}")


def load_strictly(module: nn.Module, checkpoint: Checkpoint, dtype: torch.dtype, device: torch.device) -> None:
    """Give a module on the meta device the file's tensors, in one dtype, without a second copy where none is needed.

    Raises:
        BadCheckpoint: The file does not fit the module exactly, or holds values that are not finite.
    """
    expected = module.state_dict()
    state = with_aliases(checkpoint.state, expected)
    check_fits(checkpoint.path, state, expected)
    shared: dict[str, Tensor] = {}
    placed: State = {}
    for key, like in expected.items():
        name = canonical(key)
        if name not in shared:
            source = state[key]
            if source.is_floating_point() and not bool(torch.isfinite(source.sum(dtype=torch.float64))):
                raise BadCheckpoint(f"{checkpoint.path}: the tensor '{key}' holds values that are not finite")
            shared[name] = source.to(device=device, dtype=dtype if like.is_floating_point() else like.dtype)
        placed[key] = shared[name]
    module.load_state_dict(placed, strict=True, assign=True)
    module.eval().requires_grad_(False)


def identity(state: State, keys: list[str]) -> str:
    """16 hexadecimal digits of SHA-256 over named tensors' names, shapes and values, the same for either format."""
    digest = hashlib.sha256()
    for key in sorted(keys):
        tensor = state[key].detach().contiguous()
        digest.update(f"{key}|{tuple(tensor.shape)}|{tensor.dtype}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:IDENTITY_LENGTH]


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
