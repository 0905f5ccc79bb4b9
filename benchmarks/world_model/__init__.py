"""Benchmark of the world model: time per imagined chunk and error against the twin."""
