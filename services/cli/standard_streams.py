"""Standard output that is closed, full, or a pipe that nobody reads any more."""

import io
import os
import sys
from typing import TYPE_CHECKING, Final, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

# As shells tell of a program that SIGPIPE ended (128 + 13).
EXIT_BROKEN_PIPE: Final = 141
EXIT_NOT_WRITTEN: Final = 1

# Failures to write the standard streams of this process.
_failures: list[OSError] = []


class _Output(io.FileIO):
    """File of a standard stream that remembers why it could not be written."""

    def write(self, data: "ReadableBuffer", /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            _failures.append(error)
            raise


class StandardStreams:
    """The standard streams of a command, and why they could not be written.

    A stream that was closed by the caller is opened on nothing: otherwise the next file that is
    opened, such as a database, would be standard output. Writing to a closed standard output fails
    as it does in other programs.
    """

    def __init__(self) -> None:
        for number, flags in enumerate((os.O_RDONLY, os.O_RDONLY, os.O_WRONLY)):
            try:
                os.fstat(number)
            except OSError:
                # The lowest free number, which is this one.
                os.open(os.devnull, flags)
        if sys.stdin is None:
            sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
        # Not those that a test has put in their places.
        if sys.stdout is sys.__stdout__:
            sys.stdout = self._watched(sys.stdout, 1)
        if sys.stderr is sys.__stderr__:
            sys.stderr = self._watched(sys.stderr, 2)

    @staticmethod
    def _watched(stream: TextIO | None, number: int) -> TextIO:
        raw = _Output(number, "w", closefd=False)
        given: dict[str, str | bool] = {"encoding": "utf-8", "errors": "backslashreplace"}
        if isinstance(stream, io.TextIOWrapper):
            names = ("encoding", "errors", "line_buffering", "write_through")
            given = {name: getattr(stream, name) for name in names}
        # Python writes without a buffer if it was asked to (`python -u`).
        file = raw if given.get("write_through") else io.BufferedWriter(raw)
        return io.TextIOWrapper(file, **given)  # type: ignore[arg-type]

    def flush(self) -> None:
        """Write what waits in buffers.

        Not left to the end of the process, where a failure would be a traceback. Raises OSError if
        it cannot be written, or something before could not.
        """
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        if self.failure is not None:
            # Such as that of a help text, which argparse keeps to itself.
            raise self.failure

    @property
    def failure(self) -> OSError | None:
        """Why a stream could not be written."""
        return _failures[0] if _failures else None

    def status_after(self, failure: OSError, name: str) -> int:
        """Exit status after a failure, which is told unless nobody reads the output any more."""
        is_pipe = isinstance(failure, BrokenPipeError)
        if not is_pipe:
            text = f"dextouch {name}: standard output cannot be written: {failure.strerror}\n"
            os.write(2, text.encode())
        discard_output(with_errors=is_pipe)
        return EXIT_BROKEN_PIPE if is_pipe else EXIT_NOT_WRITTEN


def discard_output(*, with_errors: bool = False) -> None:
    """Lead standard output nowhere, with what is left in its buffer.

    At exit that would fail again, with a traceback of the interpreter.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2) if with_errors else (1,):
        os.dup2(nowhere, number)
    os.close(nowhere)
    _failures.clear()
