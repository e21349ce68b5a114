"""OpenTelemetry traces, where the environment names a collector. Elsewhere nothing of OpenTelemetry is imported.

The provider is our own and not the process's: libraries that would put questions and images into spans stay silent.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from cow_service import __version__
from cow_service.observability import context
from cow_service.observability.context import TraceContext
from cow_service.settings import SettingsError

if TYPE_CHECKING:
    from opentelemetry.context import Context
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.trace import Span

ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
PROTOCOL = "http/protobuf"

Attribute = str | bool | int | float | None  # None is left out

_provider: TracerProvider | None = None


def start(environment: Mapping[str, str] = os.environ) -> bool:
    """Begins to record and export, where the environment asks for it; says whether it does.

    Raises `SettingsError` where it asks for what cannot be done.
    """
    global _provider  # noqa: PLW0603  one process, one exporter
    named = next((name for name in ENDPOINTS if environment.get(name)), None)
    off = (
        environment.get("OTEL_SDK_DISABLED", "").lower() == "true" or environment.get("OTEL_TRACES_EXPORTER") == "none"
    )
    if named is None or off or _provider is not None:
        return _provider is not None
    if not environment[named].startswith(("http://", "https://")):
        raise SettingsError(f"Bad settings: {named} must begin with http:// or https://.")
    protocol = next((name for name in PROTOCOLS if environment.get(name)), None)
    if protocol is not None and environment[protocol] != PROTOCOL:
        raise SettingsError(f"Bad settings: {protocol}={environment[protocol]!r}: traces go out by {PROTOCOL} only.")
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter  # noqa: PLC0415
        from opentelemetry.sdk.resources import Resource  # noqa: PLC0415
        from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415
        from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415
    except ImportError as error:
        raise SettingsError(
            f'Bad settings: {named} is set, but OpenTelemetry is not installed: pip install "cow-service[otel]"'
        ) from error
    resource = Resource.create({"service.version": __version__})
    if str(resource.attributes.get("service.name", "unknown_service")).startswith("unknown_service"):
        resource = resource.merge(Resource({"service.name": "cow"}))
    _provider = TracerProvider(resource=resource)
    _provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return True


def stop() -> None:
    """Sends what is left, for as long as OTEL_EXPORTER_OTLP_TIMEOUT says (10 s), and records no more."""
    global _provider
    provider, _provider = _provider, None
    if provider is not None:
        provider.shutdown()


@contextmanager
def span(name: str, *, parent: str | None = None, **attributes: Attribute) -> Generator[None]:
    """A span around the block, where traces are on; its ids are in `context.trace` for that long.

    `parent` is a traceparent, for work that goes on in another thread or process; else it is the span around.
    """
    if _provider is None:
        yield
        return
    from opentelemetry.trace import SpanKind  # noqa: PLC0415

    above = None if parent is None else context.parse_traceparent(parent)
    with _recorded(_provider, name, SpanKind.INTERNAL, None if above is None else _remote(above), attributes):
        yield


@contextmanager
def request_span(name: str, parent: TraceContext | None) -> Generator[TraceContext]:
    """The span of a request, for as long as the block runs; without traces, ids that are as good for logs."""
    if _provider is None:
        here = context.child_of(parent)
        with context.bound(trace_context=here):
            yield here
        return
    from opentelemetry.context import Context  # noqa: PLC0415
    from opentelemetry.trace import SpanKind  # noqa: PLC0415

    above = Context() if parent is None else _remote(parent)
    with _recorded(_provider, name, SpanKind.SERVER, above, {}) as real:
        yield _told(real)


def describe(name: str, *, failed: bool, **attributes: Attribute) -> None:
    """Names the span around, now that more is known of it, and adds to what it says."""
    if _provider is None:
        return
    from opentelemetry.trace import StatusCode, get_current_span  # noqa: PLC0415

    here = get_current_span()
    here.update_name(name)
    here.set_attributes({key: value for key, value in attributes.items() if value is not None})
    if failed:
        here.set_status(StatusCode.ERROR)


@contextmanager
def _recorded(
    provider: TracerProvider, name: str, kind: object, above: Context | None, attributes: Mapping[str, Attribute]
) -> Generator[Span]:
    from opentelemetry.trace import SpanKind  # noqa: PLC0415

    assert isinstance(kind, SpanKind)
    known = {key: value for key, value in attributes.items() if value is not None}
    tracer = provider.get_tracer("cow_service", __version__)
    with (
        tracer.start_as_current_span(name, context=above, kind=kind, attributes=known) as real,
        context.bound(trace_context=_told(real)),
    ):
        yield real


def _told(real: Span) -> TraceContext:
    ids = real.get_span_context()
    return TraceContext(f"{ids.trace_id:032x}", f"{ids.span_id:016x}", ids.trace_flags.sampled)


def _remote(parent: TraceContext) -> Context:
    from opentelemetry.context import Context  # noqa: PLC0415
    from opentelemetry.trace import NonRecordingSpan, SpanContext, TraceFlags, set_span_in_context  # noqa: PLC0415

    ids = SpanContext(int(parent.trace_id, 16), int(parent.span_id, 16), True, TraceFlags(int(parent.sampled)))
    return set_span_in_context(NonRecordingSpan(ids), Context())
