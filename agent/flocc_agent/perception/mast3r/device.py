"""Where and in which number format the networks run, by what the machine can do; and whether they fit."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import torch

from flocc_agent.perception.torch_device import DeviceName, choose_device
from flocc_protocol.errors import FloccError

DtypeName = Literal["auto", "fp32", "bf16", "fp16"]

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
AMPERE = (8, 0)
VOLTA = (7, 0)
MEMINFO = Path("/proc/meminfo")


class NotEnoughMemory(FloccError):
    """The networks, or one run of them, do not fit in memory."""


@dataclass(frozen=True, slots=True)
class Compute:
    """Where the networks run.

    Attributes:
        device: Torch device.
        dtype: Number format of the transformer.
        head_dtype: Number format of the heads: float32 where the transformer is float16, whose range their
            convolutions can leave.
    """

    device: torch.device
    dtype: torch.dtype
    head_dtype: torch.dtype


@lru_cache(maxsize=1)
def cpu_has_fast_bf16() -> bool:
    """Whether this CPU multiplies bfloat16 matrices in hardware (AMX or AVX512-BF16)."""
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="ignore")
    except OSError:
        return False
    return any(flag in flags for flag in (" amx_bf16", " avx512_bf16"))


def choose_dtype(name: DtypeName, device: torch.device) -> torch.dtype:
    """The number format asked for, or the fastest safe one: bf16 where it is native, fp16 on Volta, Turing and mps."""
    if name != "auto":
        return DTYPES[name]
    if device.type == "cuda":
        capability = torch.cuda.get_device_capability(device)
        if capability >= AMPERE:
            return torch.bfloat16
        return torch.float16 if capability >= VOLTA else torch.float32
    if device.type == "mps":
        return torch.float16
    return torch.bfloat16 if cpu_has_fast_bf16() else torch.float32


def choose_compute(device: DeviceName, dtype: DtypeName) -> Compute:
    """Device and number formats together.

    Raises:
        DeviceError: The device asked for is not there.
    """
    chosen = choose_device(device)
    number = choose_dtype(dtype, chosen)
    return Compute(chosen, number, torch.float32 if number is torch.float16 else number)


def memory_available_bytes(device: torch.device) -> int | None:
    """Bytes free on a device, or None where the system does not tell."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    try:
        lines = MEMINFO.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return int(found[0]) * 1024 if found else None


def require_memory(needed_bytes: int, device: torch.device, what: str) -> None:
    """Refuse early what would not fit.

    Raises:
        NotEnoughMemory: With what is needed and what there is.
    """
    available = memory_available_bytes(device)
    if available is not None and needed_bytes > available:
        gib = 1024.0**3
        raise NotEnoughMemory(
            f"{what} needs {needed_bytes / gib:.1f} GiB on {device.type}, {available / gib:.1f} GiB are free; "
            "use a smaller dtype, encode only, or another device"
        )


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception of torch or Python says that memory ran out."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    return isinstance(error, RuntimeError) and (
        "out of memory" in str(error) or "can't allocate memory" in str(error) or "not enough memory" in str(error)
    )
