"""Edits of stored items with lineage (trim, relabel, merge of stores), and backups of a store."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
