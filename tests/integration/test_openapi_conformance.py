"""Every service against its own OpenAPI document, with requests that schemathesis makes from it."""

import asyncio
import json
from collections import defaultdict
from contextlib import asynccontextmanager
from dataclasses import dataclass
from urllib.parse import quote

import httpx
import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import GenerationMode
from schemathesis.specs.openapi import checks

from dextouch.episodes import EpisodeStore
from dextouch.serving import JSON
from dextouch.serving.keys import ApiKey
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.acquisition.settings import AcquisitionSettings
from services.alignment.settings import AlignmentSettings
from services.dashboard.settings import DashboardSettings
from services.dashboard.upstream import Upstream
from services.episode_store.settings import EpisodeStoreSettings
from services.evaluation.settings import RatingSettings
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write
from tests.unit.worlds.fakes import SumWorld, actions

# Threads and child processes of the services use the module `random` while strategies draw.
pytestmark = pytest.mark.filterwarnings("ignore:Do not use the `random` module")
URL = "http://localhost"
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
    "operate",
    "enrol",
)
OTHER_KEY = "another-key-of-length"
KEYED = {
    "api_keys": (
        ApiKey(name="all", key=KEY, scopes=SCOPES),
        ApiKey(name="other", key=OTHER_KEY, scopes=("other",)),
    )
}
AUTHORIZED = {"authorization": f"Bearer {KEY}"}
PROMPT = {"task": "stack_bowls", "instruction": "stack the bowls"}
START = {"world": "sum", "task": "stand_bottle", "seed": 1, "instruction": "stand it up"}
STREAM = {"name": "tactile_left", "kind": "tactile", "shape": [4], "dtype": "float32"}
STREAM |= {"unit": "kPa", "nominal_rate_hz": 60}
TAKE = {"recording_id": "take-1", "domain": "human", "station": "bench", "streams": [STREAM]}
RUBRIC = """
[reach]
[[reach.criteria]]
name = "touched"
points = 2
milestone = "touched"
description = "The hand touched the spot."
"""
NUM_FEW, NUM_MANY = 3, 100
# JSON by path, to get beyond the validation of fields.
BODIES = {
    "/v1/alignments": {"recording_id": "take-1"},
    "/v1/recorder/arm": PROMPT,
    "/v1/recorder/{action}": PROMPT,
    "/v1/recordings": TAKE | PROMPT,
    "/v1/rollouts": START,
    "/v1/rollouts/{rollout_id}/chunks/{chunk}": {"actions": actions(4).tolist()},
}
CHECKS = [
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_schema_conformance,
]


@dataclass
class Served:
    """A running application, and path parameters of things that it has."""

    app: object
    client: httpx.AsyncClient
    known: dict
    headers: dict


@asynccontextmanager
async def running(app):
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url=URL, headers=AUTHORIZED) as client,
    ):
        yield client


@asynccontextmanager
async def acquisition(folder):
    from services.acquisition.app import create_app

    spool = folder / "spool"
    app = create_app(AcquisitionSettings(mock=True, mock_faults="none", spool=spool, **KEYED))
    async with running(app) as client:
        yield Served(app, client, {"name": "camera_head"}, AUTHORIZED)


@asynccontextmanager
async def alignment(folder):
    from services.alignment.app import create_app

    app = create_app(AlignmentSettings(store_url=str(folder / "store"), **KEYED))
    async with running(app) as client:
        yield Served(app, client, {}, AUTHORIZED)


@asynccontextmanager
async def episode_store(folder):
    from services.episode_store.app import create_app

    url = str(folder / "store")
    item = toy.demonstration("reach", 1, name="toy-1")
    write(EpisodeStore(url), item)
    app = create_app(EpisodeStoreSettings(store_url=url, sync_uploads=False, **KEYED))
    async with running(app) as client:
        created = await client.post("/v1/recordings", json=TAKE | PROMPT)
        assert created.status_code == 201, created.text
        known = {"episode_id": item.episode_id, "stream": "tactile_left"}
        yield Served(app, client, known | {"recording_id": "take-1"}, AUTHORIZED)


@asynccontextmanager
async def dashboard(folder):
    from services.dashboard.app import create_app

    async with acquisition(folder) as station, episode_store(folder) as store:
        upstreams = {
            "acquisition": Upstream("acquisition", station.client),
            "episode_store": Upstream("episode_store", store.client),
        }
        app = create_app(DashboardSettings(**KEYED), upstreams)
        async with running(app) as client:
            signed_in = await client.post("/sign_in", data={"key": KEY})
            assert signed_in.status_code == 303
            session = {"cookie": signed_in.headers["set-cookie"].partition(";")[0]}
            yield Served(app, client, {"name": "camera_head", "action": "arm"}, session)


