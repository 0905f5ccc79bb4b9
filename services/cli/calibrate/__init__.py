"""`dextouch station calibrate`: photos, poses and takes in; the matrices of recordings out."""

from services.cli.calibrate.command import main

__all__ = ["main"]
