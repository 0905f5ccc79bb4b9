"""Benchmark of alignment, from a recorded take to an episode, against the true motion."""
