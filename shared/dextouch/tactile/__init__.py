"""Taxel layout, contact decision and heat maps of a hand."""
