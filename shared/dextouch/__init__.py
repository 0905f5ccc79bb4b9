"""Shared library of the DexTouch services: data types, geometry, clocks, storage, clients."""

__version__ = "0.1.0"
