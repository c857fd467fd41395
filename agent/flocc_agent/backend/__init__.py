"""From a pose graph to optimised poses and scales. GTSAM lives here only.

`optimiser.optimise` is the entry point; everything else is a step of it. Knows the core's pose-graph types and the
configuration; must not know images, messages or clocks of others.
"""
