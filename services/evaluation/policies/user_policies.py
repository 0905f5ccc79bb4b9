"""Custom policies, given on the command line as MODULE:FACTORY."""

import importlib
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float64

from dextouch.clients import Policy, PolicyStart
from dextouch.errors import InvalidInputError, NotFoundError, ShapeError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM, check_actions
from dextouch.schemas import Observation, WorldDescription

# Frames cut from tracebacks: this file and the import machinery.
_OUR_FRAMES = (__file__, "<frozen importlib", importlib.__file__)
_SOURCE = re.compile(r"(?:(?P<name>[^=]+)=)?(?P<module>[A-Za-z_][\w.]*):(?P<factory>[A-Za-z_]\w*)")


def ask(call: Callable[..., Any], *arguments: object, where: str) -> Any:  # noqa: ANN401 - whatever the policy gives
    """Call a function of a policy; InvalidInputError, with its own traceback, if it raised."""
    try:
        return call(*arguments)
    except (Exception, SystemExit) as error:  # a policy may raise anything
        raise InvalidInputError(
            f"{where} raised {type(error).__name__}: {error}", traceback=own_traceback(error)
        ) from error


def own_traceback(error: BaseException) -> str:
    """Traceback of an error without the frames that led to the policy's code."""
    trace = error.__traceback__
    while trace and trace.tb_frame.f_code.co_filename.startswith(_OUR_FRAMES):
        trace = trace.tb_next
    return "".join(traceback.format_exception(type(error), error, trace))


def action_chunk(
    answer: object, world: WorldDescription, *, where: str
) -> Float64[np.ndarray, "steps 67"]:
    """Validate the return value of a policy's `act` as an action chunk of a world.

    `answer` is an array, nested list or tensor [K, 67] of any kind of real number. Raises
    ShapeError for another shape, dtype or K than the world accepts, NonFiniteError for NaN.
    """
    rows = _array(answer, where)
    if rows.dtype.kind not in "fiu" or rows.ndim != 2 or rows.shape[1] != ACTION_DIM:
        found = type(answer).__name__
        if rows.dtype.kind != "O":
            found += f" of shape {list(rows.shape)} and {rows.dtype}"
        raise ShapeError(
            f"{where} returned {found}, expected an array [K, {ACTION_DIM}] of real numbers"
        )
    if not 0 < len(rows) <= world.max_chunk_steps or len(rows) % world.chunk_multiple:
        raise ShapeError(
            f"{where} returned {len(rows)} rows, expected a multiple of {world.chunk_multiple}, at "
            f"least {world.chunk_multiple} and at most {world.max_chunk_steps} (world "
            f"{world.name!r}); return only the rows that are to be carried out"
        )
    return check_actions(rows, where=f"{where} returned")


def _array(answer: object, where: str) -> np.ndarray:
    # A torch tensor that requires a gradient or lies on a GPU does not convert by itself.
    detach = getattr(answer, "detach", None)
    try:
        return np.asarray(answer if detach is None else detach().cpu().double())
    except Exception as error:  # arrays of other libraries convert themselves, or fail to
        raise ShapeError(
            f"{where} returned {type(answer).__name__}, which does not convert to an array "
            f"({error}), expected [K, {ACTION_DIM}]"
        ) from error


