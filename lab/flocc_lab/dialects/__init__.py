"""Generators of files as other tools write them, with what is right to read from each."""
