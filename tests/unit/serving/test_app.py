"""The application factory: every failure is a problem+json, nothing leaks, health is honest."""

import json
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import httpx
import pytest
from fastapi import APIRouter, Depends, FastAPI, Request
from httpx import ASGITransport, AsyncClient
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, SecretStr
from starlette.datastructures import Headers

from dextouch import __version__, errors
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Problem, error_from_problem
from dextouch.serving import (
    AS_SET,
    JSON,
    OCTETS,
    RequireScope,
    ServiceSettings,
    create_service_app,
    takes,
    timed,
)
from dextouch.serving.guard import header, media_type
from dextouch.serving.keys import ApiKey

CASES = [
    (errors.PacketError("bad"), 400),
    (errors.ShapeError("bad", got=[1, 2]), 422),
    (errors.UnknownNameError("task", "x", ["a", "b"]), 422),
    (errors.NotFoundError("gone"), 404),
    (errors.ConflictError("other state", expected=3), 409),
    (errors.LimitExceededError("too big"), 413),
    (errors.LimitExceededError("too many", retry_after_s=2), 429),
    (errors.UnavailableError("not ready", retry_after_s=1), 503),
    (errors.StaleDataError("old"), 503),
    (errors.StorageFullError("full"), 507),
    (errors.CorruptDataError("damaged"), 500),
    (errors.AccessDeniedError("no", reason="missing_key"), 401),
    (errors.AccessDeniedError("no", reason="missing_scope"), 403),
    (errors.DexTouchError("odd", value=float("nan"), thing=object()), 500),
]


PROBLEM = "application/problem+json"
JSON_HEADER = {"content-type": JSON}
OCTETS_HEADER = {"content-type": OCTETS}


class Body(BaseModel):
    number: int


class StrictBody(FrozenModel):
    number: int


def make_app(**kwargs) -> FastAPI:
    router = APIRouter()

    @router.get("/fail/{index}")
    async def fail(index: int) -> None:
        raise CASES[index][0]

    @router.get("/boom")
    async def boom() -> None:
        raise RuntimeError("secret internals")

    @router.post("/json")
    async def take_json(body: Body) -> int:
        return body.number

    @router.post("/strict")
    async def take_strict(body: StrictBody) -> int:
        return body.number

    @router.post("/raw")
    @takes({JSON: AS_SET, OCTETS: AS_SET})
    async def take_raw(request: Request) -> int:
        with timed(request, "read"):
            return len(await request.body())

    @router.get("/guarded", dependencies=[Depends(RequireScope("rollout"))])
    async def guarded() -> str:
        return "in"

    settings = kwargs.pop("settings", ServiceSettings(max_body_bytes=2048))
    return create_service_app(name="probe", settings=settings, routers=[router], **kwargs)


def client_of(app: FastAPI) -> AsyncClient:
    transport = ASGITransport(app, raise_app_exceptions=False)
    return AsyncClient(transport=transport, base_url="http://localhost")


def problem_of(response: httpx.Response) -> Problem:
    assert response.headers["content-type"] == "application/problem+json"
    problem = Problem.model_validate_json(response.content)
    assert problem.status == response.status_code
    assert problem.request_id == response.headers["x-request-id"]
    assert "Traceback" not in response.text
    return problem


@pytest.mark.parametrize("index", range(len(CASES)))
async def test_each_error_has_its_status_and_comes_back_as_itself(index):
    error, status = CASES[index]
    async with client_of(make_app()) as client:
        response = await client.get(f"/fail/{index}")
    assert response.status_code == status
    back = error_from_problem(problem_of(response))
    assert type(back) is type(error)
    assert back.message == error.message
    assert set(back.details) == set(error.details)
    if "retry_after_s" in error.details:
        assert response.headers["retry-after"] == str(error.details["retry_after_s"])


async def test_an_unexpected_error_says_nothing_of_the_inside():
    async with client_of(make_app()) as client:
        response = await client.get("/boom")
    assert response.status_code == 500
    assert "secret" not in response.text
    assert problem_of(response).type.endswith(":DexTouchError")


async def test_unknown_routes_methods_and_bodies_are_problems():
    async with client_of(make_app()) as client:
        assert problem_of(await client.get("/nowhere")).status == 404
        wrong_method = await client.get("/json")
        assert problem_of(wrong_method).status == 405
        assert wrong_method.headers["allow"] == "POST"
        assert (
            problem_of(await client.post("/json", content=b"{", headers=JSON_HEADER)).status == 400
        )
        missing = problem_of(await client.post("/json", json={"number": "many"}))
        assert missing.status == 422
        assert "body.number" in missing.detail


