"""Spans of requests for OpenTelemetry, exported by OTLP where its SDK is installed and configured.

Configured means that OTEL_EXPORTER_OTLP_ENDPOINT (or …_TRACES_ENDPOINT) is set; the SDK is in the
extra `tracing`. Without either, this module imports nothing.
"""

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractContextManager, asynccontextmanager, contextmanager
from importlib import import_module
from typing import TYPE_CHECKING

import structlog
from fastapi import FastAPI
from starlette.types import Scope

from dextouch.installation import install_command
from dextouch.serving.guard import header
from dextouch.tracing import TRACEPARENT, TraceContext, in_trace, new_trace, parse_traceparent

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.trace import Tracer

logger = structlog.get_logger(__name__)

ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
# How long a service that ends waits for its collector.
FLUSH_S = 2.0


class Spans:
    """Where spans of requests go; `tracer` is None while they go nowhere."""

    tracer: "Tracer | None" = None
    provider: "TracerProvider | None" = None

    def configure(self, service: str) -> None:
        """Export spans of this process if an endpoint is set and the SDK is installed."""
        if not any(os.environ.get(name) for name in ENDPOINTS):
            return
        try:
            # By name, since neither package is there to be type-checked.
            sdk = import_module("opentelemetry.sdk.trace")
            export = import_module("opentelemetry.sdk.trace.export")
            resources = import_module("opentelemetry.sdk.resources")
            otlp = import_module("opentelemetry.exporter.otlp.proto.http.trace_exporter")
        except ModuleNotFoundError:
            logger.warning("spans_not_exported", reason=install_command("tracing"))
            return
        resource = resources.Resource.create({"service.name": service})
        # Its own handler at exit would wait half a minute, and does not run after a signal.
        provider = sdk.TracerProvider(resource=resource, shutdown_on_exit=False)
        provider.add_span_processor(export.BatchSpanProcessor(otlp.OTLPSpanExporter()))
        self.provider, self.tracer = provider, provider.get_tracer("dextouch")

    def close_with(self, app: FastAPI) -> FastAPI:
        """Close when this application of the process has ended; others below it share the spans."""
        lifespan = app.router.lifespan_context

        @asynccontextmanager
        async def around(app: FastAPI) -> AsyncIterator[None]:
            async with lifespan(app):
                yield
            await asyncio.to_thread(self.close)

        app.router.lifespan_context = around
        return app

    def close(self) -> None:
        """Export the spans that wait; gives up after FLUSH_S, since the collector may be gone."""
        if self.provider is not None:
            closing = threading.Thread(target=self.provider.shutdown, name="spans", daemon=True)
            closing.start()
            closing.join(FLUSH_S)

    @contextmanager
    def of_request(self, scope: Scope, caller: TraceContext | None) -> Iterator[TraceContext]:
        """Span of a request below its caller's; needs a tracer."""
        from opentelemetry import trace
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        assert self.tracer is not None  # noqa: S101 - the caller looks
        above = None
        if caller is not None:
            above = TraceContextTextMapPropagator().extract({TRACEPARENT: caller.header})
        with self.tracer.start_as_current_span(
            scope["method"], context=above, kind=trace.SpanKind.SERVER
        ) as span:
            of_span = span.get_span_context()
            trace_id, span_id = f"{of_span.trace_id:032x}", f"{of_span.span_id:016x}"
            with in_trace(TraceContext(trace_id, span_id, f"{of_span.trace_flags:02x}")) as context:
                yield context
            # The template, which is known once the request was routed.
            route = getattr(scope.get("route"), "path", "unmatched")
            span.update_name(f"{scope['method']} {route}")
            span.set_attributes({"http.request.method": scope["method"], "http.route": route})
            status = scope["state"].get("status")
            if status is not None:
                span.set_attribute("http.response.status_code", status)


SPANS = Spans()


def traced(scope: Scope) -> AbstractContextManager[TraceContext]:
    """Continue the trace of a request's caller, or begin one; the context is the request's span."""
    caller = parse_traceparent(sent) if (sent := header(scope, b"traceparent")) else None
    if SPANS.tracer is not None:
        return SPANS.of_request(scope, caller)
    return in_trace(new_trace() if caller is None else caller.child())
