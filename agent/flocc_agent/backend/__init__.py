"""Pose graph to optimised poses and scales; GTSAM lives here only."""
