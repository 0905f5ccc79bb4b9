"""Patience of the HTTP client with a service that is full, restarting, or behind a proxy."""

import json
import threading
from contextlib import closing
from http.server import BaseHTTPRequestHandler, HTTPServer

import httpx
import pytest

from dextouch.clients import EpisodeStoreClient, HttpLink, RolloutClient
from dextouch.errors import AccessDeniedError, ConflictError, InvalidInputError, UnavailableError
from dextouch.serving.keys import no_key

PROBLEM = (
    b'{"type": "urn:dextouch:error:UnavailableError", "title": "t", "status": 503, "detail": "d"}'
)
OURS = {"Content-Type": "application/problem+json"}


@pytest.mark.parametrize("client", [HttpLink, RolloutClient, EpisodeStoreClient])
@pytest.mark.parametrize(
    "url",
    [
        "http://h:abc",
        "http://h:99999",
        "http://[::1",
        "h:80",
        "ftp://h",
        "http://",
        "",
        "http://h:0",
    ],
)
def test_an_address_that_cannot_be_one_is_refused(client, url):
    with pytest.raises(InvalidInputError, match=r"expected http\(s\)://HOST:PORT"):
        client(url)


@pytest.fixture
def scripted():
    """A server that gives the listed responses (status, headers, body), then 200."""
    script, bodies = [], []

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self):
            bodies.append(self.rfile.read(int(self.headers["Content-Length"])))
            status, headers, body = script.pop(0) if script else (200, {}, b"yes")
            if status is None:
                self.close_connection = True
                return
            self.send_response(status)
            for name, value in (headers | {"Content-Length": len(body)}).items():
                self.send_header(name, str(value))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}", script, bodies
        server.shutdown()
        thread.join()


def link_to(url, patience_s=30.0):
    pauses = []
    link = HttpLink(url, patience_s=patience_s, pause=pauses.append)
    assert link.request("POST", "/", body=b"first").body == b"yes"
    return link, pauses


def test_a_key_may_end_with_the_end_of_its_file(scripted):
    url, _, _ = scripted
    key, sent = "a-key-of-some-length", []

    def reply(request):
        sent.append(request.headers["authorization"])
        return httpx.Response(200, json={"uploads": []})

    with closing(HttpLink(url, api_key=f"{key}\r\n")) as link:
        assert link.request("POST", "/", body=b"").body == b"yes"
    EpisodeStoreClient(url, f"{key}\n", transport=httpx.MockTransport(reply)).uploads()
    assert sent == [f"Bearer {key}"]


def test_a_refused_key_says_which_service_refused_it(scripted):
    url, script, _ = scripted
    detail = no_key("Bearer wrong").message
    problem = {"type": "urn:dextouch:error:AccessDeniedError", "title": "t", "status": 401}
    script.append((401, OURS, json.dumps(problem | {"detail": detail}).encode()))
    with closing(HttpLink(url)) as link, pytest.raises(AccessDeniedError) as refused:
        link.request("POST", "/v1/any", body=b"")
    assert refused.value.message == f"POST {url}/v1/any: {detail}"
    reply = httpx.Response(401, json=problem | {"detail": detail})
    store = EpisodeStoreClient(url, transport=httpx.MockTransport(lambda _: reply))
    with pytest.raises(AccessDeniedError, match=f"GET {url}/v1/uploads: unknown key: expected"):
        store.uploads()


def test_it_waits_as_long_as_asked_and_sends_the_same_again(scripted):
    url, script, bodies = scripted
    link, pauses = link_to(url)
    script += [
        (503, OURS | {"Retry-After": "3"}, PROBLEM),
        (429, OURS | {"retry-after": "1"}, PROBLEM),
        (502, {"Content-Type": "text/html"}, b"bad gateway"),
        (500, {}, b"Internal Server Error"),
        (None, {}, b""),
        (504, {}, b""),
    ]
    assert link.request("POST", "/", body=b"chunk").body == b"yes"
    assert pauses == [3.0, 1.0, 0.8, 0.8, 0.8, 0.8]
    assert bodies == [b"first", *[b"chunk"] * 7]
    link.close()


def test_patience_ends(scripted):
    url, script, _ = scripted
    link, pauses = link_to(url, patience_s=4.0)
    script += [(503, OURS | {"Retry-After": "2"}, PROBLEM)] * 9
    with pytest.raises(UnavailableError, match=r"^d$"):
        link.request("POST", "/", body=b"")
    assert pauses == [2.0, 2.0]
    link.close()


def test_lost_connections_are_tried_beyond_the_usual_pauses_only_by_the_patient(scripted):
    url, script, _ = scripted
    for patience_s, expected in ((0.0, [0.05, 0.2, 0.8]), (2.7, [0.05, 0.2, 0.8, 0.8, 0.8])):
        link, pauses = link_to(url, patience_s)
        script[:] = [(None, {}, b"")] * 20
        with pytest.raises(UnavailableError, match=f"no answer in {1 + len(expected)} attempts"):
            link.request("POST", "/", body=b"")
        assert pauses == expected
        # Whoever has waited in vain does not wait again for each further request.
        with pytest.raises(UnavailableError, match="no answer in 4 attempts"):
            link.request("POST", "/", body=b"")
        script.clear()
        link.close()


def test_what_time_does_not_change_is_told_at_once(scripted):
    url, script, _ = scripted
    link, pauses = link_to(url)
    conflict = PROBLEM.replace(b"UnavailableError", b"ConflictError").replace(b"503", b"409")
    script += [(409, OURS, conflict), (503, OURS, PROBLEM)]
    for expected in (ConflictError, UnavailableError):
        with pytest.raises(expected):
            link.request("POST", "/", body=b"")
    assert pauses == []
    link.close()


def test_nobody_waits_for_a_service_that_was_never_there(free_port):
    pauses = []
    link = HttpLink(f"http://127.0.0.1:{free_port}", patience_s=30.0, pause=pauses.append)
    with pytest.raises(UnavailableError, match="is the service running"):
        link.request("GET", "/")
    assert pauses == [0.05, 0.2, 0.8]


def test_no_message_has_a_password_of_the_address():
    problem = {"type": "urn:dextouch:error:AccessDeniedError", "title": "t", "status": 401}
    replies = iter([httpx.Response(401, json=problem | {"detail": "no"}), httpx.ReadError("cut")])

    def reply(_):
        if isinstance(one := next(replies), Exception):
            raise one
        return one

    transport = httpx.MockTransport(reply)
    client = EpisodeStoreClient("http://user:s3cret@store.lab:8081", transport=transport)
    for kind in (AccessDeniedError, UnavailableError):
        with pytest.raises(kind, match=r"http://store\.lab:8081") as refused:
            client.uploads()
        assert "s3cret" not in refused.value.message
