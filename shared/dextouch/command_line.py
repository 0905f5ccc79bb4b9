"""Parser, JSON output and progress that all commands share, so that they look and behave alike."""

import argparse
import gc
import json
import os
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

from dextouch.errors import StorageError
from dextouch.free_text import printable

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

STANDARD_OUTPUT = Path("-")
RAY_HELP = (
    "run the jobs on this Ray cluster instead: auto, ray://HOST:10001, or local for one on this "
    "machine (docs/scaling.md)"
)
JSON_HELP = "also write the result as JSON to this file; - for standard output"
# Of lines in a log or pipe.
LINE_PERIOD_S = 5.0
Item = TypeVar("Item")
_result_stream: ContextVar[TextIO | None] = ContextVar("result_stream", default=None)
_help_parsers: ContextVar[list[argparse.ArgumentParser] | None] = ContextVar(
    "help_parsers", default=None
)


class HelpFormatter(argparse.HelpFormatter):
    """Help text whose plain paragraphs are wrapped and whose indented lines stay as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = textwrap.TextWrapper(width, initial_indent=indent, subsequent_indent=indent).fill
        return "\n\n".join(
            textwrap.indent(part, indent) if re.search(r"(?m)^\s", part) else fill(part)
            for part in textwrap.dedent(text).strip("\n").split("\n\n")
        )


class CommandParser(argparse.ArgumentParser):
    """Parser of a command, whose flags are never abbreviated; its `epilog` shows an example."""

    def __init__(self, **kwargs: Any) -> None:  # noqa: ANN401 - argparse's own
        kwargs.setdefault("formatter_class", HelpFormatter)
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(**kwargs)

    def print_help(self, file: "SupportsWrite[str] | None" = None) -> None:
        """Print the help, or hand this parser to `parser_behind`."""
        shown = _help_parsers.get()
        if shown is None:
            super().print_help(file)
        else:
            shown.append(self)


def parser_behind(show_help: Callable[[], object]) -> argparse.ArgumentParser | None:
    """The parser that `show_help`, a command with `--help`, would print; None if no parser did."""
    shown: list[argparse.ArgumentParser] = []
    token = _help_parsers.set(shown)
    try:
        with suppress(SystemExit), redirect_stdout(StringIO()):
            show_help()
    finally:
        _help_parsers.reset(token)
    return shown[0] if shown else None


class ProgressLines:
    """Progress of a long job as lines on standard error, where no terminal shows a bar.

    If it `has_bar`, a terminal shows that instead; `period_s` is the shortest time between lines.
    """

    def __init__(
        self,
        title: str,
        *,
        has_bar: bool = True,
        period_s: float = LINE_PERIOD_S,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title, self._period_s, self._clock_s = title, period_s, clock_s
        self._is_shown = not (has_bar and sys.stderr.isatty())
        self._last_s = clock_s()

    def show(self, text: str, *, is_last: bool = False) -> None:
        """Print how far the job is, unless a bar is shown or a line has just been printed."""
        now_s = self._clock_s()
        if self._is_shown and (is_last or now_s - self._last_s >= self._period_s):
            self._last_s = now_s
            sys.stderr.write(f"   {self._title} {text}".rstrip() + "\n")
            sys.stderr.flush()


def progress(items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
    """Iterate with a progress bar on standard error, or a line every few seconds elsewhere."""
    from rich.console import Console
    from rich.progress import track

    console, lines = Console(stderr=True), ProgressLines(what)
    shown = track(
        items, total=total, description=what, console=console, disable=not console.is_terminal
    )
    for done, item in enumerate(shown, start=1):
        yield item
        lines.show(f"{done} of {total}", is_last=done == total)


def add_workers(parser: argparse.ArgumentParser, default: int | None = None) -> None:
    """Add `--jobs N` (default: one per core) and `--ray ADDRESS`, for `dextouch.jobs.Workers`."""
    jobs = f"processes (default: {default or 'one per core'})"
    default = default or os.cpu_count() or 1
    parser.add_argument("--jobs", type=positive, default=default, metavar="N", help=jobs)
    parser.add_argument("--ray", metavar="ADDRESS", help=RAY_HELP)


def positive(text: str) -> int:
    """Parse a count of at least 1, for argparse."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number of at least 1")
    return int(text)


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add `--json PATH`, for a result that `write_result` writes."""
    parser.add_argument("--json", type=Path, metavar="PATH", help=JSON_HELP)


@contextmanager
def garbage_collection_paused() -> Iterator[None]:
    """Leave Python's garbage collector off while much is made that stays, as by imports.

    That saves a sixth of the time of `train world-model --plan`, most of which is imports. What
    nothing refers to is freed at once even so, except in reference cycles.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def say(line: str) -> None:
    """Print a line that may hold text of others."""
    sys.stdout.write(printable(line) + "\n")


def write_result(path: Path | None, result: object, *, allow_nan: bool = True) -> None:
    """Write the result of a command as JSON to a file; `-` is standard output, None writes nothing.

    Raises ValueError for a number that is not finite unless `allow_nan`, StorageError if the file
    cannot be written.
    """
    if path is not None:
        text = json.dumps(result, indent=2, ensure_ascii=False, allow_nan=allow_nan)
        write_json_text(path, text)


def write_json_text(path: Path | None, text: str) -> None:
    """Write JSON that is text already, as `write_result` does."""
    if path is None:
        return
    if path == STANDARD_OUTPUT:
        # Other escapes of JSON: what reads it gets the same text.
        print(printable(text, lines=True), file=_result_stream.get() or sys.stdout, flush=True)
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise StorageError(
            f"--json {path}: {error.strerror}; the command itself is done"
        ) from error


@contextmanager
def messages_aside(arguments: Sequence[str]) -> Iterator[None]:
    """With `--json -` among the arguments, print everything but the result to standard error."""
    if "--json=-" not in arguments and ("--json", "-") not in pairwise(arguments):
        yield
        return
    token = _result_stream.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _result_stream.reset(token)
