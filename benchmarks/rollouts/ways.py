"""Ways to send chunks, one rollout or many at a time, and the servers they are compared with."""

import asyncio
import http.client
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from typing import Final, NamedTuple
from urllib.parse import urlencode, urlsplit

import numpy as np
from websockets.sync.client import ClientConnection, connect

from benchmarks.rollouts.worlds import MAX_STEPS, resting_actions
from dextouch.errors import InvalidInputError
from dextouch.schemas import ReturnSelector
from dextouch.streams import pack_openpi, unpack, unpack_openpi

START: Final = {"world": "still", "task": "rest", "seed": 0, "instruction": ""}
KIND: Final = "application/octet-stream; dtype=float64"
# Fewer than a rollout may have (RolloutLimits.max_chunks).
MAX_CHUNKS: Final = 900
MAX_BYTES: Final = 2**26

Chunk = Callable[[], int]


class Way(NamedTuple):
    """How chunks are sent: protocol, what they return, the server's world and state, watchers."""

    protocol: str
    answer: str
    selector: ReturnSelector
    world: str = "still"
    server: str = "ours"
    is_watched: bool = False

    @property
    def query(self) -> str:
        """Query of a request over HTTP."""
        return urlencode({"steps": self.selector.steps, "images": self.selector.images})


@contextmanager
def opened(urls: Mapping[str, str], way: Way) -> Iterator[Chunk]:
    """One rollout; every call advances it by a chunk and returns the size of the response."""
    start, actions = START | {"world": way.world}, resting_actions(MAX_STEPS)
    if way.protocol == "WebSocket":
        address = urls[way.server].replace("http", "ws") + "/v1/openpi"
        with connect(address, compression=None, proxy=None) as socket:
            socket.recv()
            wanted = way.selector.model_dump(mode="json")
            socket.send(pack_openpi({"start": start, "return": wanted}))
            unpack_openpi(_bytes(socket.recv()), max_bytes=MAX_BYTES)
            yield partial(_exchanged, socket, pack_openpi({"actions": actions}))
        return
    with connection(urls[way.server]) as post:
        begun = post("/v1/rollouts", json.dumps(start).encode(), "application/json")
        rollout_id = unpack(begun, max_bytes=MAX_BYTES)[0]["rollout"]["id"]
        chunks, body = iter(range(MAX_CHUNKS + 10)), actions.tobytes()

        def step() -> int:
            path = f"/v1/rollouts/{rollout_id}/chunks/{next(chunks)}?{way.query}"
            return len(post(path, body, KIND))

        yield step


@contextmanager
def compared(urls: Mapping[str, str], way: Way, num_bytes: int) -> Iterator[Chunk]:
    """A bare echo that gives the same number of bytes, or a minimal WebSocket server."""
    actions = resting_actions(MAX_STEPS)
    if way.protocol == "WebSocket":
        with connect(urls["messages"], compression=None, proxy=None, max_size=MAX_BYTES) as socket:
            message = pack_openpi({"actions": actions, "steps": way.selector.steps})
            yield partial(_exchanged, socket, message)
        return
    with connection(urls["echo"]) as post:
        yield lambda: len(post(f"/{num_bytes}", actions.tobytes(), KIND))


@contextmanager
def connection(url: str) -> Iterator[Callable[[str, bytes, str], bytes]]:
    """POST requests over one connection, by the standard library's client."""
    with closing(http.client.HTTPConnection(urlsplit(url).netloc)) as opened:

        def post(path: str, body: bytes, kind: str) -> bytes:
            opened.request("POST", path, body, {"content-type": kind})
            answer = opened.getresponse()
            content = answer.read()
            if answer.status >= http.client.BAD_REQUEST:
                raise InvalidInputError(f"{path}: got status {answer.status}: {content[:500]!r}")
            return content

        yield post


def _exchanged(socket: ClientConnection, message: bytes) -> int:
    """Send a message; the size of the response."""
    socket.send(message)
    return len(_bytes(socket.recv()))


def _bytes(message: str | bytes) -> bytes:
    if isinstance(message, str):
        raise InvalidInputError(f"server: {message}")
    return message


# A rollout that fails keeps the others waiting.
TIMEOUT_S: Final = 60.0


class Crowd(NamedTuple):
    """Chunks per second of all rollouts together, and how long each waited."""

    chunks_per_s: float
    p50_s: float
    p99_s: float


def crowd(url: str, world: str, num_rollouts: int, num_chunks: int) -> Crowd:
    """Advance rollouts of a world at the same time; the first chunk of each is not counted.

    Raises:
        TimeoutError: not done after a minute.
    """

    async def limited() -> Crowd:
        async with asyncio.timeout(TIMEOUT_S):
            return await _crowd(url, world, num_rollouts, num_chunks)

    return asyncio.run(limited())


async def _crowd(url: str, world: str, num_rollouts: int, num_chunks: int) -> Crowd:
    latencies_s: list[float] = []
    began = asyncio.Barrier(num_rollouts + 1)

    async def play() -> None:
        place = urlsplit(url)
        reader, writer = await asyncio.open_connection(place.hostname, place.port)
        body = json.dumps(START | {"world": world}).encode()
        begun = await _post(reader, writer, "/v1/rollouts?cameras=", body, "application/json")
        path = f"/v1/rollouts/{unpack(begun, max_bytes=MAX_BYTES)[0]['rollout']['id']}"
        actions = resting_actions(MAX_STEPS).tobytes()
        for chunk in range(num_chunks + 1):
            started = time.perf_counter()
            query = f"{path}/chunks/{chunk}?steps=last"
            await _post(reader, writer, query, actions, KIND)
            if chunk:
                latencies_s.append(time.perf_counter() - started)
            else:
                await began.wait()
        writer.write(f"DELETE {path} HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n".encode())
        await writer.drain()
        await reader.readuntil(b"\r\n\r\n")
        writer.close()

    async with asyncio.TaskGroup() as playing:
        for _ in range(num_rollouts):
            playing.create_task(play())
        await began.wait()
        started = time.perf_counter()
    duration_s = time.perf_counter() - started
    p50_s, p99_s = np.percentile(latencies_s, [50, 99])
    return Crowd(len(latencies_s) / duration_s, float(p50_s), float(p99_s))


async def _post(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, path: str, body: bytes, kind: str
) -> bytes:
    head = f"POST {path} HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: {kind}\r\n"
    writer.write(f"{head}content-length: {len(body)}\r\n\r\n".encode() + body)
    found = (await reader.readuntil(b"\r\n\r\n")).lower()
    size = int(found.split(b"content-length: ")[1].split(b"\r\n")[0])
    content = await reader.readexactly(size)
    if not found.startswith(b"http/1.1 20"):
        raise InvalidInputError(f"{path}: got {content[:500]!r}")
    return content
