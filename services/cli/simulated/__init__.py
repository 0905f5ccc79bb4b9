"""Simulated inputs with known truth, shared by `dextouch stress` and the benchmarks."""
