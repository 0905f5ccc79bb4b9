"""Benchmark of device clocks against simulated truth, beside rival methods."""
