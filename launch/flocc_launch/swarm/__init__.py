"""A swarm of processes on this machine."""
