"""Tactile sensing of a hand: taxel layout, contact threshold, pad forces and heat maps."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
