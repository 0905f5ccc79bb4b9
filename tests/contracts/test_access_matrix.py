"""Every route of every service with every kind of key, against a table written by hand.

The table is the intention: it does not come from the routes' own declarations. A new route fails
`test_every_route_has_a_scope_or_is_public` until it has a row here.
"""

import httpx
import pytest
from fastapi.routing import APIRoute

from dextouch.serving.keys import ApiKey
from dextouch.serving.refusals import WrongKeys
from services.cli.up import BUILDERS
from services.dashboard.upstream import Upstream
from tests.contracts.service_apps import APPS, all_routes, client_of, open_websocket

SCOPES = (
    "station",
    "store_read",
    "store_write",
    "store_expire",
    "store_delete",
    "align",
    "calibrate",
    "rollout",
    "watch",
    "study_read",
    "rate",
    "rate_lead",
    "teleop",
    "operate",
    "enrol",
)
# Needs no key on any service: probes, and the description of the routes.
PUBLIC = {"GET /healthz", "GET /readyz", "GET /metrics", "GET /openapi.json"}
PUBLIC |= {"GET /docs", "GET /docs/page.js"}
PUBLIC |= {"GET /docs/swagger-ui.css", "GET /docs/swagger-ui-bundle.js"}
# Needs a one-time token in place of a key.
BY_TOKEN = {"episode_store": {"POST /v1/enrolments/exchange"}}
# An application of its own, with the same keys (tests/unit/acquisition/test_practice.py).
MOUNTED = {"acquisition": {"FOLDER /practice"}}
# Scope by route. The dashboard is not here: all its routes below /v1 need a session.
TABLE = {
    "acquisition": {
        "GET /v1/recorder": "station",
        "POST /v1/recorder/arm": "station",
        "POST /v1/recorder/record": "station",
        "POST /v1/recorder/stop": "station",
        "POST /v1/recorder/save": "station",
        "POST /v1/recorder/discard": "station",
        "POST /v1/recorder/rerecord": "station",
        "POST /v1/recorder/session": "station",
        "GET /v1/health": "station",
        "GET /v1/health/events": "station",
        "GET /v1/health/history": "station",
        "GET /v1/live/overview": "station",
        "GET /v1/live/taxels": "station",
        "GET /v1/live/poses": "station",
        "GET /v1/live/cameras": "station",
        "GET /v1/live/cameras/{name}": "station",
        "GET /v1/uploads": "station",
        "GET /v1/uploads/{recording_id}": "station",
        "POST /v1/uploads/{recording_id}/retry": "station",
        "POST /v1/faults/{fault}": "station",
        "GET /v1/practice": "station",
        "POST /v1/practice/start": "station",
        "POST /v1/practice/stop": "station",
    },
    "alignment": {
        "POST /v1/alignments": "align",
        "GET /v1/alignments": "align",
        "GET /v1/alignments/{alignment_id}": "align",
        "POST /v1/alignments/{alignment_id}/cancel": "align",
        "GET /v1/calibration": "calibrate",
        "POST /v1/calibration/runs": "calibrate",
        "GET /v1/calibration/run": "calibrate",
        "GET /v1/calibration/run/image": "calibrate",
        "POST /v1/calibration/run/answer": "calibrate",
        "POST /v1/calibration/run/take": "calibrate",
        "POST /v1/calibration/run/drop": "calibrate",
        "POST /v1/calibration/practice/start": "calibrate",
        "POST /v1/calibration/practice/stop": "calibrate",
        "POST /v1/calibration/run/finish": "calibrate",
        "POST /v1/calibration/run/cancel": "calibrate",
    },
    "episode_store": {
        "POST /v1/recordings": "store_write",
        "POST /v1/recordings/{recording_id}/streams/{stream}/batches/{number}": "store_write",
        "POST /v1/recordings/{recording_id}/finish": "store_write",
        "POST /v1/uploads/expire": "store_expire",
        "GET /v1/deletions": "store_delete",
        "GET /v1/deletions/revision": "store_write",
        "POST /v1/deletions/check": "store_write",
        "POST /v1/deletions/confirm": "store_write",
        "GET /v1/recordings": "store_read",
        "GET /v1/recordings/{recording_id}": "store_read",
        "GET /v1/recordings/{recording_id}/attributes": "store_read",
        "GET /v1/recordings/{recording_id}/streams/{stream}": "store_read",
        "GET /v1/uploads": "store_read",
        "GET /v1/episodes": "store_read",
        "GET /v1/episodes/{episode_id}": "store_read",
        "GET /v1/episodes/{episode_id}/windows": "store_read",
        "GET /v1/episodes/{episode_id}/streams/{stream}": "store_read",
        "GET /v1/catalog/hours": "store_read",
        "GET /v1/catalog/hours/{field}": "store_read",
        "GET /v1/catalog/items": "store_read",
        "GET /v1/catalog/groups": "store_read",
        "POST /v1/catalog/reviews": "store_delete",
        "GET /v1/catalog/clicks": "store_read",
        "GET /v1/catalog/clicks/file": "store_read",
        "GET /v1/episodes/{episode_id}/clicks": "store_read",
        "POST /v1/episodes/{episode_id}/clicks": "store_delete",
        "POST /v1/episodes/{episode_id}/trim": "store_delete",
        "POST /v1/catalog/relabel": "store_delete",
        "GET /v1/notes/{kind}/{item_id}": "store_read",
        "POST /v1/notes/{kind}/{item_id}": "store_delete",
        "POST /v1/notes/{kind}/{item_id}/remove": "store_delete",
        "GET /v1/catalog/values": "store_read",
        "GET /v1/catalog/lineage/{kind}/{item_id}": "store_read",
        "GET /v1/playback/{kind}/{item_id}": "store_read",
        "GET /v1/playback/{kind}/{item_id}/images/{camera}": "store_read",
        "GET /v1/playback/{kind}/{item_id}/signals": "store_read",
        "GET /v1/playback/episode/{item_id}/robot_hands": "store_read",
        "POST /v1/downloads": "store_read",
        "GET /v1/trash": "store_read",
        "POST /v1/trash": "store_delete",
        "POST /v1/trash/restore": "store_delete",
        "GET /v1/enrolments": "enrol",
        "POST /v1/enrolments": "enrol",
        "POST /v1/enrolments/{station}/revoke": "enrol",
    },
    "worlds": {
        "GET /v1/worlds": "rollout",
        "POST /v1/rollouts": "rollout",
        "GET /v1/rollouts/{rollout_id}": "rollout",
        "DELETE /v1/rollouts/{rollout_id}": "rollout",
        "POST /v1/rollouts/{rollout_id}/chunks/{chunk}": "rollout",
        "POST /v1/rollouts/{rollout_id}/fork": "rollout",
        "WEBSOCKET /v1/openpi": "rollout",
        "GET /v1/watch": "watch",
        "GET /v1/watch/{watch_id}": "watch",
    },
    "studies": {
        "GET /v1/studies": "study_read",
        "GET /v1/studies/{name}": "study_read",
        "GET /v1/studies/{name}/rollouts": "study_read",
        "GET /v1/studies/{name}/picture": "study_read",
    },
    "rating": {
        "GET /v1/rating/next": "rate",
        "GET /v1/rating/rollouts/{token}/steps/{step}.jpg": "rate",
        "POST /v1/rating/marks": "rate",
        "GET /v1/rating/agreement": "rate_lead",
        "GET /v1/rating/invitations": "rate_lead",
        "POST /v1/rating/invitations": "rate_lead",
        "POST /v1/rating/invitations/{rater}/revoke": "rate_lead",
    },
    "teleoperation": {
        "WEBSOCKET /v1/teleop/{side}": "teleop",
        "POST /v1/teleop/{side}/stop": "teleop",
    },
}
# The pages where raters, and whoever leads them, enter their key, and their files.
RATING_FILES = ("rate.js", "rate.css", "rate.svg", "lead", "lead.js", "keys.js", "request.js")
RATING_PAGE = {"GET /"} | {f"GET /{name}" for name in RATING_FILES}
SIGN_IN = {"POST /sign_in", "POST /sign_out"}
PATH_VALUES = {"number": "0", "chunk": "0", "step": "0", "token": "0" * 20, "watch_id": "0" * 32}
PATH_VALUES |= {"side": "right", "rater": "bob"}
WRONG_KEY = "wrong-key-of-some-length"


