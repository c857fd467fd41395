"""How an optional part is installed: one sentence for every message that names one."""

import os
import sys


def to_install(extra: str) -> str:
    """What to type for an extra of flocc's, in a folder that holds a clone of it."""
    return f"{pip()} install '.[{extra}]' in the clone of flocc"


def pip() -> str:
    """The pip that installs for this very flocc: by the interpreter's path where its environment is not activated."""
    return "pip" if os.environ.get("VIRTUAL_ENV") == sys.prefix else f"{sys.executable} -m pip"
