"""Exports of a package that are imported at their first use (PEP 562).

They are listed once, in the block of imports that the package's `__init__` has for type checkers
(`from dextouch.streams.packing import pack as pack`). A package whose modules need different
libraries uses it, so that `dextouch.streams.pack` does not import what only
`dextouch.streams.encode_batch` needs.
"""

import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

_EXPORT = re.compile(r"^    from ([\w.]+) import (\w+) as \2$", re.MULTILINE)


def lazy_exports(
    package: str,
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """The `__getattr__`, `__dir__` and `__all__` of a package, read from its `__init__`.

    Args:
        package: full name of the package; what it imports from itself is a public module.
    """
    init = Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8")
    home_of = {name: module for module, name in _EXPORT.findall(init)}

    def get(name: str) -> object:
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if home_of[name] == package:
            return import_module(f"{package}.{name}")
        return getattr(import_module(home_of[name]), name)

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *home_of})

    return get, names, sorted(home_of)
