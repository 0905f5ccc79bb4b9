"""Benchmark of episode storage: time, size and image error of stores on one take."""
