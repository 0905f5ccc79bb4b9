"""MCAP import and export of episodes and recordings, with Foxglove schemas."""

from dextouch.bridges.mcap.reading import import_mcap
from dextouch.bridges.mcap.writing import export_mcap

__all__ = ["export_mcap", "import_mcap"]
