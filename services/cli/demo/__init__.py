"""`dextouch demo`: the whole way from device bytes to a policy score, measured against truth."""

from services.cli.demo.command import main

__all__ = ["main"]
