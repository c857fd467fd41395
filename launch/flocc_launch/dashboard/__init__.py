"""The live page of a run: what every robot does, drawn from the events that it writes anyway.

The page reads the run folder, never the network, so that looking at a swarm cannot disturb it.
"""

from flocc_launch.dashboard.server import Dashboard, DashboardError, live_dashboard

__all__ = ["Dashboard", "DashboardError", "live_dashboard"]
