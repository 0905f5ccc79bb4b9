"""Rotations, rigid transforms, interpolation and pinhole cameras, all in float64."""
