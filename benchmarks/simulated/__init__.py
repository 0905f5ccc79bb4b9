"""Simulated inputs with known truth, shared by benchmarks and accuracy tests."""