@dataclass(frozen=True)
class PolicySource:
    """Module and factory of a policy, and its name in the report."""

    name: str
    module: str
    factory: str

    @classmethod
    def parse(cls, text: str) -> "PolicySource":
        """Parse `MODULE:FACTORY` or `NAME=MODULE:FACTORY`; InvalidInputError for other texts."""
        match = _SOURCE.fullmatch(text)
        if match is None:
            raise InvalidInputError(
                f"policy: got {text!r}, expected MODULE:FACTORY or NAME=MODULE:FACTORY, such as "
                "mine=package.module:make_policy (the checkpoint of a cloned policy goes to "
                "--cloned-policy)"
            )
        module, factory = match["module"], match["factory"]
        return cls(match["name"] or f"{module}:{factory}", module, factory)

    def load(self, arguments: Mapping[str, Any]) -> Policy:
        """Import the module, also from the current directory, and call the factory.

        Raises NotFoundError without such a module, UnknownNameError without such a factory, and
        InvalidInputError if one of them raised (with its own traceback), or for no `act`.
        """
        where = f"policy {self.name!r}"
        module = self._module(where)
        if not hasattr(module, self.factory):
            raise UnknownNameError(
                f"factory of {where} in {getattr(module, '__file__', None) or self.module}",
                self.factory,
                _callables(module),
            )
        factory = getattr(module, self.factory)
        called = f"{where}: {self.module}:{self.factory}"
        if not callable(factory):
            raise InvalidInputError(
                f"{called} is {type(factory).__name__}, expected a function or class that returns "
                "the policy"
            )
        policy = _loudly(partial(factory, **arguments), where=called)
        if not callable(getattr(policy, "act", None)):
            raise InvalidInputError(
                f"{called} returned {type(policy).__name__} without a method act; expected an "
                "object with act(observation) that returns actions [K, 67]"
            )
        return policy if callable(getattr(policy, "reset", None)) else _WithoutReset(policy.act)

    def _module(self, where: str) -> ModuleType:
        here = str(Path.cwd())
        if here not in sys.path:
            sys.path.insert(0, here)
        try:
            return _loudly(
                importlib.import_module, self.module, where=f"{where}: import {self.module}"
            )
        except InvalidInputError as error:
            absent = error.__cause__
            if not isinstance(absent, ModuleNotFoundError) or not self._is_inside(absent.name):
                raise
        raise NotFoundError(
            f"{where}: no module {self.module!r} in {here} or on Python's path; run from the "
            "folder that holds it, or install it"
        )

    def _is_inside(self, package: str | None) -> bool:
        """Whether this is the module itself or one of its parent packages, not an import of it."""
        return package is not None and f"{self.module}.".startswith(f"{package}.")


def load_policies(
    addresses: Sequence[str],
    arguments: Mapping[str, Mapping[str, Any]],
    others: Sequence[str],
    *,
    other_option: str,
) -> dict[str, Policy]:
    """Custom policies by name, with the arguments of their factories by name.

    `others` are the names of all policies beside them, which `other_option` gives. Raises as
    `PolicySource.load`, InvalidInputError for two policies of one name, and UnknownNameError for
    arguments of another policy.
    """
    sources = [PolicySource.parse(text) for text in addresses]
    names = [source.name for source in sources]
    if unknown := sorted(set(arguments) - set(names)):
        raise UnknownNameError("policy of --policy-arguments", unknown[0], names)
    given = [*names, *others]
    if repeated := sorted({name for name in given if given.count(name) > 1}):
        option = "--policy NAME=MODULE:FACTORY" if repeated[0] in names else other_option
        raise InvalidInputError(f"policies: {repeated[0]!r} is given twice; rename one, {option}")
    return {source.name: source.load(arguments.get(source.name, {})) for source in sources}


class _WithoutReset:
    """Adds an empty `reset` to a policy without one."""

    def __init__(self, act: Callable[[Observation], Any]) -> None:
        self.act = act

    def reset(self, start: PolicyStart) -> None:
        """Do nothing."""


def _loudly(call: Any, *arguments: object, where: str) -> Any:  # noqa: ANN401
    """`ask`, with the traceback in the message for the policy's author."""
    try:
        return ask(call, *arguments, where=where)
    except InvalidInputError as error:
        raise InvalidInputError(
            f"{error.message}\n{error.details['traceback']}"
        ) from error.__cause__


def _callables(module: ModuleType) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (inspect.isfunction(value) or inspect.isclass(value))
        and value.__module__ == module.__name__
    ]
