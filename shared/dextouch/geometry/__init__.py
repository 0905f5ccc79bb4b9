"""Rotations, rigid transforms, interpolation and pinhole cameras in float64."""
