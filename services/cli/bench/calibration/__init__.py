"""`dextouch bench calibration`: mounts and cameras of known places, found by ours and by others."""
