"""Worlds in which policies act: the protocol, rollouts, and their HTTP routes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
