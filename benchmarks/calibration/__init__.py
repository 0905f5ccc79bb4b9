"""Benchmark of calibration: hand-eye mounts and cameras with known ground truth."""
