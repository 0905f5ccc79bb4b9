"""One trace from a client's call across two services: ids, logs, problems and exported spans."""

import asyncio
import re
import threading

import httpx
import pytest
import structlog
from fastapi import APIRouter

from dextouch.clients.http_link import HttpLink
from dextouch.errors import NotFoundError
from dextouch.serving import ServiceSettings, create_service_app
from dextouch.serving.spans import SPANS, Spans
from dextouch.tracing import (
    TraceContext,
    current_trace,
    in_trace,
    new_trace,
    parse_traceparent,
    trace_headers,
)
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.dashboard.upstream import Upstream
from services.pipelines.servers import served

# Of the specification (https://www.w3.org/TR/trace-context/, examples of traceparent).
TRACE_ID = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = f"00-{TRACE_ID}-00f067aa0ba902b7-01"


def test_the_example_of_the_specification():
    context = parse_traceparent(PARENT)
    assert context == TraceContext(TRACE_ID, "00f067aa0ba902b7", "01")
    assert context.header == PARENT
    child = context.child()
    assert (child.trace_id, child.flags) == (TRACE_ID, "01")
    assert child.span_id != context.span_id


@pytest.mark.parametrize(
    "text",
    [
        "",
        PARENT.upper(),
        PARENT[:-1],
        "ff" + PARENT[2:],
        PARENT + "-more",
        PARENT.replace(TRACE_ID, "0" * 32),
        PARENT.replace("00f067aa0ba902b7", "0" * 16),
        PARENT.replace("-01", "-1g"),
        "00-\x00",
    ],
)
def test_invalid_headers_are_not_followed(text):
    assert parse_traceparent(text) is None


def test_a_later_version_may_say_more():
    assert parse_traceparent("01" + PARENT[2:] + "-more").trace_id == TRACE_ID


def test_work_inside_of_a_trace_belongs_to_it():
    assert trace_headers() == {}
    with in_trace() as outer, in_trace() as inner:
        assert inner.trace_id == outer.trace_id
        assert trace_headers() == {"traceparent": inner.header}
    assert current_trace() is None


def service(name="inner"):
    """A service whose routes say in which trace they are."""
    router = APIRouter(prefix="/v1")

    @router.get("/trace")
    async def trace() -> dict[str, str]:
        context = current_trace()
        assert context is not None
        bound = structlog.contextvars.get_contextvars()
        return {"trace_id": context.trace_id, "span_id": context.span_id, "log": bound["trace_id"]}

    @router.get("/episodes")
    async def episodes() -> dict[str, str]:
        return await trace()

    @router.get("/missing")
    async def missing() -> None:
        raise NotFoundError("nothing here")

    return create_service_app(name=name, settings=ServiceSettings(), routers=[router])


def client_of(app):
    transport = httpx.ASGITransport(app)
    return httpx.AsyncClient(transport=transport, base_url="http://localhost")


async def test_a_service_continues_the_trace_of_its_caller():
    async with client_of(service()) as client:
        said = (await client.get("/v1/trace", headers={"traceparent": PARENT})).json()
        assert said["trace_id"] == said["log"] == TRACE_ID
        assert said["span_id"] != "00f067aa0ba902b7"
        refused = await client.get("/v1/missing", headers={"traceparent": PARENT})
        assert refused.json()["trace_id"] == TRACE_ID
        assert refused.json()["request_id"] == refused.headers["x-request-id"]
        # Refused by the guard, before any route.
        foreign = {"host": "evil.example", "traceparent": PARENT}
        assert (await client.get("/v1/trace", headers=foreign)).json()["trace_id"] == TRACE_ID


@pytest.mark.parametrize("given", [{}, {"traceparent": "nonsense"}])
async def test_a_service_begins_a_trace_without_one(given):
    async with client_of(service()) as client:
        first = (await client.get("/v1/trace", headers=given)).json()["trace_id"]
        second = (await client.get("/v1/trace", headers=given)).json()["trace_id"]
    assert re.fullmatch(r"[0-9a-f]{32}", first)
    assert first != second


def test_a_client_of_ours_passes_its_trace_on():
    with served({"inner": service()}) as urls:
        link = HttpLink(urls["inner"])
        with in_trace(new_trace()) as context:
            said = link.request("GET", "/v1/trace")
        link.close()
    assert context.trace_id.encode() in said.body


