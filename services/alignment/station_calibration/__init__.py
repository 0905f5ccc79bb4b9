"""Guided calibration of a station's devices, for the command line and for the operators' page."""
