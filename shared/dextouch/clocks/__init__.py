"""Clock models: counter unwrapping, and device time to host time, offline and online."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
