"""Finds kinds of devices by name: those of this package, and those that other packages bring.

Both are entry points of one group and are loaded by the same code, when a station names them. Every
folder beside this file is one of ours, with or without an installation: its `kind` holds `KIND`.
"""

import pkgutil
import re
import sys
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, get_args

from dextouch.errors import DexTouchError, InvalidInputError, UnknownNameError
from services.acquisition.devices.kind import DeviceKind, DeviceSettings

ENTRY_POINT_GROUP = "dextouch.devices"
OWN_PACKAGE = "dextouch-wm"
NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
# What the import of another package's module may end in.
IMPORT_FAILURES = (
    ImportError,
    AttributeError,
    SyntaxError,
    NameError,
    TypeError,
    ValueError,
    LookupError,
    ArithmeticError,
    AssertionError,
    OSError,
    RuntimeError,
    DexTouchError,
)


def kind_names() -> list[str]:
    """Names of all kinds that a station's settings can name here, loaded or not."""
    return sorted({point.name for point in _points(tuple(sys.path))})


def device_kind(name: str) -> DeviceKind[Any]:
    """The kind of this name; its package is imported now, if it was not before.

    Raises:
        UnknownNameError: no package brings it.
        InvalidInputError: several do, or the one that does is broken.
    """
    found = [point for point in _points(tuple(sys.path)) if point.name == name]
    if not found:
        raise UnknownNameError("kind of device", name, kind_names())
    if len(found) > 1:
        packages = ", ".join(f"{package_of(point)} ({point.value})" for point in found)
        raise InvalidInputError(
            f"kind of device {name!r}: got {len(found)} packages that provide it, {packages}; "
            f"expected one: uninstall the others, or rename their entry points of the group "
            f"{ENTRY_POINT_GROUP!r}"
        )
    return _checked(found[0], _load(found[0]))


def package_of(point: EntryPoint) -> str:
    """The name of the package that an entry point comes with."""
    return OWN_PACKAGE if point.dist is None else point.dist.name


@lru_cache(maxsize=4)
def _points(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Ours, then those of installed packages; looking through the folders of `path` takes 0.1 s."""
    del path
    ours = [
        EntryPoint(folder.name, f"{__package__}.{folder.name}.kind:KIND", ENTRY_POINT_GROUP)
        for folder in pkgutil.iter_modules([str(Path(__file__).parent)])
        if folder.ispkg
    ]
    others = {(point.name, point.value): point for point in entry_points(group=ENTRY_POINT_GROUP)}
    return (*ours, *others.values())


def _load(point: EntryPoint) -> object:
    try:
        return point.load()
    except IMPORT_FAILURES as error:
        raise InvalidInputError(
            f"{_where(point)}: got {type(error).__name__}: {error}, expected a module that can be "
            f"imported; fix or uninstall package {package_of(point)}"
        ) from error


def _checked(point: EntryPoint, loaded: object) -> DeviceKind[Any]:
    """Refuse an object that is not a `DeviceKind` with this name."""
    if not isinstance(loaded, DeviceKind):
        raise _wrong(point, f"{type(loaded).__name__}", "a services.acquisition.devices.DeviceKind")
    if loaded.name != point.name or not NAME.fullmatch(loaded.name):
        raise _wrong(point, f"a kind named {loaded.name!r}", f"the entry point's name {point.name}")
    if not (isinstance(loaded.settings, type) and issubclass(loaded.settings, DeviceSettings)):
        raise _wrong(point, f"settings {loaded.settings!r}", "a class derived from DeviceSettings")
    field = loaded.settings.model_fields["kind"]
    if get_args(field.annotation) != (loaded.name,):
        raise _wrong(
            point,
            f"settings whose kind is {field.annotation}",
            f'kind: Literal["{loaded.name}"] = "{loaded.name}"',
        )
    if not callable(loaded.build):
        raise _wrong(point, f"build = {loaded.build!r}", "a function of settings and clock")
    return loaded


def _where(point: EntryPoint) -> str:
    return (
        f"kind of device {point.name!r} of package {package_of(point)} "
        f"(entry point {point.value} of group {ENTRY_POINT_GROUP})"
    )


def _wrong(point: EntryPoint, got: str, expected: str) -> InvalidInputError:
    return InvalidInputError(
        f"{_where(point)}: got {got}, expected {expected}; fix package {package_of(point)}"
    )
