"""Concurrent rollouts, each of which sends its next chunk as soon as it gets a response."""

import asyncio
import json
import time
from typing import Final, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from benchmarks.rollouts.ways import KIND, MAX_BYTES, START
from benchmarks.rollouts.worlds import MAX_STEPS, resting_actions
from dextouch.errors import InvalidInputError
from dextouch.streams import unpack

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
