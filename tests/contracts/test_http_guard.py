"""What every service refuses before it acts: foreign pages, bodies of forms, keyless and long ones.

The attacks are those of a page of another origin in the operator's browser (no-cors requests, DNS
rebinding), as the Fetch standard lets it send them. A new service joins `APPS` of `service_apps`;
one that builds its application by itself instead of by `create_service_app` fails the first two
tests.
"""

import ast
from pathlib import Path

import pytest

from dextouch.serving.keys import ApiKey
from services.cli.up import BUILDERS
from tests.contracts.service_apps import APPS, UP, client_of, dashboard

ROOT = Path(__file__).parents[2]
KEY = "a-key-of-some-length"
SCOPES = (
    "station",
    "store_read",
    "store_write",
    "store_expire",
    "store_delete",
    "align",
    "rollout",
    "rate",
    "watch",
    "study_read",
    "operate",
    "enrol",
)
PATH_VALUES = {"number": "0", "chunk": "0"}
MIB = 2**20
FORM = "application/x-www-form-urlencoded"
# Routes that browsers send forms to; they are not in the OpenAPI document.
FORMS = ("/sign_in", "/sign_out")
# Needs a one-time token in place of a key.
EXCHANGE = "/v1/enrolments/exchange"


def test_every_service_of_the_project_is_here():
    assert set(UP) == set(BUILDERS)


@pytest.mark.long
def test_applications_are_built_in_one_place():
    built_in = {
        path.relative_to(ROOT).as_posix()
        for folder in ("shared", "services")
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in {"FastAPI", "Starlette"}
    }
    assert built_in == {"shared/dextouch/serving/app.py"}


@pytest.fixture(params=APPS)
def make_app(request, tmp_path):
    """The factory of one service."""
    return lambda **settings: APPS[request.param](tmp_path, **settings)


def keyed():
    """Settings of a service that others on the network reach."""
    return {"api_keys": (ApiKey(name="all", key=KEY, scopes=SCOPES),)}


DOCUMENTED = {}


def documented(app):
    """The paths of its OpenAPI document, which is made once for all apps of the same routes."""
    routes = app.title, len(app.routes)
    if routes not in DOCUMENTED:
        DOCUMENTED[routes] = app.openapi()["paths"]
    return DOCUMENTED[routes]


def operations(app, *, unsafe):
    """Method and path of every route, path parameters filled in."""
    found = []
    for path, methods in documented(app).items():
        filled = path
        for part in path.split("/"):
            name = part.partition("{")[2].partition("}")[0]
            filled = filled.replace("{" + name + "}", PATH_VALUES.get(name, "none"))
        found += [
            (method.upper(), filled)
            for method in methods
            if (method in {"post", "put", "patch", "delete"}) is unsafe
        ]
    if unsafe and app.title == "dashboard":
        found += [("POST", path) for path in FORMS]
    # The service of studies only reads.
    assert found or (unsafe and app.title == "studies")
    return found


def assert_refused(answer, status, says):
    assert answer.status_code == status, (answer.request.method, answer.request.url, answer.text)
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["status"] == status
    assert problem["request_id"] == answer.headers["x-request-id"]
    assert says in problem["detail"]


FOREIGN = [
    ({"host": "evil.example", "origin": "http://evil.example"}, 421, "allowed_hosts"),
    ({"host": "evil.example:8000"}, 421, "allowed_hosts"),
    ({"host": "127.0.0.1.evil.example"}, 421, "allowed_hosts"),
    ({"host": "localhost@evil.example"}, 421, "allowed_hosts"),
    ({"host": ""}, 421, "allowed_hosts"),
    ({"origin": "http://evil.example"}, 403, "allowed_origins"),
    ({"origin": "null"}, 403, "allowed_origins"),
    ({"origin": "http://127.0.0.1:8001"}, 403, "allowed_origins"),
    ({"origin": "https://127.0.0.1:8000"}, 403, "allowed_origins"),
    ({"origin": "http://localhost:8000"}, 403, "allowed_origins"),
    ({"sec-fetch-site": "cross-site"}, 403, "allowed_origins"),
    ({"sec-fetch-site": "same-site"}, 403, "allowed_origins"),
]


