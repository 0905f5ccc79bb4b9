"""LeRobotDataset v3.0 import and export."""

from dextouch.bridges.lerobot.exporting import ExportOptions, export_lerobot
from dextouch.bridges.lerobot.importing import ImportOptions, import_lerobot

__all__ = ["ExportOptions", "ImportOptions", "export_lerobot", "import_lerobot"]
