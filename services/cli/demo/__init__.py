"""Command `dextouch demo`: the full path from device bytes to policy scores, against truth."""

from services.cli.demo.command import main

__all__ = ["main"]
