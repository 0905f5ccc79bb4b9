"""Slow and too many clients, as raw sockets at a real server: all get an end, others are served."""

import asyncio
import json
import select
import socket
import threading
import time
from contextlib import ExitStack, contextmanager, suppress

import httpx
import pytest
import uvicorn
from fastapi import APIRouter, Request, Response, WebSocket, WebSocketDisconnect
from structlog.testing import capture_logs

from dextouch.serving import (
    AS_SET,
    OCTETS,
    ServiceSettings,
    connections,
    create_service_app,
    server_options,
)
from dextouch.serving.connections import MAX_REFUSED, accept_messages_of
from dextouch.serving.guard import takes

TIMEOUT_S = 0.4
MAX_CONNECTIONS = 4
# Of a test; a machine under load ends connections late, but not never.
PATIENCE_S = 20
MIB = 2**20
POST = b"POST /v1/bodies HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/octet-stream\r\n"
GET = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n"
UPGRADE = (
    b"GET /v1/flow HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
)


class Served:
    """A service in a thread; `held` requests wait until they are let go."""

    def __init__(self, **settings):
        router = APIRouter(prefix="/v1")
        self.ended = []
        self.let_go = threading.Event()

        @router.post("/bodies")
        @takes({OCTETS: AS_SET})
        async def bodies(request: Request) -> int:
            try:
                return len(await request.body())
            finally:
                self.ended.append("body")

        @router.get("/held")
        async def held() -> str:
            await asyncio.to_thread(self.let_go.wait)
            return "done"

        @router.get("/large")
        async def large() -> Response:
            return Response(bytes(32 * MIB))

        @router.websocket("/flow")
        async def flow(websocket: WebSocket) -> None:
            await websocket.accept()
            with suppress(WebSocketDisconnect):
                while True:
                    await websocket.send_bytes(bytes(MIB))
            self.ended.append("flow")

        @router.websocket("/inbox")
        async def inbox(websocket: WebSocket) -> None:
            await websocket.accept()
            accept_messages_of(websocket, MIB)
            with suppress(WebSocketDisconnect):
                while True:
                    await websocket.send_text(str(len(await websocket.receive_bytes())))

        limits = {"client_timeout_s": TIMEOUT_S, "max_connections": MAX_CONNECTIONS} | settings
        made = ServiceSettings.model_validate(limits)
        app = create_service_app(name="probe", settings=made, routers=[router])
        self.server = uvicorn.Server(
            uvicorn.Config(app, **server_options(app.state.settings, grace_s=1))
        )
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.address = self._listening.getsockname()
        self.url = "http://{}:{}".format(*self.address)

    @contextmanager
    def running(self):
        thread = threading.Thread(target=self.server.run, args=([self._listening],), daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self.let_go.set()
            self.server.should_exit = True
            thread.join(PATIENCE_S)
            assert not thread.is_alive()

    def connect(self, first=b""):
        opened = socket.create_connection(self.address, timeout=PATIENCE_S)
        opened.sendall(first)
        return opened

    def until_none_is_left(self):
        """Wait until the server holds neither a connection nor a task."""
        deadline_s = time.monotonic() + PATIENCE_S
        state = self.server.server_state
        while state.connections or state.tasks:
            assert time.monotonic() < deadline_s, (state.connections, state.tasks)
            time.sleep(0.02)


@pytest.fixture
def served():
    with Served().running() as running:
        yield running


def dribble(opened, piece):
    """Send a piece every 50 ms until the other side has closed; all that it has answered."""
    received, deadline_s = b"", time.monotonic() + PATIENCE_S
    opened.settimeout(0.05)
    while time.monotonic() < deadline_s:
        try:
            data = opened.recv(2**16)
            if not data:
                return received
            received += data
        except TimeoutError:
            pass
        except ConnectionError:
            return received
        if not received:
            with suppress(ConnectionError):
                opened.sendall(piece)
    raise AssertionError(f"held for {PATIENCE_S} s: {received[:100]!r}")


def answer_of(opened):
    """One answer with its Content-Length."""
    with opened.makefile("rb") as stream:
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += stream.readline()
        return head + stream.read(int(head.lower().split(b"content-length: ")[1].split()[0]))


def parts(received):
    """Status, headers and problem of one answer."""
    head, _, body = received.partition(b"\r\n\r\n")
    status, *lines = head.decode().split("\r\n")
    headers = dict(line.lower().split(": ", 1) for line in lines)
    assert int(headers["content-length"]) == len(body)
    return int(status.split()[1]), headers, json.loads(body)


@pytest.mark.long
@pytest.mark.parametrize(
    ("first", "piece"),
    [
        pytest.param(b"GET / HTTP/1.1\r\nX-Slow: ", b"a", id="one header"),
        pytest.param(b"GET /", b"a", id="path"),
        pytest.param(GET, b"X-A: b\r\n", id="headers"),
        pytest.param(UPGRADE, b"X-A: b\r\n", id="handshake of a WebSocket"),
        pytest.param(POST + b"Content-Length: 100000\r\n\r\n", b"a", id="body"),
        pytest.param(
            POST + b"Transfer-Encoding: chunked\r\n\r\n", b"1\r\na\r\n", id="body in chunks"
        ),
    ],
)
def test_a_slow_request_is_refused(served, first, piece, caplog):
    with served.connect(first) as opened:
        status, headers, problem = parts(dribble(opened, piece))
    assert (status, headers["connection"]) == (408, "close")
    assert headers["content-type"] == "application/problem+json"
    assert problem["status"] == 408
    assert "expected the request within 0.4 s" in problem["detail"]
    served.until_none_is_left()
    assert not caplog.records


@pytest.mark.parametrize("piece", [b"", b"\r\n"])
def test_a_connection_without_a_request_is_closed(served, piece):
    with served.connect() as opened:
        dribble(opened, piece)
    served.until_none_is_left()


def test_empty_lines_after_a_request_do_not_hold_a_connection(served):
    with served.connect(GET + b"\r\n") as opened:
        assert answer_of(opened).startswith(b"HTTP/1.1 200")
        assert dribble(opened, b"\r\n") == b""
    served.until_none_is_left()


def test_the_body_of_a_refused_request_does_not_hold_a_connection(served):
    with served.connect(POST + b"Content-Length: 1000000000\r\n\r\n") as opened:
        assert answer_of(opened).startswith(b"HTTP/1.1 413")
        with suppress(ConnectionError):
            for _ in range(200):
                opened.sendall(bytes(2**16))
                time.sleep(0.01)
            pytest.fail("its body is read for ever")
    served.until_none_is_left()


@pytest.mark.parametrize(
    "first",
    [
        pytest.param(GET, id="many headers"),
        pytest.param(GET + b"X-Long: ", id="one header"),
        pytest.param(
            POST + b"Transfer-Encoding: chunked\r\n\r\n1\r\na\r\n0\r\n", id="after the body"
        ),
    ],
)
def test_endless_headers_are_refused(served, first):
    line = b"a" * 1000 if first.endswith(b": ") else b"X-A: " + b"b" * 993 + b"\r\n"
    with served.connect(first) as opened, suppress(ConnectionError):
        for _ in range(2000):
            opened.sendall(line)
        received = b""
        while data := opened.recv(2**16):
            received += data
        assert parts(received)[0] == 431
    served.until_none_is_left()


def status_of(served, request):
    """Status of a request that is sent at once, as a client of a fast network does."""
    with served.connect() as opened, suppress(ConnectionError):
        opened.sendall(request)
        received = b""
        while not received.partition(b"\r\n\r\n")[2]:
            data = opened.recv(2**16)
            if not data:
                break
            received += data
    return int(received.split(b" ")[1])


def padded(first, num_bytes, name=b"X-A: "):
    """A request of which the target and headers have this many bytes, with their separators."""
    line, _, headers = first.partition(b"\r\n")
    used = len(line.split(b" ")[1]) + len(headers) + len(name) + 2
    return first + name + b"b" * (num_bytes - used) + b"\r\n\r\n"


@pytest.mark.long
@pytest.mark.parametrize("first", [GET, UPGRADE, POST + b"Content-Length: 3\r\n"])
@pytest.mark.parametrize("num_bytes", [2**16 + 1, 100_000, 200_000])
def test_headers_over_the_limit_are_refused_however_they_arrive(first, num_bytes):
    with Served(client_timeout_s=PATIENCE_S).running() as served:
        body = b"abc" if first.startswith(b"POST") else b""
        assert status_of(served, padded(first, num_bytes) + body) == 431
        served.until_none_is_left()


def test_headers_of_the_limit_are_accepted():
    with Served(client_timeout_s=PATIENCE_S).running() as served:
        assert status_of(served, padded(GET, 2**16)) == 200


def test_many_headers_and_a_long_target_count_together():
    many = GET + b"".join(b"X-%d: %s\r\n" % (number, b"c" * 90) for number in range(700))
    target = GET.replace(b"/healthz", b"/healthz?" + b"q" * 2**16) + b"\r\n"
    with Served(client_timeout_s=PATIENCE_S).running() as served:
        assert status_of(served, many + b"\r\n") == 431
        assert status_of(served, target) == 431
        # Of the request in front of it, the client gets the answer.
        assert status_of(served, GET + b"\r\n") == 200


def test_trailers_count_as_headers(served):
    chunked = POST + b"Transfer-Encoding: chunked\r\n\r\n1\r\na\r\n0\r\n"
    assert status_of(served, chunked + b"X-A: " + b"d" * 2**17 + b"\r\n\r\n") == 431


def test_what_is_no_http_leaves_one_line_with_its_client(served):
    with capture_logs() as logs:
        for _ in range(15):
            assert status_of(served, b"\x16\x03\x01 hello\r\n\r\n") == 400
        assert status_of(served, padded(GET, 2**17)) == 431
    noted = [one for one in logs if one["event"] == "request_refused"]
    assert [(one["client"], one["status"]) for one in noted] == [("127.0.0.1", 400)] * 5 + [
        ("127.0.0.1", 431)
    ]


@pytest.mark.parametrize("asked", ["large", "flow"])
def test_a_client_that_does_not_read_is_cut_off(served, asked):
    first = UPGRADE if asked == "flow" else GET.replace(b"/healthz", b"/v1/large")
    with served.connect(first + b"\r\n") as opened:
        assert opened.recv(1)
        served.until_none_is_left()


def frame(kind, data, *, num_bytes=None):
    """A frame (RFC 6455, 5.2) masked with zeros; of one of `num_bytes` the rest is missing."""
    length = (num_bytes or len(data)).to_bytes(2, "big")
    return bytes([kind, 0x80 | 126]) + length + bytes(4) + data


BEGIN, REST, LAST, PING, BINARY = 0x02, 0x00, 0x80, 0x89, 0x82
PINGS = bytes([PING, 0x80 | 125, *bytes(4), *bytes(125)]) * 10


def inbox(served):
    opened = served.connect(UPGRADE.replace(b"/v1/flow", b"/v1/inbox"))
    opened.sendall(b"Sec-WebSocket-Extensions: permessage-deflate\r\n\r\n")
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        head += opened.recv(1)
    assert head.startswith(b"HTTP/1.1 101")
    # A message that is small on the way may not be large in memory.
    assert b"deflate" not in head.lower()
    return opened


@pytest.mark.parametrize(
    ("first", "piece"),
    [
        (frame(BEGIN, b"a"), frame(REST, b"a")),
        (frame(BEGIN, b"a" * 1000), PINGS),
        (frame(BINARY, b"a", num_bytes=60_000), b"a"),
    ],
    ids=["frames", "pings", "one frame"],
)
def test_a_message_that_does_not_end_is_cut_off(served, first, piece):
    with inbox(served) as opened:
        opened.settimeout(0.01)
        opened.sendall(first)
        deadline_s = time.monotonic() + 10 * TIMEOUT_S + 2
        with suppress(ConnectionError):
            while time.monotonic() < deadline_s:
                opened.sendall(piece)
                with suppress(TimeoutError):
                    # Answers to pings, or the end.
                    if not opened.recv(2**16):
                        break
                time.sleep(0.02)
            else:
                pytest.fail("its message is waited for")
    served.until_none_is_left()


def test_long_messages_in_many_frames_arrive_and_silence_between_them_is_no_mistake(served):
    with inbox(served) as opened:
        for _ in range(2):
            opened.sendall(frame(BEGIN, b"a"))
            for _ in range(40):
                # 40 KiB/s for longer than a slow client may take.
                opened.sendall(frame(REST, bytes(1024)))
                time.sleep(0.025)
            opened.sendall(frame(LAST, b"a"))
            assert opened.recv(100)[2:] == b"40962"
            time.sleep(2 * TIMEOUT_S)


def test_unfinished_messages_share_a_budget_and_the_first_begun_makes_room(monkeypatch):
    monkeypatch.setattr(connections, "MAX_UNFINISHED_BYTES", 400 * 1024)
    part = frame(BEGIN, bytes(60_000)) + 2 * frame(REST, bytes(60_000))
    with Served(client_timeout_s=60).running() as served, ExitStack() as stack:
        first, second, third = (stack.enter_context(inbox(served)) for _ in range(3))
        for opened in (first, second, third):
            opened.sendall(part)
            opened.sendall(frame(PING, b"?"))
            assert opened.recv(100)[-1:] == b"?"
        # A close frame (RFC 6455, 5.5.1) with status 1013, and the end.
        closed = first.makefile("rb").read()
        assert (closed[0], closed[2:4]) == (0x88, (1013).to_bytes(2, "big"))
        for opened in (second, third):
            opened.sendall(frame(LAST, b"a"))
            assert opened.recv(100)[2:] == b"180001"
        # Their bytes are free again.
        opened = stack.enter_context(inbox(served))
        opened.sendall(part + frame(LAST, b"a"))
        assert opened.recv(100)[2:] == b"180001"


@pytest.mark.long
def test_slow_but_steady_clients_are_served():
    """They take longer in all than a client may that is not as fast as 16 KiB/s."""
    piece = bytes(4 * 2**10)
    with Served(client_timeout_s=2).running() as served:
        with served.connect(POST + b"Content-Length: %d\r\n\r\n" % (20 * len(piece))) as opened:
            for _ in range(20):
                time.sleep(0.12)
                opened.sendall(piece)
            assert answer_of(opened).endswith(b"\r\n\r\n%d" % (20 * len(piece)))
        with served.connect(GET.replace(b"/healthz", b"/v1/large") + b"\r\n") as opened:
            num_bytes = 0
            while num_bytes < 32 * MIB:
                num_bytes += len(opened.recv(MIB))
                time.sleep(0.01)


@pytest.mark.long
def test_neither_long_work_nor_keep_alive_is_cut_off(served):
    with served.connect(GET.replace(b"/healthz", b"/v1/held") + b"\r\n") as opened:
        time.sleep(3 * TIMEOUT_S)
        served.let_go.set()
        assert answer_of(opened).endswith(b'"done"')
        time.sleep(3 * TIMEOUT_S)
        opened.sendall(GET + b"\r\n")
        assert answer_of(opened).startswith(b"HTTP/1.1 200")


def test_when_all_places_work_a_further_client_is_refused(served):
    held = [
        served.connect(GET.replace(b"/healthz", b"/v1/held") + b"\r\n")
        for _ in range(MAX_CONNECTIONS)
    ]
    while len(served.server.server_state.tasks) < MAX_CONNECTIONS:
        time.sleep(0.01)
    answer = httpx.get(f"{served.url}/healthz", trust_env=False)
    assert (answer.status_code, answer.headers["retry-after"]) == (503, "1")
    assert "4 connections" in answer.json()["detail"]
    assert answer.json()["details"] == {"retry_after_s": 1}
    served.let_go.set()
    for opened in held:
        assert answer_of(opened).endswith(b'"done"')
    assert httpx.get(f"{served.url}/healthz", trust_env=False).status_code == 200
    for opened in held:
        opened.close()


def test_idle_connections_make_room_oldest_first():
    with Served(client_timeout_s=60).running() as served:
        idle = [served.connect(first) for first in (b"", GET, b"GET", b"")]
        while len(served.server.server_state.connections) < MAX_CONNECTIONS:
            time.sleep(0.01)
        with httpx.Client(trust_env=False) as client:
            assert client.get(f"{served.url}/healthz").status_code == 200
            with suppress(ConnectionError):
                assert idle[0].recv(1) == b""
            idle[1].sendall(b"\r\n")
            assert answer_of(idle[1]).startswith(b"HTTP/1.1 200")
        for opened in idle:
            opened.close()


def test_a_flood_neither_grows_nor_stops_the_service():
    first = GET.replace(b"/healthz", b"/v1/held") + b"\r\n"
    with Served(client_timeout_s=60).running() as served, ExitStack() as opened:
        flood = [opened.enter_context(served.connect(first)) for _ in range(100)]
        deadline_s = time.monotonic() + PATIENCE_S
        answered = []
        while len(answered) < len(flood) - MAX_CONNECTIONS:
            assert time.monotonic() < deadline_s
            answered, _, _ = select.select(flood, [], [], 0.05)
        assert len(served.server.server_state.connections) <= MAX_CONNECTIONS + MAX_REFUSED
        for refused in answered:
            with suppress(ConnectionError):
                assert refused.recv(2**16)[9:12] in {b"503", b""}
        served.let_go.set()
        for held in set(flood) - set(answered):
            assert answer_of(held).endswith(b'"done"')
        assert httpx.get(f"{served.url}/healthz", trust_env=False).status_code == 200
