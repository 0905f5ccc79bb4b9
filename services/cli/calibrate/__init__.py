"""Command `dextouch station calibrate`: cameras, mounts, gloves, wrists, robot bases, latencies."""

from services.cli.calibrate.command import main

__all__ = ["main"]
