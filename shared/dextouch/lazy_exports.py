"""Exports of a package that are imported at their first use (PEP 562).

A package whose modules need different libraries uses it, so that `dextouch.streams.pack` does not
import what only `dextouch.streams.encode_batch` needs.
"""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module


def lazy_exports(
    package: str, names_by_module: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """The functions `__getattr__` and `__dir__` of a package.

    Args:
        package: full name of the package.
        names_by_module: exported names by the module that defines them, separated by spaces.
    """
    module_of = {
        name: f"{package}.{module}"
        for module, names in names_by_module.items()
        for name in names.split()
    }

    def get(name: str) -> object:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(module_of[name]), name)

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *module_of})

    return get, names