def key_of(scope):
    return f"key-of-the-scope-{scope}"


KEYS = tuple(ApiKey(name=scope, key=key_of(scope), scopes=(scope,)) for scope in SCOPES)
# What a caller may present in place of a key, with the key that would be accepted.
NO_KEYS = {
    "nothing": lambda key: {},
    "a wrong key": lambda key: {"headers": {"authorization": f"Bearer {WRONG_KEY}"}},
    "a longer key": lambda key: {"headers": {"authorization": f"Bearer {key}x"}},
    "a shorter key": lambda key: {"headers": {"authorization": f"Bearer {key[:-1]}"}},
    "an empty key": lambda key: {"headers": {"authorization": "Bearer "}},
    "basic authorization": lambda key: {"headers": {"authorization": f"Basic {key}"}},
    "no kind": lambda key: {"headers": {"authorization": key}},
    "another header": lambda key: {"headers": {"x-api-key": key}},
    "a cookie": lambda key: {"headers": {"cookie": f"dextouch_session={key}; key={key}"}},
    "the query": lambda key: {"params": {"key": key, "authorization": f"Bearer {key}"}},
}


def operations(app):
    """Method and path of every route; a WebSocket has the method WEBSOCKET, a folder FOLDER."""
    found = set()
    for route in all_routes(app):
        kind = type(route).__name__
        if kind == "Mount":
            found.add(f"FOLDER {route.path}")
        elif "WebSocket" in kind:
            found.add(f"WEBSOCKET {route.path}")
        else:
            found |= {f"{method} {route.path}" for method in route.methods - {"HEAD"}}
    documented = {
        f"{method.upper()} {path}"
        for path, methods in app.openapi()["paths"].items()
        for method in methods
    }
    assert documented <= found
    return found


