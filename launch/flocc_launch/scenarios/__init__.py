"""Scenarios: files, shipped ones, the user's own data, and the recordings that they need."""
