"""Lasting state of a scene: objects found at the start, then moved by a recurrent core."""
