"""Ways to send a chunk: ours over HTTP and WebSocket, and the servers they are compared with."""

import http.client
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from typing import Final, NamedTuple
from urllib.parse import urlencode, urlsplit

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
