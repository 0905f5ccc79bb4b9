"""Simulated inputs with ground truth, shared by benchmarks and accuracy tests."""
