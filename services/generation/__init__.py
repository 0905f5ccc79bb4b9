"""Imagined episodes: recorded actions replayed in an imagined world and stored."""
