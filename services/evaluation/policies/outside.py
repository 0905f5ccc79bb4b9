"""Custom policies, given on the command line as MODULE:FACTORY."""

import importlib
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from dextouch.clients import Policy, PolicyStart
from dextouch.errors import InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas import Observation
from services.evaluation.policies.asking import ask

_SOURCE = re.compile(r"(?:(?P<name>[^=]+)=)?(?P<module>[A-Za-z_][\w.]*):(?P<factory>[A-Za-z_]\w*)")


@dataclass(frozen=True)
class PolicySource:
    """Module and factory of a policy, and its name in the report."""

    name: str
    module: str
    factory: str

    @classmethod
    def parse(cls, text: str) -> "PolicySource":
        """Parse `MODULE:FACTORY` or `NAME=MODULE:FACTORY`.

        Raises:
            InvalidInputError: any other text.
        """
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

        Args:
            arguments: keyword arguments of the factory.

        Raises:
            NotFoundError: no such module.
            UnknownNameError: no such factory in the module; its callables are listed.
            InvalidInputError: the module or the factory raised (with its own traceback), or the
                policy has no `act`.
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
        policy = _loudly(factory, where=called, **arguments)
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


class _WithoutReset:
    """Adds an empty `reset` to a policy without one."""

    def __init__(self, act: Callable[[Observation], Any]) -> None:
        self.act = act

    def reset(self, start: PolicyStart) -> None:
        """Do nothing."""


def _loudly(call: Any, *arguments: object, where: str, **keywords: object) -> Any:  # noqa: ANN401
    """`ask`, with the traceback in the message for the policy's author.

    The cause of the error is the original exception.
    """
    try:
        return ask(call, *arguments, where=where, **keywords)
    except InvalidInputError as error:
        raise InvalidInputError(
            f"{error.message}\n{error.details['traceback']}"
        ) from error.__cause__


def _callables(module: ModuleType) -> list[str]:
    """Functions and classes that a module defines itself."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (inspect.isfunction(value) or inspect.isclass(value))
        and value.__module__ == module.__name__
    ]
