"""Import of LeRobotDataset v2 and v3, and export of v3.0."""

from dextouch.bridges.lerobot.exporting import DatasetExport, ExportOptions, export_dataset
from dextouch.bridges.lerobot.importing import DatasetImport, import_dataset
from dextouch.bridges.lerobot.recordings import ImportOptions

__all__ = [
    "DatasetExport",
    "DatasetImport",
    "ExportOptions",
    "ImportOptions",
    "export_dataset",
    "import_dataset",
]