@asynccontextmanager
async def worlds(_):
    app = create_world_app({"sum": SumWorld()}, WorldServiceSettings(**KEYED))
    async with running(app) as client:
        started = await client.post(
            "/v1/rollouts", json=START, headers={"accept": "application/json"}
        )
        assert started.status_code == 201, started.text
        rollout_id = started.json()["fields"]["rollout"]["id"]
        yield Served(app, client, {"rollout_id": rollout_id, "chunk": 0}, AUTHORIZED)


@asynccontextmanager
async def rating(folder):
    from services.evaluation.rating.app import create_rating_app

    url = str(folder / "store")
    write(EpisodeStore(url), toy.demonstration("reach", 1, name="dream-1"), origin="imagined")
    rubrics = folder / "rubrics.toml"
    rubrics.write_text(RUBRIC)
    paths = {"store_url": url, "marks": folder / "marks.sqlite", "rubrics": rubrics}
    app = create_rating_app(RatingSettings(**paths, **KEYED))
    async with running(app) as client:
        assigned = (await client.get("/v1/rating/next", params={"rater": "all"})).json()
        yield Served(app, client, {"token": assigned["rollout"]}, AUTHORIZED)


SERVICES = {
    "acquisition": acquisition,
    "alignment": alignment,
    "dashboard": dashboard,
    "episode_store": episode_store,
    "rating": rating,
    "worlds": worlds,
}


def request_of(case):
    """A case as the bytes that a client would send."""
    made = requests.Request(**case.as_transport_kwargs(base_url=URL)).prepare()
    return httpx.Request(made.method, made.url, headers=dict(made.headers), content=made.body)


def strategies(operation, known):
    """Valid and invalid requests, to unknown items and to known ones, and with bodies that work."""
    parameters = {
        name: known[name]
        for name in known
        if any(one.name == name for one in operation.path_parameters)
    }
    modes = [GenerationMode.POSITIVE]
    if list(operation.iter_parameters()) or operation.body:
        modes.append(GenerationMode.NEGATIVE)
    for mode in modes:
        yield operation.as_strategy(mode)
        if parameters:
            yield operation.as_strategy(mode, path_parameters=parameters)
    if operation.path in BODIES:
        parameters = parameters or None
        body = BODIES[operation.path]
        yield operation.as_strategy(path_parameters=parameters, body=body, media_type=JSON)


def harm(operation):
    """Reading comes first, and last what ends the things that others ask for."""
    ends = operation.method == "delete" or operation.path.endswith(("/finish", "/expire"))
    return operation.method != "get", ends