def filled(path):
    for part in path.split("/"):
        name = part.partition("{")[2].partition("}")[0]
        path = path.replace("{" + name + "}", PATH_VALUES.get(name, "none"))
    return path


async def ask(client, operation, **given):
    """Status, and reason if refused, of a request or WebSocket."""
    method, path = operation.split()
    if method == "WEBSOCKET":
        return await ask_websocket(client._transport.app, filled(path), given)
    if path.endswith("/batches/{number}"):
        octets = {"content-type": "application/octet-stream"}
        given |= {"content": b"x", "headers": octets | given.get("headers", {})}
    elif method == "POST":
        given = {"json": {}} | given
    answer = await client.request(method, filled(path), **given)
    is_problem = answer.headers.get("content-type") == "application/problem+json"
    return answer.status_code, answer.json()["details"].get("reason") if is_problem else None


async def ask_websocket(app, path, given):
    """Like `ask`: 101 if accepted, 401 or 403 by the reason of a refusal."""
    first = await open_websocket(app, path, **given)
    if first["type"] == "websocket.accept":
        return 101, None
    assert first["code"] == 1008
    if "lacks the scope" in first["reason"]:
        return 403, "missing_scope"
    assert any(word in first["reason"] for word in ("no key", "unknown key", "not signed in"))
    return 401, None


@pytest.fixture(params=TABLE)
def keyed(request, tmp_path):
    """Name and application of a service with one key for each scope."""
    return request.param, APPS[request.param](tmp_path, api_keys=KEYS)


@pytest.fixture
def unlimited(monkeypatch):
    """Wrong keys are refused one by one, however many; tests/unit/serving tests their limit."""
    monkeypatch.setattr(WrongKeys, "count", lambda *_, **__: None)


def test_every_service_has_a_table():
    assert set(APPS) == set(TABLE) | {"dashboard"}
    assert set(BUILDERS) - set(APPS) == {"twin", "world_model"}


@pytest.mark.long
def test_every_route_has_a_scope_or_is_public(keyed):
    """Add a row for a new route: which scope should it need?"""
    service, app = keyed
    pages = RATING_PAGE if service == "rating" else set()
    others = BY_TOKEN.get(service, set()) | MOUNTED.get(service, set())
    assert operations(app) == set(TABLE[service]) | PUBLIC | pages | others


