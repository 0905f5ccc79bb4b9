"""The command group `dextouch study`."""
