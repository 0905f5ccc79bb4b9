"""Policies of one's own, named on the command line as MODULE:FACTORY."""

import importlib
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from dextouch.clients.policy import Policy, PolicyStart
from dextouch.errors import InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas.rollouts import Observation
from services.evaluation.policies.asking import ask

_SOURCE = re.compile(r"(?:(?P<name>[^=]+)=)?(?P<module>[A-Za-z_][\w.]*):(?P<factory>[A-Za-z_]\w*)")


@dataclass(frozen=True)
class PolicySource:
    """Where a policy comes from, and what it is called in the report."""

    name: str
    module: str
    factory: str

    @classmethod
    def parse(cls, text: str) -> "PolicySource":
        """A source from `MODULE:FACTORY` or `NAME=MODULE:FACTORY`.

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
        """Import the module, from the current directory too, and call the factory.

        Args:
            arguments: of the factory, by keyword.

        Raises:
            NotFoundError: no such module.
            UnknownNameError: a module without the factory; callables it has are listed.
            InvalidInputError: the module or the factory raised (with its own traceback), or what
                it returned has no `act`.
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
        """Whether this is the module itself or a package around it, not something it imports."""
        return package is not None and f"{self.module}.".startswith(f"{package}.")


class _WithoutReset:
    """A policy that does not care where a rollout begins."""

    def __init__(self, act: Callable[[Observation], Any]) -> None:
        self.act = act

    def reset(self, start: PolicyStart) -> None:
        """Nothing to forget."""


def _loudly(call: Any, *arguments: object, where: str, **keywords: object) -> Any:  # noqa: ANN401
    """`ask`, with the traceback in the message: the policy's author needs it.

    The cause of the error is what the call raised.
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
