"""Command `dextouch stress`: checks of every stage under numerical hazards, also run as tests."""
