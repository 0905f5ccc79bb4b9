"""Command `dextouch station calibrate`: cameras, hand-eye mounts and gloves."""

from services.cli.calibrate.command import main

__all__ = ["main"]
