"""`dextouch stress`: every stage under every numerical hazard, as checks that also are tests."""
