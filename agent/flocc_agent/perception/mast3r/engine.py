"""Runs the networks: number formats, batches, threads, warm-up, and what happens when memory runs out.

One engine serves the encoder and the registrar of a robot, from any thread, one run at a time: two runs at once
would only share the same cores and double the memory.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flocc_agent.perception.mast3r.device import Compute, NotEnoughMemory, is_out_of_memory
from flocc_agent.perception.mast3r.two_view_network import DenseView, Mast3r

Float32 = NDArray[np.float32]
Size = tuple[int, int]
Result = TypeVar("Result")

ENCODE_SMOOTHING_RATIO = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class LatentOnDevice:
    """A latent ready to be decoded: (1, S, C) and the image size it belongs to, height first."""

    latent: Tensor
    size: Size


class Engine:
    """MASt3R on one device.

    Args:
        network: Loaded network; its heads are moved to their own number format.
        compute: Device and number formats.
        batch_max: Images or pairs in one run at most; bounds the memory.
        compiled: Whether to run through torch.compile.
    """

    def __init__(self, network: Mast3r, compute: Compute, batch_max: int = 1, compiled: bool = False) -> None:
        self._network = prepared(network, compute)
        self._compute = compute
        self._batch_max = batch_max
        self._lock = threading.Lock()
        self.encode_s: float | None = None
        if compiled:
            self._network.compile_parts()

    @property
    def can_decode(self) -> bool:
        """Whether the decoder is loaded."""
        return self._network.with_decoder

    @property
    def channels(self) -> int:
        """Channels of a latent."""
        return self._network.sizes.encoder_dim

    def encode(self, inputs: Sequence[Float32]) -> list[Tensor]:
        """Encode pictures (1, 3, H, W) in [-1, 1]; gives one (1, S, C) latent each, in their order.

        Raises:
            NotEnoughMemory: Memory ran out.
        """
        out: list[Tensor | None] = [None] * len(inputs)
        with self._lock, torch.inference_mode():
            start = time.perf_counter()
            for batch in batches([picture.shape for picture in inputs], self._batch_max):
                images = torch.from_numpy(np.concatenate([inputs[k] for k in batch])).to(self._compute.device)
                for k, latent in zip(batch, self._run(self._network.encode, images)[:, None], strict=True):
                    out[k] = latent
            self._note_encode_s((time.perf_counter() - start) / max(len(inputs), 1))
        return [latent for latent in out if latent is not None]

    def decode(self, pairs: Sequence[tuple[LatentOnDevice, LatentOnDevice]]) -> list[tuple[DenseView, DenseView]]:
        """Decode pairs of latents; gives both views of each, batch dimension 1, in their order.

        Raises:
            NotEnoughMemory: Memory ran out.
        """
        out: dict[int, tuple[DenseView, DenseView]] = {}
        with self._lock, torch.inference_mode():
            for batch in batches([(a.size, b.size) for a, b in pairs], self._batch_max):
                a, b = (torch.cat([pairs[k][side].latent for k in batch]) for side in (0, 1))
                sizes = [latent.size for latent in pairs[batch[0]]]
                first, second = self._run(self._network.decode, a, sizes[0], b, sizes[1])
                out.update({k: (one(first, j), one(second, j)) for j, k in enumerate(batch)})
        return [out[k] for k in range(len(pairs))]

    def place(self, latent: Float32, size: Size) -> LatentOnDevice:
        """Bring a received latent (S, C) to the device."""
        tensor = torch.from_numpy(latent)[None].to(self._compute.device, self._compute.dtype)
        return LatentOnDevice(tensor, size)

    def warm_up(self, size: Size) -> None:
        """Run every part once, so that the first keyframe is not slower."""
        picture = np.zeros((1, 3, *size), np.float32)
        latents = [LatentOnDevice(latent, size) for latent in self.encode([picture])]
        if self.can_decode:
            self.decode([(latents[0], latents[0])])

    def _note_encode_s(self, seconds: float) -> None:
        """Keep a smoothed time per picture, for the choice between latent and image."""
        before = self.encode_s
        self.encode_s = seconds if before is None else before + ENCODE_SMOOTHING_RATIO * (seconds - before)

    def _run(self, function: Callable[..., Result], *arguments: object) -> Result:
        """Call the network; running out of memory becomes one clear error, and what was cached is freed."""
        try:
            return function(*arguments)
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
            if self._compute.device.type == "cuda":
                torch.cuda.empty_cache()
            raise NotEnoughMemory(f"memory ran out on {self._compute.device} while running MASt3R") from error


def prepared(network: Mast3r, compute: Compute) -> Mast3r:
    """Move a network to its device and formats; convolutions of the heads run with channels last."""
    network = network.to(compute.device, compute.dtype)
    if network.with_decoder:
        for head in (network.downstream_head1, network.downstream_head2):
            head.to(compute.head_dtype)
            head.dpt.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network.eval().requires_grad_(False)


def batches(sizes: Sequence[object], batch_max: int) -> list[list[int]]:
    """Group indices of equal size, at most so many together, in order of first appearance."""
    groups: dict[object, list[int]] = {}
    for k, size in enumerate(sizes):
        groups.setdefault(size, []).append(k)
    return [group[k : k + batch_max] for group in groups.values() for k in range(0, len(group), batch_max)]


def one(view: DenseView, index: int) -> DenseView:
    """One element of a batch, batch dimension kept."""
    kept = slice(index, index + 1)
    return DenseView(view.pts3d[kept], view.conf[kept], view.desc[kept], view.desc_conf[kept])
