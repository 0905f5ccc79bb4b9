"""Building blocks of services: application factory, settings, logging, access, state, processes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
