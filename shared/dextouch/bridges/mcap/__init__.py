"""MCAP import and export of episodes and recordings, with Foxglove schemas."""

from dextouch.bridges.mcap.files import export_mcap, import_mcap

__all__ = ["export_mcap", "import_mcap"]
