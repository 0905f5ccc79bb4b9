"""Benchmarks `dextouch bench STAGE`: time and error of a stage beside rival implementations."""

from services.cli.bench.command import main

__all__ = ["main"]
