"""Name of the package `services` for code outside of this repository.

A wheel installs the services as `dextouch_services` (decision 0022). In a checkout this package
makes the same name available: its modules are those of `services`, not copies of them.
"""

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType

_TARGET = "services"


class _Alias(MetaPathFinder, InspectLoader):
    """Finds `dextouch_services.x` and loads it as `services.x`."""

    def __init__(self) -> None:
        self._specs: dict[str, ModuleSpec | None] = {}

    def find_spec(
        self, fullname: str, _path: Sequence[str] | None, _target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not fullname.startswith(f"{__name__}."):
            return None
        found = importlib.util.find_spec(_name_of(fullname))
        if found is None:
            return None
        spec = ModuleSpec(fullname, self, is_package=found.submodule_search_locations is not None)
        spec.origin = found.origin
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(_name_of(spec.name))
        self._specs[spec.name] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # The import system has given the module the spec of its alias.
        alias = module.__spec__
        if alias is not None:
            module.__spec__ = self._specs.pop(alias.name)

    def get_code(self, fullname: str) -> CodeType | None:
        """Code of a module that is run by `python -m`."""
        spec = importlib.util.find_spec(_name_of(fullname))
        loader = spec.loader if spec is not None else None
        return loader.get_code(spec.name) if spec and isinstance(loader, InspectLoader) else None

    def get_source(self, fullname: str) -> str | None:
        """Source of a module, for tracebacks."""
        spec = importlib.util.find_spec(_name_of(fullname))
        loader = spec.loader if spec is not None else None
        return loader.get_source(spec.name) if spec and isinstance(loader, InspectLoader) else None


def _name_of(alias: str) -> str:
    return _TARGET + alias.removeprefix(__name__)


sys.meta_path.insert(0, _Alias())
