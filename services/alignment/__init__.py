"""Alignment service: turns recordings into calibrated, synchronized episodes with 67-D actions."""
