"""MASt3R with keyed random weights: it computes what real weights cost and recognises nothing. Needs torch."""

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from flocc_agent.extras import to_install
from flocc_lab.experiments.experiment import ExperimentError

if TYPE_CHECKING:
    from flocc_agent.perception.mast3r.engine import Engine

Float32 = NDArray[np.float32]

SIZES_PX = {"full": (384, 512), "small": (384, 512), "tiny": (96, 128)}
"""Height and width of the pictures; the official network's are 512 wide."""


def keyed_engine(network: Literal["none", "tiny", "small", "full"], exact: bool = False) -> "Engine":
    """An engine on the best device that is there, in its best number format, or exactly in fp32.

    Raises:
        ExperimentError: torch is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise ExperimentError(f"MASt3R needs torch: {to_install('mast3r')}") from error
    from flocc_agent.perception.mast3r.device import choose_compute
    from flocc_agent.perception.mast3r.engine import Engine
    from flocc_agent.perception.mast3r.keyed import MAST3R_SEED, keyed_state
    from flocc_agent.perception.mast3r.sizes import NAMED_SIZES
    from flocc_agent.perception.mast3r.two_view_network import Mast3r

    assert network != "none", "the settings say which"
    compute = choose_compute("auto", "fp32" if exact else "auto")
    with torch.device("meta"):
        model = Mast3r(NAMED_SIZES[network])
    model.load_state_dict(keyed_state(model, MAST3R_SEED), strict=True, assign=True)
    return Engine(model, compute)


def keyed_pictures(size: tuple[int, int], count: int = 2) -> list[Float32]:
    """Smooth pictures with noise, (1, 3, H, W) in [-1, 1]."""
    from flocc_agent.perception.mast3r.keyed import MAST3R_SEED, keyed_image

    return [keyed_image(MAST3R_SEED, f"image/experiment/{k}", 1, *size) for k in range(count)]
