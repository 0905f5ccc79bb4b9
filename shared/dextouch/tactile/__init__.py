"""Tactile sensing of a hand: taxel layout, contact threshold, pad forces and heat maps."""
