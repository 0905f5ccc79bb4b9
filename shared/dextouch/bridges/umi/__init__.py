"""UMI import and export: episodes as one zip file in the layout of UMI's replay buffer."""

from dextouch.bridges.umi.reading import import_umi
from dextouch.bridges.umi.writing import export_umi

__all__ = ["export_umi", "import_umi"]
