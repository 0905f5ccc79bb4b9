"""Imagined episodes: recorded actions played in an imagined world, back into the store."""
