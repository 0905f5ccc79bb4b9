"""W3C trace context of the current work, which services and clients accept, log and pass on.

Only ids travel, in the header `traceparent`. Spans are exported where the SDK of OpenTelemetry is
installed and configured (`dextouch.serving.spans`).
"""

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final, NamedTuple

TRACEPARENT: Final = "traceparent"
NOT_SAMPLED: Final = "00"
# Of later versions only these first fields are known; version ff is invalid.
_FORM = re.compile(r"(?!ff)([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?")
_current: ContextVar["TraceContext | None"] = ContextVar("trace_context", default=None)


class TraceContext(NamedTuple):
    """A span of a trace: ids in hexadecimal, and the flags of W3C (01 is sampled)."""

    trace_id: str
    span_id: str
    flags: str = NOT_SAMPLED

    @property
    def header(self) -> str:
        """Value of the header `traceparent`."""
        return f"00-{self.trace_id}-{self.span_id}-{self.flags}"

    def child(self) -> "TraceContext":
        """A new span of the same trace."""
        return TraceContext(self.trace_id, os.urandom(8).hex(), self.flags)


def new_trace(trace_id: str | None = None) -> TraceContext:
    """The first span of a new trace, or a new one of the trace of this id."""
    drawn = os.urandom(24).hex()
    return TraceContext(trace_id or drawn[:32], drawn[32:])


def parse_traceparent(text: str) -> TraceContext | None:
    """The caller's span; None where the header is invalid, which starts a new trace."""
    found = _FORM.fullmatch(text)
    if found is None or (found[1] == "00" and found[5]):
        return None
    trace_id, span_id = found[2], found[3]
    if not trace_id.strip("0") or not span_id.strip("0"):
        return None
    return TraceContext(trace_id, span_id, found[4])


def current_trace() -> TraceContext | None:
    """The span of the current work: ours, or the active one of OpenTelemetry; None without."""
    context = _current.get()
    if context is not None or "opentelemetry.trace" not in sys.modules:
        return context
    span = sys.modules["opentelemetry.trace"].get_current_span().get_span_context()
    if not span.is_valid:
        return None
    return TraceContext(f"{span.trace_id:032x}", f"{span.span_id:016x}", f"{span.trace_flags:02x}")


@contextmanager
def in_trace(context: TraceContext | None = None) -> Iterator[TraceContext]:
    """Work inside belongs to this span, by default to a new one of the current or a new trace."""
    if context is None:
        around = current_trace()
        context = new_trace() if around is None else around.child()
    token = _current.set(context)
    try:
        yield context
    finally:
        _current.reset(token)


def current_trace_id() -> str | None:
    """Id of the trace of the current work; None without."""
    context = current_trace()
    return None if context is None else context.trace_id


def trace_headers() -> dict[str, str]:
    """Headers that pass the current trace on to another service; none without a trace."""
    context = current_trace()
    return {} if context is None else {TRACEPARENT: context.header}
