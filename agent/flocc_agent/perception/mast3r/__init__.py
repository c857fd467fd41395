"""The paper's front end: CosPlace descriptors and MASt3R registration, split across two robots.

Written from a specification of the published networks; no reference code and no weights live here. Torch is an
optional extra (`pip install '.[mast3r]'`): nothing outside this package imports it at import time, and this
`__init__` does not either.
"""

from flocc_agent.config import Mast3rConfig
from flocc_agent.core.interfaces import Describer, Encoder, Registrar
from flocc_agent.extras import to_install
from flocc_protocol.errors import FloccError


class TorchMissing(FloccError):
    """The networks need torch, which is an optional extra."""


def build(config: Mast3rConfig) -> tuple[Describer, Encoder, Registrar]:
    """Load both networks and give the three parts that the runtime asks for; see `frontend.build`.

    Raises:
        TorchMissing: Torch or Pillow is not installed.
        FloccError: A path, a file, a device or the memory does not allow it; the message says which.
    """
    try:
        from flocc_agent.perception.mast3r import mast3r_frontend as frontend
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "PIL"):
            raise
        raise TorchMissing(f"the mast3r front end needs torch and Pillow: {to_install('mast3r')}") from error
    return frontend.build(config)
