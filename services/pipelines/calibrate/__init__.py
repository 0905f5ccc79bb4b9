"""Command `dextouch station calibrate`: cameras, mounts, gloves, wrists, robot bases, latencies."""

from services.pipelines.calibrate.command import main

__all__ = ["main"]
