"""Episode store service: receives recordings in batches, serves episodes and windows."""
