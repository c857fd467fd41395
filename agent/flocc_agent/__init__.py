"""One robot's agent: the pure core, perception, back end and runtime.

For a robot's own program::

    from flocc_agent import Agent, AgentConfig

Both names are imported on first use, so that `import flocc_agent` stays fast.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flocc_agent.agent import Agent
    from flocc_agent.config import AgentConfig

__all__ = ["Agent", "AgentConfig"]

_HOMES = {"Agent": "flocc_agent.agent", "AgentConfig": "flocc_agent.config"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'flocc_agent' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
