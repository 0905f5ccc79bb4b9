"""Fixtures of the contract suites: one real Redis server for all of them."""

import socket
from collections.abc import Iterator

import pytest

from tests.contracts.redis_server import running_redis


@pytest.fixture(scope="session")
def redis_url(tmp_path_factory) -> Iterator[str]:
    with running_redis(tmp_path_factory.mktemp("redis")) as url:
        yield url


@pytest.fixture
def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
