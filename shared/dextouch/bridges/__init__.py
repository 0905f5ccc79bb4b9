"""Import and export of episodes and recordings: LeRobot, MCAP, UMI and Rerun formats."""

__all__ = [
    "foreign",
    "foreign_mcap",
    "foreign_rerun",
    "formats",
    "foxglove",
    "lerobot",
    "mcap",
    "rerun",
    "umi",
]
