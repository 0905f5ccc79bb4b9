"""Calibration: what turns counts, pixels and stamps into kPa, rays and one time base."""
