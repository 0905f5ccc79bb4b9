"""Registry of the benchmark stages by name, loaded lazily."""

import argparse
import importlib
import tomllib
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from dextouch.errors import InvalidInputError, UnknownNameError

T = TypeVar("T")
# Opens a progress bar: (what, number of steps) → a function that is called with each step's name.
Bar = Callable[[str, int], AbstractContextManager[Callable[[str], None]]]


@dataclass(frozen=True)
class Amounts:
    """Amounts that a stage measures by name: usual and quick ones, and options for some."""

    usual: dict[str, Any]
    quick: dict[str, Any]

    def add_options(self, parser: argparse.ArgumentParser, **what: str) -> None:
        """Add an option for each of these amounts; the texts say of what."""
        for name, text in what.items():
            usual, quick = self.usual[name], self.quick[name]
            flag = f"--{name.replace('_', '-')}"
            parser.add_argument(flag, type=type(usual), help=f"{text} ({usual:g}; quick {quick:g})")

    def of(self, options: argparse.Namespace, **least: int | float) -> dict[str, Any]:
        """The amounts of a run, those that options set instead of the default ones.

        Raises InvalidInputError for an option that is less than 1, or than `least` says.
        """
        plan = {}
        for name, default in (self.quick if options.quick else self.usual).items():
            given = getattr(options, name, None)
            plan[name] = default if given is None else given
            if not plan[name] >= (bound := least.get(name, 1)):
                flag = name.replace("_", "-")
                raise InvalidInputError(
                    f"--{flag}: got {plan[name]:g}, expected at least {bound:g}"
                )
        return plan


class StageEntry(NamedTuple):
    """Module, summary and help text of a stage."""

    module: str
    does: str
    teaches: str


def _stages() -> dict[str, StageEntry]:
    """The stages of `stages.toml`; its lines break where its text need not."""
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
    return {
        name: StageEntry(entry["module"], entry["does"], " ".join(entry["teaches"].split("\n")))
        for name, entry in table.items()
    }


STAGES = _stages()


def named(kind: str, known: Mapping[str, T], names: str) -> dict[str, T]:
    """Those of the comma-separated names; raises UnknownNameError for a name that there is not."""
    found = [name.strip() for name in names.split(",")]
    for name in found:
        if name not in known:
            raise UnknownNameError(kind, name, list(known))
    return {name: known[name] for name in found}


def load_stage(name: str) -> Any:  # noqa: ANN401 - a module
    """The module of a known stage: options of its own, and a function that measures.

    `add_options(parser)` adds to --quick, --json, --out and --check, which every stage has;
    `measure(options, folder, bar)` returns a `StageReport` and may write to the folder, which the
    caller removes. It raises InvalidInputError and UnknownNameError for options that measure
    nothing or do not fit, and ConflictError if a command that it runs failed.
    """
    return importlib.import_module(STAGES[name].module)
