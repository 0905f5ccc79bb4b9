"""Command line `dextouch`, the only package that imports every service."""
