"""Import and export of episodes and recordings: LeRobot, MCAP, UMI and Rerun formats."""

__all__ = [
    "formats",
    "foxglove",
    "import_mcap",
    "import_recording",
    "import_rerun",
    "lerobot",
    "mcap",
    "rerun",
    "umi",
]
