"""Which of torch's devices networks run on."""

from typing import Literal

import torch

from flocc_protocol.errors import FloccError

DeviceName = Literal["auto", "cuda", "mps", "cpu"]


class DeviceError(FloccError):
    """A device that this machine does not have."""


def choose_device(name: DeviceName) -> torch.device:
    """The device asked for, or the best there is.

    Raises:
        DeviceError: The device asked for is not there.
    """
    available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if name == "auto":
        return torch.device(next(kind for kind, there in available.items() if there))
    if not available[name]:
        raise DeviceError(f"the device '{name}' is not available to torch on this machine")
    return torch.device(name)