async def test_the_answer_to_many_mistakes_is_short():
    many = {f"field{index}": 0 for index in range(100)}
    async with client_of(make_app()) as client:
        problem = problem_of(await client.post("/strict", json=many))
    assert problem.status == 422
    assert len(problem.details["errors"]) == 10
    # The missing number is the first of them.
    assert problem.detail.startswith("body.number: Field required; ")
    assert problem.detail.endswith("; and 91 more")


def operation_of(app: FastAPI, path: str, method: str) -> tuple[dict, dict[str, str]]:
    """An operation of the OpenAPI document, and the media types of its responses by status."""
    document = app.openapi()
    operation, refused = document["paths"][path][method], document["components"]["responses"]
    answers = {
        status: refused[answer["$ref"].rpartition("/")[2]] if "$ref" in answer else answer
        for status, answer in operation["responses"].items()
    }
    kinds = {status: "".join(answer.get("content", "")) for status, answer in answers.items()}
    return operation, kinds


def test_the_document_has_what_routes_declare():
    _, plain = operation_of(make_app(), "/fail/{index}", "get")
    problems = {status: kind for status, kind in plain.items() if int(status) >= 400}
    assert problems == dict.fromkeys(
        ("404", "408", "413", "415", "421", "422", "429", "431", "500", "503"), PROBLEM
    )
    raw, answers = operation_of(make_app(), "/raw", "post")
    assert set(raw["requestBody"]["content"]) == {JSON, OCTETS}
    assert {"400", "403", "409", "429", "507"} <= set(answers)
    assert "security" not in raw
    components = make_app().openapi()["components"]
    assert set(components["schemas"]["Problem"]["required"]) == {
        "type",
        "title",
        "status",
        "detail",
    }
    assert "HTTPValidationError" not in components["schemas"]


@pytest.mark.parametrize("has_keys", [True, False])
def test_the_document_names_the_key_that_a_route_needs(has_keys):
    key = ApiKey(name="policy", key=SecretStr("good-key-for-policies"), scopes=("rollout",))
    app = make_app(settings=ServiceSettings(api_keys=(key,) if has_keys else ()))
    scheme = app.openapi()["components"]["securitySchemes"]["api_key"]
    assert (scheme["type"], scheme["scheme"]) == ("http", "bearer")
    operation, answers = operation_of(app, "/guarded", "get")
    assert operation["security"] == [{"api_key": ["rollout"]}, *([] if has_keys else [{}])]
    assert answers["401"] == answers["403"] == PROBLEM


@pytest.mark.parametrize("path", ["/raw", "/json"])
@pytest.mark.parametrize("announced", [True, False])
async def test_a_body_over_the_limit_is_refused_announced_or_not(path, announced):
    async def parts() -> AsyncIterator[bytes]:
        for _ in range(5):
            yield b"x" * 1000

    content = b"x" * 5000 if announced else parts()
    async with client_of(make_app()) as client:
        response = await client.post(path, content=content, headers=JSON_HEADER)
    problem = problem_of(response)
    assert problem.status == 413
    assert "2048" in problem.detail


async def test_readiness_follows_lifespan_and_check():
    seen: list[str] = []
    missing = ["model"]

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        seen.append("start")
        yield
        seen.append("stop")

    async def readiness() -> list[str]:
        return missing

    app = make_app(lifespan=lifespan, readiness=readiness)
    async with client_of(app) as client:
        assert (await client.get("/healthz")).json() == {
            "status": "ok",
            "service": "probe",
            "version": __version__,
        }
        # As monitors and load balancers ask.
        assert [(await client.head(path)).status_code for path in ("/healthz", "/readyz")] == [
            200,
            503,
        ]
        early = await client.get("/readyz")
        assert (early.status_code, early.json()["waiting_for"]) == (503, ["start"])
        async with app.router.lifespan_context(app):
            waiting = await client.get("/readyz")
            assert (waiting.status_code, waiting.json()["waiting_for"]) == (503, ["model"])
            missing.clear()
            assert (await client.get("/readyz")).status_code == 200
        assert (await client.get("/readyz")).status_code == 503
    assert seen == ["start", "stop"]


