"""`dextouch bench STAGE`: a stage of the platform timed against its error, beside its rivals."""

from services.cli.bench.command import main

__all__ = ["main"]
