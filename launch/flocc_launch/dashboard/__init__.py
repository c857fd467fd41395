"""The live page of a swarm: what every robot does, drawn from events that are written anyway.

The page of a run reads its folder, the page of one agent what that agent holds; neither asks the network, so that
looking at a swarm cannot disturb it.
"""

from flocc_launch.dashboard.server import Dashboard, DashboardError, address, live_dashboard

__all__ = ["Dashboard", "DashboardError", "address", "live_dashboard"]
