"""Episodes of the store ↔ folders of LeRobotDataset v3.0."""

from dextouch.bridges.lerobot.exporting import ExportOptions, export_lerobot

__all__ = ["ExportOptions", "export_lerobot"]
