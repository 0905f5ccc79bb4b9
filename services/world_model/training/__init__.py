"""Training: episodes to windows, windows to a loss, a loss to a measured checkpoint."""