def conform(service, folder, max_examples):
    """Send requests to every operation of a service and check the responses; their number."""
    seen = []
    steady = settings(
        max_examples=max_examples,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    with asyncio.Runner() as runner:
        context = SERVICES[service](folder)
        served = runner.run(context.__aenter__())

        def check(case):
            request = request_of(case)
            request.headers.update(served.headers)
            response = runner.run(served.client.send(request))
            seen.append((case.method, case.operation.path, response.status_code))
            assert response.status_code != 500, f"{request.method} {request.url}: {response.text}"
            case.validate_response(response, checks=CHECKS)

        try:
            schema = schemathesis.openapi.from_dict(served.app.openapi())
            operations = [found.ok() for found in schema.get_all_operations()]
            for operation in sorted(operations, key=harm):
                for strategy in strategies(operation, served.known):
                    steady(given(strategy)(check))()
        finally:
            runner.run(context.__aexit__(None, None, None))
    return seen


@pytest.mark.parametrize("service", SERVICES)
def test_answers_are_those_of_the_document(service, tmp_path):
    seen = conform(service, tmp_path, max_examples=NUM_FEW)
    assert any(status < 300 for _, _, status in seen)


@pytest.mark.slow
@pytest.mark.parametrize("service", SERVICES)
def test_many_answers_are_those_of_the_document(service, tmp_path):
    conform(service, tmp_path, max_examples=NUM_MANY)


# What a generator rarely draws: numbers beyond 64 bits, control characters, paths, deep nesting.
NUMBERS = [str(number) for number in (2**31, 2**63 - 1, 2**63, 2**64, -(2**63) - 1, 10**400)]
VALUES = [
    *(
        *NUMBERS,
        "nan",
        "inf",
        "-inf",
        "1e999",
        "-0",
        "",
        "null",
        "\x00",
        "\x07",
        "\u202e",
        "\u2400",
    ),
    *("..", "../../etc/passwd", "a/b", "a\\b", "a%2Fb", "a" * 5000, "'; --", "*", "a:b"),
]
JSON_TEXTS = [
    *(*NUMBERS, "NaN", "1e999", "null", "{}", "[]", "true", '"\\u0000"', '"\\ud800"', '"../x"'),
    *('"' + "a" * 9000 + '"', "[" * 9000, '{"a":' * 9000),
]


def fields_of(document, operation):
    """Names of the fields of the JSON body of an operation."""
    content = operation.get("requestBody", {}).get("content", {})
    schema = content.get(JSON, {}).get("schema", {})
    for one in schema.get("anyOf", [schema]):
        name = one.get("$ref", "").rpartition("/")[2]
        found = document["components"]["schemas"][name] if name else one
        yield from found.get("properties", {})


# Requests that the guard or the key refuses, and the statuses that it may give.
REFUSED = [
    ({}, b"", {401}),
    ({"authorization": "Bearer nonsense"}, b"", {401, 429}),
    ({"authorization": f"Bearer {OTHER_KEY}"}, b"", {403, 401}),
    (AUTHORIZED | {"content-type": "text/plain"}, b"{}", {415}),
    (AUTHORIZED | {"content-type": JSON}, b" " * 2**25, {413, 415}),
]


@pytest.mark.parametrize("service", SERVICES)
async def test_refusals_are_in_the_document(service, tmp_path):
    async with SERVICES[service](tmp_path) as served:
        transport = httpx.ASGITransport(served.app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url=URL) as client:
            document = served.app.openapi()
            for path, operations in document["paths"].items():
                for method, operation in operations.items():
                    if "security" not in operation:
                        continue
                    url = path.format_map(defaultdict(lambda: "0", served.known))
                    for headers, content, statuses in REFUSED:
                        response = await client.request(
                            method, url, headers=headers, content=content
                        )
                        status = response.status_code
                        assert status in statuses, f"{method} {url}: {response.text}"
                        kind = response.headers["content-type"]
                        reference = operation["responses"][str(status)]["$ref"]
                        refused = document["components"]["responses"][reference.split("/")[-1]]
                        assert kind in refused["content"]


@pytest.mark.parametrize(
    ("service", "path", "fields"),
    [
        ("episode_store", "/v1/recordings", ("streams", "ledger", "lineage")),
        ("episode_store", "/v1/recordings/take-1/finish", ("ledger",)),
        ("alignment", "/v1/alignments", ("recording_ids",)),
    ],
)
async def test_only_the_first_mistake_of_a_list_is_told(service, path, fields, tmp_path):
    """Half a million of them, collected and told, took 17 s and 99 MB."""
    async with SERVICES[service](tmp_path) as served:
        for field in fields:
            body = {field: [0] * 50}
            response = await served.client.post(path, json=body)
            assert response.status_code == 422
            errors = response.json()["details"]["errors"]
            assert sum(one["where"].startswith(f"body.{field}.") for one in errors) == 1


def hostile_requests(path, operation, fields, served):
    """Paths with one hostile parameter, and bodies with one hostile field."""
    parameters = operation.get("parameters", [])
    known = {one["name"]: "0" for one in parameters if one["in"] == "path"} | served.known
    body = BODIES.get(path)
    plain = path.format_map(known)
    for parameter in parameters:
        name = parameter["name"]
        for value in VALUES:
            hostile = quote(value, safe="")
            if parameter["in"] == "path":
                yield path.format_map(known | {name: hostile}), json.dumps(body)
            elif parameter["in"] == "query":
                yield f"{plain}?{name}={hostile}", json.dumps(body)
    for field in fields:
        others = [
            f"{json.dumps(name)}: {json.dumps(value)}" for name, value in (body or {}).items()
        ]
        for text in JSON_TEXTS:
            yield plain, "{" + ", ".join([*others, f'"{field}": {text}']) + "}"


@pytest.mark.slow
@pytest.mark.parametrize("service", SERVICES)
async def test_hostile_values_are_refused(service, tmp_path):
    async with SERVICES[service](tmp_path) as served:
        document = served.app.openapi()
        for path, operations in document["paths"].items():
            for method, operation in operations.items():
                headers = served.headers | ({"content-type": JSON} if method == "post" else {})
                fields = fields_of(document, operation)
                for url, body in hostile_requests(path, operation, fields, served):
                    content = body if method == "post" else None
                    response = await served.client.request(
                        method, url, content=content, headers=headers
                    )
                    assert response.status_code < 500, f"{method} {url}: {response.text}"
