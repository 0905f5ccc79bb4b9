"""Import and export of episodes and recordings: LeRobot, MCAP, UMI and Rerun formats."""

__all__ = ["foxglove", "lerobot", "mcap", "rerun", "umi"]
