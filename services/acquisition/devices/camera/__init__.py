"""Cameras whose images come over a TCP bridge."""
