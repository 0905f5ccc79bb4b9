"""Cameras on the station's own bus, captured by V4L2."""