def dashboard_before(store):
    upstreams = {"episode_store": Upstream("episode_store", client_of(store))}
    return create_dashboard(DashboardSettings(), upstreams)


async def test_the_dashboard_passes_the_trace_on():
    async with client_of(dashboard_before(service())) as client:
        answer = await client.get("/v1/episode_store/episodes", headers={"traceparent": PARENT})
    assert answer.json()["trace_id"] == TRACE_ID


async def test_spans_of_one_call_are_one_trace(monkeypatch):
    sdk = pytest.importorskip("opentelemetry.sdk.trace", reason="extra tracing")
    export = pytest.importorskip("opentelemetry.sdk.trace.export")
    memory = pytest.importorskip("opentelemetry.sdk.trace.export.in_memory_span_exporter")
    exporter = memory.InMemorySpanExporter()
    provider = sdk.TracerProvider()
    provider.add_span_processor(export.SimpleSpanProcessor(exporter))
    tracer = provider.get_tracer("test")
    monkeypatch.setattr(SPANS, "tracer", tracer)
    async with client_of(dashboard_before(service())) as client:
        with tracer.start_as_current_span("the client's call"):
            headers = trace_headers()
            assert (
                await client.get("/v1/episode_store/episodes?limit=1", headers=headers)
            ).status_code == 200
    spans = {span.name: span for span in exporter.get_finished_spans()}
    store = spans["GET /v1/episodes"]
    forwarded = spans["GET /v1/episode_store/episodes"]
    call = spans["the client's call"]
    assert len(spans) == 3
    assert {span.context.trace_id for span in spans.values()} == {call.context.trace_id}
    assert forwarded.parent.span_id == call.context.span_id
    assert store.parent.span_id == forwarded.context.span_id
    assert store.attributes["http.response.status_code"] == 200
    assert store.attributes["http.route"] == "/v1/episodes"


async def test_a_service_that_ends_exports_the_spans_that_wait(monkeypatch):
    sdk = pytest.importorskip("opentelemetry.sdk.trace", reason="extra tracing")
    export = pytest.importorskip("opentelemetry.sdk.trace.export")
    exporter, provider = HeldExporter(), sdk.TracerProvider(shutdown_on_exit=False)
    # So that nothing is exported before the end.
    provider.add_span_processor(export.BatchSpanProcessor(exporter, schedule_delay_millis=60_000))
    monkeypatch.setattr(SPANS, "tracer", provider.get_tracer("test"))
    monkeypatch.setattr(SPANS, "provider", provider)
    app, inner = SPANS.close_with(service()), service()
    exporter.answers.set()
    async with app.router.lifespan_context(app), client_of(app) as client:
        # Practice devices of a station are an application of the same process that ends before it.
        async with inner.router.lifespan_context(inner):
            pass
        await client.get("/healthz")
        assert exporter.names == []
    assert exporter.names == ["GET /healthz"]


async def test_a_service_does_not_wait_long_for_a_collector_that_is_gone(monkeypatch):
    sdk = pytest.importorskip("opentelemetry.sdk.trace", reason="extra tracing")
    export = pytest.importorskip("opentelemetry.sdk.trace.export")
    exporter, provider = HeldExporter(), sdk.TracerProvider(shutdown_on_exit=False)
    provider.add_span_processor(export.BatchSpanProcessor(exporter))
    monkeypatch.setattr(SPANS, "tracer", provider.get_tracer("test"))
    monkeypatch.setattr(SPANS, "provider", provider)
    monkeypatch.setattr("dextouch.serving.spans.FLUSH_S", 0.1)
    app = SPANS.close_with(service())
    async with asyncio.timeout(20):
        async with app.router.lifespan_context(app), client_of(app) as client:
            await client.get("/healthz")
    assert exporter.names == []
    exporter.answers.set()


class HeldExporter:
    """Exports nothing until its collector answers."""

    def __init__(self):
        self.answers, self.names = threading.Event(), []

    def export(self, spans):
        self.answers.wait(60)
        self.names += [span.name for span in spans]

    def shutdown(self):
        pass


def test_nothing_is_exported_unless_it_is_configured(monkeypatch):
    spans = Spans()
    monkeypatch.delenv("OTEL_EXPORTER_OTLP_ENDPOINT", raising=False)
    monkeypatch.delenv("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", raising=False)
    spans.configure("x")
    assert spans.tracer is None
