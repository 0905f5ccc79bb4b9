"""Benchmarks of a checkout: time and error of each stage, compared with other implementations."""
