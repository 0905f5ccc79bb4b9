"""Clients of the DexTouch services for policies and stations, with few dependencies."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
