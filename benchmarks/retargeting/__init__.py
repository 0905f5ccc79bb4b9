"""Benchmark of retargeting on hands with known joint angles, beside rival solvers."""
