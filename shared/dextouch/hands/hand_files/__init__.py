"""Hands from files: a URDF or MJCF model and a small mapping file in, a `HandModel` out."""

from dextouch.hands.hand_files.loading import load_hand

__all__ = ["load_hand"]
