"""Commands of `dextouch store`: inspect, delete, repair."""
