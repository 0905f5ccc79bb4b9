"""Benchmarks of a checkout: time and error of each stage beside other implementations."""
