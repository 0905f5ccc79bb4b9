"""Edits of stored items, each a new item with lineage: trim, relabel, merge of stores."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
