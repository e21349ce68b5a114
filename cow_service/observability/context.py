"""The ids of the current request, job and span, for logs, traces and outgoing calls.

They follow `await` and anyio's threads. Other threads and processes start without: hand the ids over and `bound` them
there. Spans are those of OpenTelemetry's context; its format is W3C Trace Context.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar

from opentelemetry.context import Context
from opentelemetry.trace import TraceFlags, format_span_id, format_trace_id, get_current_span
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

_W3C = TraceContextTextMapPropagator()

request_id: ContextVar[str | None] = ContextVar("cow_request_id", default=None)
job_id: ContextVar[str | None] = ContextVar("cow_job_id", default=None)


@contextmanager
def bound(*, request: str | None = None, job: str | None = None) -> Generator[None]:
    """Sets those that are given, for the duration of the block."""
    with ExitStack() as stack:
        for variable, value in ((request_id, request), (job_id, job)):
            if value is not None:
                stack.callback(variable.reset, variable.set(value))
        yield


def ids() -> dict[str, str]:
    """The ids that are set, by their names in logs."""
    span = get_current_span().get_span_context()
    known = {
        "request_id": request_id.get(),
        "job_id": job_id.get(),
        "trace_id": format_trace_id(span.trace_id) if span.is_valid else None,
        "span_id": format_span_id(span.span_id) if span.is_valid else None,
    }
    return {name: value for name, value in known.items() if value is not None}


def traceparent() -> str | None:
    """The header that names the current span as the parent; None where there is none."""
    span = get_current_span().get_span_context()
    if not span.is_valid:
        return None
    # Of the flags, only this one has a meaning in every version of the format.
    sampled = span.trace_flags & TraceFlags.SAMPLED
    return f"00-{format_trace_id(span.trace_id)}-{format_span_id(span.span_id)}-{sampled:02x}"


def remote(header: str | None) -> Context:
    """A context with the span that a traceparent header names; an empty one where the header is missing or invalid."""
    return _W3C.extract({"traceparent": header or ""}, Context())
