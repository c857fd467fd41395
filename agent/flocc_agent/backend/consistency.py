"""Pairwise consistency maximisation (Mangelson 2018) for closures whose scale may be unknown."""

from collections.abc import Mapping

from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import LoopClosure, Trajectory
from flocc_protocol.ids import LogId


def inconsistent(
    trajectories: Mapping[LogId, Trajectory], closures: Mapping[int, LoopClosure], config: BackendConfig
) -> dict[int, str]:
    """Closures to turn away, with the reason."""
    return {}
