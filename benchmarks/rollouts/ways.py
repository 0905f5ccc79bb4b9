"""Worlds of the benchmark, ways to send them chunks, and the servers they are compared with."""

import asyncio
import http.client
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import urlencode, urlsplit

import numpy as np
from jaxtyping import Float64
from websockets.sync.client import ClientConnection, connect

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses, check_actions
from dextouch.schemas import EVERYTHING, Observation, ReturnSelector, RolloutStart, WorldDescription
from dextouch.streams import HEAD_CAMERA, pack_openpi, unpack, unpack_openpi
from dextouch.worlds import StartedRollout, SteppedRollout

SIZE_PX = 64
MAX_STEPS = 16
# A batch of n takes 5 ms · (0.8 + 0.2 n).
DEVICE_S = 5e-3
FIXED_SHARE = 0.8


def resting_actions(num_steps: int) -> Float64[np.ndarray, "steps 67"]:
    """Actions that hold everything still."""
    rows = np.zeros((num_steps, 67))
    for part in POSE_SLICES:
        rows[:, part] = IDENTITY_POSE_9D
    return rows


class StillWorld:
    """Returns the same prepared observation for every chunk.

    `is_quick`: whether the service may call it in its event loop.
    """

    def __init__(self, *, is_quick: bool = True) -> None:
        self.is_quick = is_quick
        self.description = WorldDescription(
            name="still",
            kind="model",
            digest="still",
            tasks=("rest",),
            cameras=(HEAD_CAMERA,),
            image_height_px=SIZE_PX,
            image_width_px=SIZE_PX,
            model_rate_hz=15.0,
            action_kinds=("commanded",),
            starts_from=("task_seed",),
            max_chunk_steps=MAX_STEPS,
        )
        generator = np.random.default_rng(0)
        # A slope of colours with the noise of a camera, so that JPEG has usual work to do.
        place = np.arange(SIZE_PX)
        slope = 2.0 * place[:, None, None] + place[:, None] + np.array([0.0, 20.0, 40.0])
        noise = generator.normal(0.0, 2.0, (MAX_STEPS, SIZE_PX, SIZE_PX, 3))
        self._images = np.clip(slope + noise, 0, 255).astype(np.uint8)
        self._touch = generator.random((MAX_STEPS, 2, 320), dtype=np.float32)

    def reset(self, start: RolloutStart) -> StartedRollout[int]:
        """See World."""
        anchor = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))
        return StartedRollout(0, self._seen(0, resting_actions(1)), anchor, np.eye(3))

    def step(
        self,
        state: int,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[int]:
        """See World."""
        seen = self._seen(state + 1, check_actions(actions)).selected(selector)
        return SteppedRollout(state + len(actions), seen)

    def snapshot(self, state: int) -> bytes:
        """See World."""
        return str(state).encode()

    def restore(self, data: bytes) -> int:
        """See World."""
        return int(data)

    def _seen(self, first_step: int, actions: np.ndarray) -> Observation:
        n = len(actions)
        return Observation(
            first_step=first_step,
            images={HEAD_CAMERA: self._images[:n]},
            tactile_kpa=self._touch[:n],
            action_reached=actions,
            reached_is_measured=True,
        )


class Device(StillWorld):
    """Simulated device that computes one rollout at a time."""

    def step(
        self,
        state: int,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[int]:
        """See World."""
        time.sleep(DEVICE_S)
        return super().step(state, actions, seed=seed, selector=selector)


class BatchDevice(Device):
    """Simulated device whose time per batch hardly depends on the batch size."""

    def step_batch(
        self,
        states: Sequence[int],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[int]]:
        """See BatchWorld."""
        time.sleep(DEVICE_S * (FIXED_SHARE + (1 - FIXED_SHARE) * len(states)))
        requested = [EVERYTHING] * len(states) if selectors is None else selectors
        return [
            StillWorld.step(self, state, chunk, seed=seed, selector=selector)
            for state, chunk, seed, selector in zip(states, actions, seeds, requested, strict=True)
        ]


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
            returned = way.selector.model_dump(mode="json")
            socket.send(pack_openpi({"start": start, "return": returned}))
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


def processor_s(pid: int) -> float:
    """Processor time that the threads of a process have taken so far, to a nanosecond."""
    spent_s = 0.0
    for task in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        # A thread may end meanwhile.
        with suppress(FileNotFoundError, ProcessLookupError):
            spent_s += 1e-9 * int(task.read_text().split()[0])
    return spent_s


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

    Raises TimeoutError if they are not done after a minute.
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
