"""UMI import and export: episodes as one zip file in the layout of UMI's replay buffer."""

from dextouch.bridges.umi.replay_buffer import export_umi, import_umi

__all__ = ["export_umi", "import_umi"]
