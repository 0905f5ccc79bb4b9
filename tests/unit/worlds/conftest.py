"""Fixtures of the worlds' tests: a state store, in memory and behind a real Redis server."""

import pytest
from redis import Redis

from dextouch.serving import open_state
from tests.contracts.redis_server import running_redis


@pytest.fixture(scope="session")
def redis_url(tmp_path_factory):
    with running_redis(tmp_path_factory.mktemp("redis")) as url:
        yield url


@pytest.fixture(params=["memory", "redis"])
async def state(request):
    url = "memory://"
    if request.param == "redis":
        url = request.getfixturevalue("redis_url")
        with Redis.from_url(url) as server:
            server.flushall()
    store = open_state(url)
    yield store
    await store.close()
