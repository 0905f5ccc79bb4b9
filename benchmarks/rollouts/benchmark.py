"""Entry point of the benchmark stage `rollouts`: what a chunk costs beside an echo."""

import argparse
import http.client
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import numpy as np
from websockets.sync.client import connect

from benchmarks.figures import Figure, Requirement
from benchmarks.machine import describe_machine
from benchmarks.report import ResultTable, StageReport
from benchmarks.rollouts.server import MAX_STEPS, resting_actions
from benchmarks.rounds import interleaved
from benchmarks.stages import Bar
from dextouch.errors import InvalidInputError
from dextouch.schemas import ReturnSelector
from dextouch.serving import ChildProcess
from dextouch.streams import pack_openpi, unpack_openpi

START: Final = {"world": "still", "task": "rest", "seed": 0, "instruction": ""}
# What the chunk returns: the last image, or those of all 16 steps.
ANSWERS: Final = {
    "last image": ReturnSelector(steps="last"),
    "16 raw images": ReturnSelector(steps="all"),
}
WAYS: Final = ("HTTP", "WebSocket")
MAX_OVER_ECHO: Final = {"HTTP": 1.5, "WebSocket": 1.3}
USUAL: Final = {"rounds": 15, "chunks": 200}
QUICK: Final = {"rounds": 3, "chunks": 20}
# Fewer than a rollout may have (RolloutLimits.max_chunks).
MAX_CHUNKS: Final = 900

