"""The command group `dextouch study`."""

from services.cli.study.command import main

__all__ = ["main"]
