"""A real redis-server on a free loopback port for the tests that need one."""

import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.programs import needed_program


@contextmanager
def running_redis(folder: Path) -> Iterator[str]:
    """The address of an empty server that lives as long as the context."""
    program = needed_program("redis-server", package="redis-server")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = ["--port", str(port), "--bind", "127.0.0.1", "--save", "", "--dir", str(folder)]
    with subprocess.Popen(
        [program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "Ready to accept connections" in line:
                break
        else:
            pytest.fail(f"redis-server ended with {process.wait()}")
        yield f"redis://127.0.0.1:{port}/0"
        process.terminate()
        process.stdout.read()