@pytest.mark.long
@pytest.mark.parametrize(("headers", "status", "says"), FOREIGN)
async def test_pages_of_other_origins_cannot_act(make_app, headers, status, says):
    app = make_app()
    async with client_of(app) as client:
        for method, path in operations(app, unsafe=True):
            assert_refused(await client.request(method, path, headers=headers), status, says)


@pytest.mark.long
async def test_rebound_names_cannot_read(make_app):
    app = make_app()
    async with client_of(app, "http://evil.example:8000") as client:
        for method, path in [*operations(app, unsafe=False), ("GET", "/metrics"), ("GET", "/")]:
            assert_refused(await client.request(method, path), 421, "allowed_hosts")


@pytest.mark.long
@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", None])
async def test_pages_of_other_origins_open_no_websocket(make_app, origin):
    host = b"127.0.0.1:8000" if origin else b"evil.example"
    headers = [(b"host", host), (b"origin", (origin or "http://evil.example").encode())]
    sent = []

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    scope = {"type": "websocket", "scheme": "ws", "path": "/v1/live", "raw_path": b"/v1/live"}
    scope |= {"headers": headers, "query_string": b"", "root_path": "", "subprotocols": []}
    app = make_app()
    await app(scope | {"state": {}, "app": app}, receive, send)
    assert [message["type"] for message in sent] == ["websocket.close"]
    assert sent[0]["code"] == 1008
    assert "allowed_" in sent[0]["reason"]


@pytest.mark.long
async def test_own_pages_tools_and_named_origins_may_act(make_app):
    origins = ("https://lab.example:443", "http://[FE80:0:0:0:0:0:0:2]:80", "https://Desk.lab:8443")
    hosts = ("lab-pc", "fd00::7", "FE80:0:0:0:0:0:0:1")
    app = make_app(allowed_hosts=hosts, allowed_origins=origins)
    accepted = [
        {},
        {"origin": "http://127.0.0.1:8000"},
        {"host": "localhost:1", "origin": "http://LOCALHOST:1"},
        {"host": "[::1]:9", "origin": "http://[::1]:9"},
        {"host": "localhost:80", "origin": "http://localhost"},
        {"host": "LAB-PC:8000", "sec-fetch-site": "same-origin"},
        {"host": "[fd00::7]"},
        {"host": "[fe80::1]:8000", "origin": "http://[fe80::1]:8000"},
        {"host": "[FE80:0::1]"},
        {"origin": "https://lab.example", "sec-fetch-site": "cross-site"},
        {"origin": "http://[fe80::2]"},
        {"origin": "https://desk.lab:8443"},
    ]
    async with client_of(app) as client:
        for headers in accepted:
            for method, path in operations(app, unsafe=True):
                answer = await client.request(method, path, headers=headers)
                assert answer.status_code not in {403, 415, 421}, (path, headers, answer.text)


@pytest.mark.parametrize(
    "origin",
    ["https://lab.example:80", "http://lab.example", "http://lab.example:443", "https://[::1:2]:x"],
)
async def test_a_default_port_is_that_of_the_origins_own_scheme(origin):
    async with client_of(dashboard(None, allowed_origins=("https://lab.example",))) as client:
        answer = await client.post("/v1/recorder/arm", json={}, headers={"origin": origin})
        assert_refused(answer, 403, "allowed_origins")


async def test_a_dashboard_sends_who_is_not_signed_in_to_its_page():
    """Its routes take no bearer key, so none is asked for."""
    async with client_of(dashboard(None, **keyed())) as client:
        for method, path in [("POST", "/v1/recorder/arm"), ("GET", "/v1/overview")]:
            for key in ({}, {"authorization": f"Bearer {KEY}"}):
                answer = await client.request(method, path, headers=key)
                assert_refused(answer, 401, "not signed in: open / and sign in")


BY_FORM = ["text/plain", FORM, "multipart/form-data; boundary=x", ""]


