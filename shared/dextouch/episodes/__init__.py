"""Store of episodes and recordings: crash-safe writers, random access readers, training windows."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
