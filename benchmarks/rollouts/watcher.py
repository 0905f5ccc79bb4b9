"""Watching a service as an open dashboard does: in a child process, and the time of a listing."""

import json
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from benchmarks.rollouts.ways import START, connection
from dextouch.serving import ChildProcess, serve_parent

PERIOD_S: Final = 0.2


@contextmanager
def watched(url: str) -> Iterator[None]:
    """Reads every new response of the service's newest rollout while the block runs."""
    child = ChildProcess("benchmarks.rollouts.watcher", url)
    try:
        child.receive()
        yield
    finally:
        child.close()


def listing_s(url: str, *, num_rollouts: int, num_listings: int) -> list[float]:
    """Times of `GET /v1/watch?limit=1` while a service has this many further open rollouts."""
    start = json.dumps(START | {"world": "still"}).encode()
    times_s = []
    with connection(url) as post:
        for _ in range(num_rollouts):
            post("/v1/rollouts?cameras=", start, "application/json")
    for _ in range(num_listings):
        started_s = time.perf_counter()
        with urllib.request.urlopen(f"{url}/v1/watch?limit=1") as answer:  # noqa: S310 - our own
            answer.read()
        times_s.append(time.perf_counter() - started_s)
    return times_s


def _watch(url: str) -> None:
    while True:
        with urllib.request.urlopen(f"{url}/v1/watch?limit=1") as answer:  # noqa: S310 - our own
            rollouts = json.load(answer)["rollouts"]
        for one in rollouts:
            with urllib.request.urlopen(f"{url}/v1/watch/{one['watch_id']}") as answer:  # noqa: S310
                answer.read()
        time.sleep(PERIOD_S)


def main() -> None:
    """Watch until standard input closes."""
    requests, answer = serve_parent(niceness=0)
    threading.Thread(target=_watch, args=sys.argv[1:], daemon=True).start()
    answer({"watches": sys.argv[1]})
    for _ in requests:
        pass


if __name__ == "__main__":
    main()