@pytest.mark.parametrize("service", APPS)
async def test_files_without_a_key_are_those_of_the_pages_whatever_is_asked(service, tmp_path):
    app = APPS[service](tmp_path, api_keys=KEYS)
    for route in all_routes(app):
        if isinstance(route, APIRoute) and not route.include_in_schema and "/v1/" not in route.path:
            assert not route.dependant.query_params, route.path
    pages = RATING_PAGE if service == "rating" else set()
    paths = sorted(one.split()[1] for one in (PUBLIC | pages) - {"GET /metrics"})
    async with client_of(app) as client:
        for path in paths:
            whole = await client.get(path)
            for name in ("name", "path", "folder", "file"):
                other = await client.get(path, params={name: "/etc/passwd"})
                assert (other.status_code, other.content) == (whole.status_code, whole.content)
        for path in ("../guard.py", "%2e%2e/guard.py", "..%2fguard.py", "%2fetc%2fpasswd"):
            assert (await client.get(f"/docs/{path}")).status_code == 404, path
        whole = await client.get("/docs")
        assert "frame-ancestors 'none'" in whole.headers["content-security-policy"]
        again = await client.get("/docs", headers={"if-none-match": whole.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
        assert (await client.head("/docs")).headers["content-length"] == str(len(whole.content))


@pytest.mark.long
def test_the_document_says_which_scope(keyed):
    service, app = keyed
    paths = app.openapi()["paths"]
    for operation, needed in TABLE[service].items():
        method, path = operation.split()
        if method != "WEBSOCKET":
            assert paths[path][method.lower()]["security"] == [{"api_key": [needed]}], operation


@pytest.mark.long
async def test_only_the_key_with_the_scope_is_let_in(keyed):
    service, app = keyed
    async with client_of(app) as client:
        for operation, needed in TABLE[service].items():
            for scope in SCOPES:
                header = {"authorization": f"Bearer {key_of(scope)}"}
                status, reason = await ask(client, operation, headers=header)
                if scope == needed:
                    assert status not in {401, 403}, (operation, scope, status)
                else:
                    assert (status, reason) == (403, "missing_scope"), (operation, scope)


@pytest.mark.long
@pytest.mark.parametrize("presented", NO_KEYS)
async def test_without_a_key_nobody_is_let_in(unlimited, keyed, presented):
    service, app = keyed
    async with client_of(app) as client:
        for operation, needed in TABLE[service].items():
            given = NO_KEYS[presented](key_of(needed))
            status, _ = await ask(client, operation, **given)
            assert status == 401, (operation, presented)


@pytest.mark.long
async def test_probes_and_pages_say_nothing_secret(keyed):
    service, app = keyed
    pages = RATING_PAGE if service == "rating" else set()
    async with client_of(app) as client:
        for operation in PUBLIC | pages:
            answer = await client.get(operation.split()[1])
            assert answer.status_code in {200, 503}, operation
            assert not any(key_of(scope) in answer.text for scope in SCOPES)


@pytest.mark.long
@pytest.mark.parametrize("presented", NO_KEYS)
async def test_no_key_replaces_an_enrolment_token(tmp_path, presented):
    """Not even one with every scope, nor one that is presented in place of the token."""
    every = ApiKey(name="every", key=key_of("every"), scopes=SCOPES)
    async with client_of(APPS["episode_store"](tmp_path, api_keys=(every,))) as client:
        for key in (key_of("every"), WRONG_KEY):
            given = {"json": {"token": key}} | NO_KEYS[presented](key)
            found = await ask(client, "POST /v1/enrolments/exchange", **given)
            assert found == (403, "unknown_token")


class Upstreams:
    """Other services behind the dashboard, which note what reaches them."""

    def __init__(self):
        self.asked = []

    def answer(self, request):
        self.asked.append((request.method, request.url.path))
        return httpx.Response(200, json={})

    def clients(self):
        return {
            name: Upstream(
                name,
                httpx.AsyncClient(
                    transport=httpx.MockTransport(self.answer), base_url=f"http://{name}"
                ),
            )
            for name in ("acquisition", "episode_store", "alignment", "twin", "world_model")
        }


@pytest.fixture
def upstreams():
    return Upstreams()


@pytest.fixture
def page(tmp_path, upstreams):
    return APPS["dashboard"](tmp_path, upstreams=upstreams.clients(), api_keys=KEYS)


def kinds_of(app):
    """Routes of the dashboard that need a session, and its pages, which show the sign-in."""
    found = operations(app)
    assert SIGN_IN | PUBLIC | {"FOLDER /static"} <= found
    left = found - SIGN_IN - PUBLIC - {"FOLDER /static"}
    pages = {one for one in left if "/v1/" not in one}
    assert pages
    assert all(one.startswith("GET /") for one in pages)
    return left - pages, pages


async def sign_in(client, key):
    answer = await client.post("/sign_in", data={"key": key})
    client.cookies.clear()
    return answer


@pytest.mark.parametrize("scope", [*SCOPES, "none"])
async def test_only_operators_sign_in(page, scope):
    async with client_of(page) as client:
        answer = await sign_in(client, WRONG_KEY if scope == "none" else key_of(scope))
        assert answer.status_code == (303 if scope == "operate" else 401)
        assert ("set-cookie" in answer.headers) is (scope == "operate")


@pytest.mark.long
async def test_the_dashboard_and_what_it_forwards_need_a_session(unlimited, page, upstreams):
    routes, _ = kinds_of(page)
    assert "WEBSOCKET /v1/live" in routes
    assert "POST /v1/episode_store/trash" in routes
    presented = [given(key_of("operate")) for given in NO_KEYS.values()]
    presented += [{"headers": {"authorization": f"Bearer {key_of(scope)}"}} for scope in SCOPES]
    async with client_of(page) as client:
        for operation in routes:
            for given in presented:
                status, _ = await ask(client, operation, **given)
                assert status == 401, (operation, given)
    assert not upstreams.asked


# Of keys with the scope enrol beside operate.
OF_ADMINISTRATORS = {
    "POST /v1/episode_store/enrolments",
    "POST /v1/episode_store/enrolments/{station}/revoke",
}


@pytest.mark.long
@pytest.mark.parametrize("scopes", [("operate",), ("operate", "enrol")])
async def test_operators_reach_their_routes_until_they_sign_out(tmp_path, upstreams, scopes):
    key = ApiKey(name="someone", key=key_of("operate"), scopes=scopes)
    page = APPS["dashboard"](tmp_path, upstreams=upstreams.clients(), api_keys=(key,))
    routes, _ = kinds_of(page)
    assert routes >= OF_ADMINISTRATORS
    async with client_of(page) as client:
        cookie = (await sign_in(client, key_of("operate"))).headers["set-cookie"].partition(";")[0]
        given = {"headers": {"cookie": cookie}}
        for operation in sorted(routes):
            status, reason = await ask(client, operation, **given)
            if operation in OF_ADMINISTRATORS and "enrol" not in scopes:
                assert (status, reason) == (403, "missing_scope"), operation
            else:
                assert status not in {401, 403}, operation
        reached = set(upstreams.asked)
        assert (("POST", "/v1/enrolments") in reached) is ("enrol" in scopes)
        assert (("POST", "/v1/trash")) in reached
        signed_out = await client.post("/sign_out", **given)
        assert signed_out.status_code == 303
        upstreams.asked.clear()
        for operation in routes:
            status, _ = await ask(client, operation, **given)
            assert status == 401, operation
    assert not upstreams.asked


async def test_pages_show_the_sign_in_in_their_place(page):
    _, pages = kinds_of(page)
    async with client_of(page) as client:
        cookie = (await sign_in(client, key_of("operate"))).headers["set-cookie"].partition(";")[0]
        for operation in pages:
            path = filled(operation.split()[1])
            asks = (await client.get(path)).text
            assert 'action="/sign_in"' in asks, path
            shown = (await client.get(path, headers={"cookie": cookie})).text
            assert 'action="/sign_in"' not in shown, path
