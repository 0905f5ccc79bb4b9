"""Run-time checks of annotations, as jaxtyping's import hook makes them, at a tenth of the cost.

jaxtyping binds and checks the arguments of every function twice, also where no array is among
them, and prepares the checks of every function that is imported. Here beartype checks them once,
from the first call on; only functions whose annotations name array shapes get a scope of their
own, in which an axis has one length in all arguments and the result. A function that a test calls
thousands of times, as training does, is checked in its first `CHECKED_CALLS` calls of that test.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from types import FunctionType
from typing import Any, ForwardRef, get_args, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

BY_JAXTYPING = jaxtyping.jaxtyped
CHECKED_CALLS = 16
_CHECKED = "__has_shape_checks__"
# What does not fit is a TypeError, as Python itself says it of wrong arguments.
_beartype = beartype(conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))


def install(packages: list[str]) -> None:
    """Check all functions and dataclasses of packages that are not imported yet."""
    # The hook of jaxtyping writes this decorator by its name into the code that it imports.
    jaxtyping.jaxtyped = decorated
    jaxtyping.install_import_hook(packages, "beartype.beartype")


class _Epoch:
    """Counts the tests, so that each begins with checks of its own."""

    number = 0


def begin_test() -> None:
    """Check the first calls of every function again."""
    _Epoch.number += 1


def decorated(item: Any = None, **_: Any) -> Any:
    """The decorator that stands above every function and class of the checked packages."""
    if item is None:
        return decorated
    if inspect.isclass(item):
        if dataclasses.is_dataclass(item) and not hasattr(item.__init__, _CHECKED):
            item.__init__ = checked(item.__init__)
        return item
    if not isinstance(item, FunctionType) or inspect.isgeneratorfunction(item):
        return BY_JAXTYPING(item, typechecker=_beartype)
    return checked(item)


def checked(function: Callable) -> Callable:
    """The function behind checks of its arguments and its result, made at its first call."""
    inside = None
    is_scope = False
    epoch = num_calls = 0

    @functools.wraps(function)
    def with_checks(*args, **kwargs):
        __tracebackhide__ = True
        nonlocal inside, is_scope, epoch, num_calls
        if epoch != _Epoch.number:
            epoch, num_calls = _Epoch.number, 0
        num_calls += 1
        if num_calls > CHECKED_CALLS:
            return function(*args, **kwargs)
        if inside is None:
            inside, is_scope = _made(function)
        if not is_scope:
            return inside(*args, **kwargs)
        with BY_JAXTYPING("context"):
            return inside(*args, **kwargs)

    setattr(with_checks, _CHECKED, True)
    return with_checks


def _made(function: Callable) -> tuple[Callable, bool]:
    """The function with checks, and whether it names arrays."""
    written = function.__annotations__
    hints = {name: _resolved(hint, function.__globals__) for name, hint in written.items()}
    function.__annotations__ = hints
    try:
        return _beartype(function), any(map(_names_arrays, hints.values()))
    finally:
        function.__annotations__ = written


def _resolved(hint: Any, names: dict[str, Any]) -> Any:
    """The annotation as an object; one of names that only type checkers know is not checked."""
    probe = FunctionType(_resolved.__code__, names)
    probe.__annotations__ = {"hint": hint}
    try:
        found = get_type_hints(probe, include_extras=True)["hint"]
    except (NameError, TypeError, AttributeError, ValueError, SyntaxError):
        return Any
    # beartype cannot follow what contains itself.
    return Any if _is_recursive(found) else found


def _is_recursive(hint: Any) -> bool:
    return isinstance(hint, ForwardRef) or any(map(_is_recursive, get_args(hint)))


def _names_arrays(hint: Any) -> bool:
    if inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(map(_names_arrays, get_args(hint)))
