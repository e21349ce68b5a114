"""OpenTelemetry traces, where the environment names a collector; else OpenTelemetry's SDK is not imported.

The provider is our own and not the process's: libraries that would put questions and images into spans stay silent.
Without a collector, requests have spans that are not recorded: their ids serve logs and callers.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Generator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

from opentelemetry import trace
from opentelemetry.context import Context

from cow_service import __version__
from cow_service.errors import install_line
from cow_service.observability import logging as context
from cow_service.settings import SettingsError

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

ENDPOINTS = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
PROTOCOL = "http/protobuf"

Attribute = str | bool | int | float | None  # None is left out

_provider: TracerProvider | None = None


def start(environment: Mapping[str, str] = os.environ) -> bool:
    """Starts recording and exporting where the environment asks for it; returns whether it does.

    Raises `SettingsError` if it asks for what cannot be done.
    """
    global _provider  # noqa: PLW0603  one process, one exporter
    named = next((name for name in ENDPOINTS if environment.get(name)), None)
    off = environment.get("OTEL_SDK_DISABLED", "").lower() == "true"
    off |= environment.get("OTEL_TRACES_EXPORTER") == "none"
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
            f"Bad settings: {named} is set, but OpenTelemetry is not installed: {install_line('otel')}"
        ) from error
    resource = Resource.create({"service.version": __version__})
    if str(resource.attributes.get("service.name", "unknown_service")).startswith("unknown_service"):
        resource = resource.merge(Resource({"service.name": "cow"}))
    _provider = TracerProvider(resource=resource)
    _provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return True


def stop() -> None:
    """Exports what is left, within OTEL_EXPORTER_OTLP_TIMEOUT (10 s), and stops recording."""
    global _provider
    provider, _provider = _provider, None
    if provider is not None:
        provider.shutdown()


@contextmanager
def span(name: str, *, parent: str | None = None, **attributes: Attribute) -> Generator[None]:
    """A span around the block, recorded where traces are on.

    `parent` is a traceparent, for work that goes on in another thread or process; else it is the current span.
    """
    above = None if parent is None else context.remote(parent)
    if _provider is not None:
        with _recorded(_provider, name, trace.SpanKind.INTERNAL, above, attributes):
            yield
    elif above is not None:
        with trace.use_span(trace.get_current_span(above)):
            yield
    else:
        yield


@contextmanager
def request_span(name: str, parent: str | None) -> Generator[None]:
    """The span of a request around the block; `parent` is the caller's traceparent."""
    above = context.remote(parent)
    if _provider is not None:
        with _recorded(_provider, name, trace.SpanKind.SERVER, above, {}):
            yield
        return
    caller = trace.get_current_span(above).get_span_context()
    trace_id = caller.trace_id or secrets.randbits(128) or 1
    sampled = trace.TraceFlags(caller.trace_flags & trace.TraceFlags.SAMPLED)
    ids = trace.SpanContext(trace_id, secrets.randbits(64) or 1, is_remote=False, trace_flags=sampled)
    with trace.use_span(trace.NonRecordingSpan(ids)):
        yield


def describe(name: str, *, failed: bool, **attributes: Attribute) -> None:
    """Renames the current span, now that more is known of it, and adds attributes."""
    here = trace.get_current_span()
    here.update_name(name)
    here.set_attributes({key: value for key, value in attributes.items() if value is not None})
    if failed:
        here.set_status(trace.StatusCode.ERROR)


def _recorded(
    provider: TracerProvider, name: str, kind: trace.SpanKind, above: Context | None, attributes: dict[str, Attribute]
) -> AbstractContextManager[trace.Span]:
    known = {key: value for key, value in attributes.items() if value is not None}
    tracer = provider.get_tracer("cow_service", __version__)
    return tracer.start_as_current_span(name, context=above, kind=kind, attributes=known)
