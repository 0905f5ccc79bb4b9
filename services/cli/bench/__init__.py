"""`dextouch bench STAGE`: a stage of the platform timed against its error, beside its rivals."""