Chunk = Callable[[], int]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    parser.add_argument("--rounds", type=int, help="rounds (15; quick 3)")
    parser.add_argument("--chunks", type=int, help="chunks of each way in a round (200; quick 20)")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Time chunks of a world that computes nothing, and echoes of the same bytes, in turns.

    Raises:
        InvalidInputError: no round, or more chunks than a rollout may have.
    """
    del folder
    plan = dict(QUICK if options.quick else USUAL)
    plan |= {name: value for name in plan if (value := getattr(options, name)) is not None}
    if plan["rounds"] < 1 or not 1 <= plan["chunks"] <= MAX_CHUNKS:
        raise InvalidInputError(
            f"got {plan['rounds']} rounds of {plan['chunks']} chunks, expected at least one round "
            f"and 1 … {MAX_CHUNKS} chunks"
        )
    child = ChildProcess("benchmarks.rollouts.server")
    try:
        times_s, sizes = timed(child.receive(), plan, bar)
    finally:
        child.close()
    over = {
        (way, answer): times_s[f"{way}, {answer}, ours"].over(times_s[f"{way}, {answer}, echo"])
        for way in WAYS
        for answer in ANSWERS
    }
    return StageReport(
        stage="rollouts",
        machine=describe_machine(("numpy", "fastapi", "uvicorn", "websockets", "msgpack")),
        options=plan,
        tables=[_table(times_s, over, sizes)],
        panels=[],
        requirements=[
            Requirement(
                f"{way}, {answer}: a chunk over an echo of the same bytes, p50",
                figure.median,
                "at most",
                MAX_OVER_ECHO[way],
            )
            for (way, answer), figure in over.items()
        ],
        data={
            "seconds": {name: list(figure.values) for name, figure in times_s.items()},
            "bytes": {f"{way}, {answer}": size for (way, answer), size in sizes.items()},
        },
        notes=[
            "the world computes nothing; client and server are processes of their own; medians of "
            "the chunks of a round, medians over the rounds, ratios round by round"
        ],
    )


def timed(
    urls: Mapping[str, str], plan: Mapping[str, int], bar: Bar
) -> tuple[dict[str, Figure], dict[tuple[str, str], int]]:
    """Seconds of a chunk and of its echo, and bytes of the answers by way and kind."""
    subjects = {
        f"{way}, {answer}, {server}": (way, answer, server)
        for way in WAYS
        for answer in ANSWERS
        for server in ("ours", "echo")
    }
    sizes: dict[tuple[str, str], int] = {}

    def once(way: str, answer: str, server: str, _: int = 0) -> float:
        opened = _ours if server == "ours" else _echo
        with opened(urls, way, answer, sizes) as chunk:
            return _median_s(chunk, plan["chunks"])

    for way in WAYS:
        for answer in ANSWERS:
            once(way, answer, "ours")
    with bar("rounds", plan["rounds"] * len(subjects)) as step:
        found = interleaved(
            {name: partial(once, *subject) for name, subject in subjects.items()},
            plan["rounds"],
            on_step=step,
        )
    return {name: Figure.of(values) for name, values in found.items()}, sizes


def _median_s(chunk: Chunk, count: int) -> float:
    for _ in range(5):
        chunk()
    seconds = []
    for _ in range(count):
        started = time.perf_counter()
        chunk()
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds))


@contextmanager
def _ours(
    urls: Mapping[str, str], way: str, answer: str, sizes: dict[tuple[str, str], int]
) -> Iterator[Chunk]:
    """One rollout; every call advances it by a chunk and returns the bytes of the answer."""
    actions, selector = resting_actions(MAX_STEPS), ANSWERS[answer]
    if way == "WebSocket":
        address = urls["ours"].replace("http", "ws") + "/v1/openpi"
        with connect(address, compression=None, proxy=None) as socket:
            socket.recv()
            wanted = {"steps": selector.steps}
            socket.send(pack_openpi({"start": START, "return": wanted}))
            unpack_openpi(_bytes(socket.recv()), max_bytes=2**26)
            message = pack_openpi({"actions": actions})

            def send() -> int:
                socket.send(message)
                return len(_bytes(socket.recv()))

            sizes[way, answer] = send()
            yield send
        return
    with _connection(urls["ours"]) as post:
        start = post("/v1/rollouts", pack_json(START), "application/json")
        rollout_id = unpack_openpi(start, max_bytes=2**26)["fields"]["rollout"]["id"]
        chunks = iter(range(MAX_CHUNKS + 10))
        query = f"steps={selector.steps}"

        def step() -> int:
            path = f"/v1/rollouts/{rollout_id}/chunks/{next(chunks)}?{query}"
            kind = "application/octet-stream; dtype=float64"
            return len(post(path, actions.tobytes(), kind))

        sizes[way, answer] = step()
        yield step


@contextmanager
def _echo(
    urls: Mapping[str, str], way: str, answer: str, sizes: dict[tuple[str, str], int]
) -> Iterator[Chunk]:
    """Sends as many bytes as a chunk, and gets as many back."""
    size, body = sizes[way, answer], resting_actions(MAX_STEPS).tobytes()
    if way == "WebSocket":
        with connect(urls["messages"], compression=None, proxy=None, max_size=2**26) as socket:
            message = size.to_bytes(8, "little") + body

            def send() -> int:
                socket.send(message)
                return len(_bytes(socket.recv()))

            yield send
        return
    with _connection(urls["echo"]) as post:
        yield lambda: len(post(f"/{size}", body, "application/octet-stream"))


@contextmanager
def _connection(url: str) -> Iterator[Callable[[str, bytes, str], bytes]]:
    """POST requests over one connection, by the standard library's client."""
    with ExitStack() as stack:
        connection = http.client.HTTPConnection(urlsplit(url).netloc)
        stack.callback(connection.close)

        def post(path: str, body: bytes, kind: str) -> bytes:
            connection.request("POST", path, body, {"content-type": kind})
            return connection.getresponse().read()

        yield post


def _bytes(message: str | bytes) -> bytes:
    if isinstance(message, str):
        raise InvalidInputError(f"server: {message}")
    return message


def pack_json(fields: Mapping[str, object]) -> bytes:
    """Fields as a JSON body."""
    return json.dumps(fields).encode()


def _table(
    times_s: Mapping[str, Figure],
    over: Mapping[tuple[str, str], Figure],
    sizes: Mapping[tuple[str, str], int],
) -> ResultTable:
    rows = [
        (
            f"{way}, {answer}",
            f"{sizes[way, answer] / 1e3:.0f}",
            times_s[f"{way}, {answer}, ours"].scaled(1e3).text(),
            times_s[f"{way}, {answer}, echo"].scaled(1e3).text(),
            figure.text(),
        )
        for (way, answer), figure in over.items()
    ]
    columns = ("chunk of 16 steps", "kB", "ours ms", "echo ms", "ratio")
    return ResultTable("Time of a chunk", columns, rows)
