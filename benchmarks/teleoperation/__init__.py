"""Benchmark of teleoperation: the service, and a loop that answers every sample."""
