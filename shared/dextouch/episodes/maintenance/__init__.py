"""Care of a store: inspection for damage, repair with salvage of intact samples, and deletion."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
