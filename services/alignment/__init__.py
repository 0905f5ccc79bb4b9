"""Alignment: recordings in, calibrated and synchronized episodes with 67-D actions out."""
