"""Loading of robot hands from URDF or MJCF models with a small mapping file."""

from dextouch.hands.hand_files.loading import load_hand

__all__ = ["load_hand"]
