"""Transports: four methods that move bytes between a driver and a port, device or socket."""
