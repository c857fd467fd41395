"""Benchmarks: ratios measured in one run, and the tables of the pages."""