@pytest.mark.long
@pytest.mark.parametrize("content_type", BY_FORM)
async def test_what_a_form_can_send_is_refused(make_app, content_type):
    """A no-cors request names one of these types, or none (a Blob without a type)."""
    app = make_app()
    headers = {"content-type": content_type} if content_type else {}
    async with client_of(app) as client:
        for method, path in operations(app, unsafe=True):
            answer = await client.request(method, path, content=b"{}", headers=headers)
            if path in FORMS and content_type == FORM:
                assert answer.status_code in {303, 401}
            elif path in FORMS:
                assert_refused(answer, 415, FORM)
            else:
                assert_refused(answer, 415, "application/")


HOSTILE_TYPES = [
    "application/json; charset*=utf-8''x",
    "application/json; charset*=undefined''x",
    "application/json; charset*=\x00''x",
    "application/json; charset*0*=utf-8''%ff; charset*1=x",
    "application/json; dtype*=utf-8''float32",
    'application/json; charset="\\',
    "application/json; =; *; *0=; a*b=c; ;",
    "application/json" + ";a*=b" * 1000,
    "\xff/\xfe; \xff*=\xff''\xff",
    "; ; =",
    "*",
]


@pytest.mark.long
@pytest.mark.parametrize("content_type", HOSTILE_TYPES)
async def test_no_content_type_breaks_a_service(make_app, content_type):
    """Extended parameters (RFC 8187) change nothing: their media type is what counts."""
    app = make_app()
    headers = {"content-type": content_type.encode("latin-1")}
    async with client_of(app) as client:
        for method, path in operations(app, unsafe=True):
            answer = await client.request(method, path, content=b"{}", headers=headers)
            assert answer.status_code != 500, (path, answer.text)
            is_refused = path in FORMS or not content_type.startswith("application/json")
            assert (answer.status_code == 415) is (is_refused or "/batches/" in path), path


async def test_a_service_with_keys_asks_for_one_before_it_reads(make_app):
    app = make_app(**keyed())
    asked = []

    async def receive():
        asked.append(1)
        return {"type": "http.disconnect"}

    for headers in ([], [(b"authorization", b"Bearer wrong-key-of-length")]):
        for method, path in operations(app, unsafe=True):
            if path in (*FORMS, EXCHANGE):
                continue
            sent = []

            async def send(message, sent=sent):
                sent.append(message)

            scope = {"type": "http", "http_version": "1.1", "scheme": "http", "method": method}
            scope |= {"path": path, "raw_path": path.encode(), "query_string": b""}
            known = [(b"host", b"store:8000"), (b"content-type", b"application/json")]
            scope |= {"headers": [*known, (b"content-length", b"9" * 8), *headers]}
            await app(scope | {"root_path": "", "client": ("10.0.0.9", 1)}, receive, send)
            # After ten wrong keys of an address, 429.
            assert sent[0]["status"] in {401, 421, 429}, path
    assert not asked


@pytest.mark.long
async def test_probes_and_keys_work_under_any_name(make_app):
    """Health checks and Prometheus have no key and use the names of containers."""
    app = make_app(**keyed())
    async with client_of(app, "http://episode_store:8081") as client:
        for path in ("/healthz", "/readyz", "/metrics"):
            assert (await client.get(path)).status_code in {200, 503}
        header = {"authorization": f"Bearer {KEY}"}
        for method, path in operations(app, unsafe=True):
            answer = await client.request(method, path, headers=header)
            assert answer.status_code not in {415, 421}, (path, answer.text)


@pytest.mark.long
@pytest.mark.parametrize("announced", [True, False])
async def test_no_route_reads_a_body_that_is_longer_than_its_own(make_app, announced):
    """Of JSON no route needs more than 1 MiB; of anything more than `max_body_bytes`."""
    app = make_app()
    async with client_of(app) as client:
        for method, path in operations(app, unsafe=True):
            read = []

            async def parts(read=read):
                for _ in range(17):
                    read.append(MIB)
                    yield b" " * MIB

            kind = "application/json"
            if "/batches/" in path:
                kind = "application/octet-stream"
            elif path in FORMS:
                kind = FORM
            headers = {"content-type": kind}
            if announced:
                headers["content-length"] = str(17 * MIB)
            answer = await client.request(method, path, content=parts(), headers=headers)
            largest = 17 if "/batches/" in path else 2
            assert len(read) <= (0 if announced else largest), path
            # What never reads its body does not notice how long one of unknown length is.
            if announced or read:
                assert_refused(answer, 413, "expected at most")
