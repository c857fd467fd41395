"""The learned front end: ALIKED or XFeat features matched by LightGlue, free for commercial use (docs/learned.md).

The networks are kornia's classes, the weights files that `flocc weights get learned` brings. Torch and kornia are an
optional extra (`pip install '.[learned]'`): nothing outside this package imports them at import time, and this
`__init__` and `files` do not either.
"""

from flocc_agent.config import LearnedConfig
from flocc_agent.core.interfaces import Describer, Encoder, Registrar
from flocc_agent.extras import to_install
from flocc_protocol.errors import FloccError


class LearnedMissing(FloccError):
    """The networks need torch and kornia, which are an optional extra."""


def build(config: LearnedConfig) -> tuple[Describer, Encoder, Registrar]:
    """Load the networks and give the three parts that the runtime asks for; see `frontend.build`.

    Raises:
        LearnedMissing: Torch or kornia is not installed.
        FloccError: A file or a device does not allow it; the message says which.
    """
    try:
        from flocc_agent.perception.learned import learned_frontend as frontend
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in ("torch", "kornia"):
            raise
        raise LearnedMissing(f"the learned front end needs torch and kornia: {to_install('learned')}") from error
    return frontend.build(config)
