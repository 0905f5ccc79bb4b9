"""Calibration of cameras, gloves, trackers, robot bases and stream latencies."""