async def test_metrics_count_by_route_template_in_an_own_registry():
    async with client_of(make_app()) as client:
        await client.get("/fail/0")
        await client.get("/fail/1")
        await client.get("/nowhere")
        text = (await client.get("/metrics")).text
    sample = 'dextouch_http_requests_total{method="GET",route="/fail/{index}",status="400"} 1.0'
    assert sample in text
    assert 'route="unmatched",status="404"' in text
    assert "python_info" not in text


async def test_requests_are_counted_once_however_many_wait_for_it(monkeypatch):
    monkeypatch.setattr("dextouch.serving.connections.MAX_UNCOUNTED", 3)
    app = make_app()
    async with client_of(app) as client:
        for _ in range(7):
            await client.get("/fail/0")
        label = {"method": "GET", "route": "/fail/{index}", "status": "400"}
        counted = app.state.registry.get_sample_value("dextouch_http_requests_total", label)
        again = app.state.registry.get_sample_value("dextouch_http_requests_total", label)
        timed = app.state.registry.get_sample_value(
            "dextouch_http_request_seconds_count", {"method": "GET", "route": "/fail/{index}"}
        )
    assert counted == again == timed == 7.0


async def test_request_id_is_kept_when_sane_and_timing_is_told():
    async with client_of(make_app()) as client:
        kept = await client.post(
            "/raw", content=b"ab", headers=OCTETS_HEADER | {"x-request-id": "take-7"}
        )
        replaced = await client.post("/raw", content=b"", headers={"x-request-id": "a b\x7f"})
    assert kept.headers["x-request-id"] == "take-7"
    assert len(replaced.headers["x-request-id"]) == 32
    assert kept.headers["server-timing"].startswith("read;dur=")
    assert "total;dur=" in kept.headers["server-timing"]


@pytest.mark.parametrize("parameter", ["a*=x; a*0=y", f"a*{'1' * 5000}=x", "a*0*=x; a*1*=%ff"])
async def test_odd_parameters_of_a_media_type_are_ignored(parameter):
    async with client_of(make_app()) as client:
        for kind, status in ((OCTETS, 200), ("text/html", 415)):
            headers = {"content-type": f"{kind}; {parameter}"}
            assert (await client.post("/raw", content=b"ab", headers=headers)).status_code == status


@pytest.mark.parametrize(
    "text",
    [
        "a/b; dtype=float32",
        "a/b;dtype=FLOAT32",
        'A/B ; x=" " ; dtype = "float32"; y',
        "a/b;dtype=float32;",
    ],
)
def test_media_types_and_their_parameters(text):
    kind, parameters = media_type(text)
    assert kind == "a/b"
    assert parameters["dtype"] == "float32"


async def test_keys_open_only_what_their_scopes_name():
    good, weak = "good-key-for-policies", "weak-key-for-ratings"
    settings = ServiceSettings(
        host="0.0.0.0",  # noqa: S104 - that keys are demanded there is what is tested
        api_keys=(
            ApiKey(name="policy", key=SecretStr(good), scopes=("rollout",)),
            ApiKey(name="rater", key=SecretStr(weak), scopes=("rate",)),
        ),
    )
    async with client_of(make_app(settings=settings)) as client:
        missing = await client.get("/guarded")
        assert missing.status_code == 401
        assert missing.headers["www-authenticate"] == "Bearer"
        for header, status in [
            (f"Bearer {good}", 200),
            (f"bearer {good}", 200),
            (f"Bearer {weak}", 403),
            ("Bearer nonsense", 401),
            (f"Basic {good}", 401),
            ("Bearer ", 401),
        ]:
            answer = await client.get("/guarded", headers={"authorization": header})
            assert answer.status_code == status, header
            assert good not in answer.text


async def test_without_keys_loopback_is_open():
    async with client_of(make_app()) as client:
        assert (await client.get("/guarded")).status_code == 200


async def test_request_id_reaches_the_log(caplog):
    async with client_of(make_app()) as client:
        with caplog.at_level(logging.ERROR):
            response = await client.get("/boom", headers={"x-request-id": "abc"})
    assert json.loads(response.content)["request_id"] == "abc"


@given(
    sent=st.lists(st.tuples(st.sampled_from([b"host", b"origin", b"x"]), st.binary())),
    name=st.sampled_from(["host", "origin", "absent"]),
)
def test_headers_are_read_as_starlette_reads_them(sent, name):
    scope = {"type": "http", "headers": sent}
    assert header(scope, name.encode()) == Headers(scope=scope).get(name)
