"""Benchmark of device clocks against simulated ground truth, compared with other methods."""
