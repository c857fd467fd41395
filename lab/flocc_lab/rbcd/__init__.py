"""Riemannian block-coordinate descent (DPGO, Kimera-Multi): the baseline of distributed optimisation, offline only."""
