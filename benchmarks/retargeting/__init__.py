"""Benchmark of retargeting on hands with known joint angles, compared with other solvers."""
