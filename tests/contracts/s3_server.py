"""An S3 server of the moto package on a free loopback port."""

import http.client
import importlib.util
import json
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.programs import skip_or_fail

BUCKET = "takes"
# What the server accepts while it checks no credentials.
CREDENTIALS = {"access_key_id": "tester", "secret_access_key": "not-a-secret"}


class S3Server:
    """The address of a running server, and what only its owner may do."""

    def __init__(self, port: int) -> None:
        self.port = port

    @property
    def query(self) -> str:
        return f"endpoint=http://127.0.0.1:{self.port}&allow_http=true&region=us-east-1"

    def url(self, prefix: str, *, bucket: str = BUCKET) -> str:
        return f"s3://{bucket}/{prefix}?{self.query}"

    def request(self, method: str, path: str, body: bytes = b"") -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        try:
            connection.request(method, path, body)
            answer = connection.getresponse()
            return answer.status, answer.read()
        finally:
            connection.close()

    @contextmanager
    def checking_credentials(self) -> Iterator[None]:
        """No key is known to the server meanwhile."""
        self.request("POST", "/moto-api/reset-auth", b"0")
        try:
            yield
        finally:
            self.request("POST", "/moto-api/reset-auth", b"1000000000")

    @contextmanager
    def refusing_deletions(self, prefix: str) -> Iterator[None]:
        """The bucket's policy meanwhile lets nobody delete objects below a prefix."""
        statement = {"Effect": "Deny", "Principal": "*", "Action": "s3:DeleteObject"}
        statement["Resource"] = f"arn:aws:s3:::{BUCKET}/{prefix}/*"
        policy = json.dumps({"Version": "2012-10-17", "Statement": [statement]})
        assert self.request("PUT", f"/{BUCKET}?policy", policy.encode())[0] in {200, 204}
        try:
            yield
        finally:
            self.request("DELETE", f"/{BUCKET}?policy")


@contextmanager
def running_s3() -> Iterator[S3Server]:
    """A server with one empty bucket that lives as long as the context."""
    if importlib.util.find_spec("moto") is None or importlib.util.find_spec("flask") is None:
        skip_or_fail("no moto with flask installed; the same suite ran on a folder")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with subprocess.Popen(
        arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "Running on" in line:
                break
        else:
            pytest.fail(f"moto ended with {process.wait()}")
        server = S3Server(port)
        # A log of every request would fill the pipe and stop the server.
        log = threading.Thread(target=process.stderr.read)
        log.start()
        try:
            assert server.request("PUT", f"/{BUCKET}")[0] == 200
            yield server
        finally:
            process.terminate()
            process.wait()
            log.join()
