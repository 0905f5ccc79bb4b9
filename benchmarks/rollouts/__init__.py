"""Cost of a chunk: our server beside echoes of the same bytes."""
