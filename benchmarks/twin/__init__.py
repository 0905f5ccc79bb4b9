"""Benchmark of the twin: time per chunk by requested images and by physics solver."""
