"""Benchmark of alignment, from a recorded take to an episode, against ground truth."""
