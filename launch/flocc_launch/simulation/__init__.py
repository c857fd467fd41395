"""The swarm on virtual time: the unchanged core, the real codec, simulated links, disks and workers.

Rules: no wall clock, no thread, no global random. The same scenario and seed give the same bytes.
"""
