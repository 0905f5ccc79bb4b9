"""What services stand on: the application factory, settings, logs, keys, bus and state."""
