"""Dynamics of a scene: readers find the objects at the start, recurrent cores move them."""
