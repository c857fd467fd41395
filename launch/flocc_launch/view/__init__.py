"""A run or a running swarm in rerun."""
