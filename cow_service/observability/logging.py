"""Logs of the server: text for people or one JSON object a line for machines, each with the ids of its request.

Requests go to standard output, everything else on standard error.
"""

import json
import logging
import re
import sys
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, TextIO

from opentelemetry.context import Context
from opentelemetry.trace import TraceFlags, format_span_id, format_trace_id, get_current_span
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from cow_service.settings import Settings

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
    """The header that names the current span as the parent; None if there is none."""
    span = get_current_span().get_span_context()
    if not span.is_valid:
        return None
    # Of the flags, only this one has a meaning in every version of the format.
    sampled = span.trace_flags & TraceFlags.SAMPLED
    return f"00-{format_trace_id(span.trace_id)}-{format_span_id(span.span_id)}-{sampled:02x}"


def remote(header: str | None) -> Context:
    """A context with the span that a traceparent header names; an empty one where the header is missing or invalid."""
    return _W3C.extract({"traceparent": header or ""}, Context())


def rfc3339(seconds: float) -> str:
    """A Unix time as RFC 3339 in UTC, to the millisecond: `2026-01-31T12:00:00.000Z`."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


ACCESS = "cow_service.access"
MAX_TEXT = 10_000  # characters of a line, or of a value of one: errors of libraries repeat what a caller sent
_NOT_EXTRA = frozenset((*vars(logging.makeLogRecord({})), "message", "asctime", "color_message", "taskName"))
_SHOWN = ("request_id", "job_id", "owner")  # shown in a line of text
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")


def add_ids(record: logging.LogRecord) -> bool:
    """A filter that takes every record, and gives it the ids of the request or job at work that it does not bring."""
    for name, value in ids().items():
        if not hasattr(record, name):
            setattr(record, name, value)
    return True


def _shortened(text: str) -> str:
    """The begin and the end of a long text: the last line of a trace says what happened."""
    half = MAX_TEXT // 2
    return text if len(text) <= MAX_TEXT else f"{text[:half]} [{len(text) - 2 * half} characters] {text[-half:]}"


class TextFormatter(logging.Formatter):
    """`2026-01-31 12:00:00 INFO cow_service: message request_id=...`; a trace follows on lines of its own."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, and the trace."""
        return _shortened(super().format(record))

    def formatMessage(self, record: logging.LogRecord) -> str:
        """One line. Control characters are escaped: no value can forge a second one."""
        shown = "".join(f" {name}={value}" for name in _SHOWN if (value := getattr(record, name, None)) is not None)
        text = _CONTROL.sub(lambda found: repr(found[0])[1:-1], record.getMessage() + shown)
        name = record.name.removesuffix(".error")  # uvicorn's name for whatever is no request
        return f"{self.formatTime(record, '%Y-%m-%d %H:%M:%S')} {record.levelname} {name}: {text}"


class JsonFormatter(logging.Formatter):
    """One object a line: time (RFC 3339, UTC), level, logger, message, exception, ids, and whatever was added."""

    def format(self, record: logging.LogRecord) -> str:
        """One line, whatever the record holds."""
        fields: dict[str, Any] = {
            "time": rfc3339(record.created),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        exception = self.formatException(record.exc_info) if record.exc_info else record.exc_text
        stack = self.formatStack(record.stack_info) if record.stack_info else None
        if exception or stack:
            fields["exception"] = "\n".join(filter(None, (exception, stack)))
        extra = {name: value for name, value in vars(record).items() if name not in _NOT_EXTRA and value is not None}
        shown = {key: _shortened(value) if isinstance(value, str) else value for key, value in (extra | fields).items()}
        return json.dumps(shown, default=str, ensure_ascii=False)


def set_up(settings: Settings, *, out: TextIO | None = None, err: TextIO | None = None) -> None:
    """Sends all logs of the process through one format. A second call replaces the first."""
    formatter = JsonFormatter() if settings.log_format == "json" else TextFormatter()
    level = settings.log_level.upper()
    problems, requests = logging.StreamHandler(err or sys.stderr), logging.StreamHandler(out or sys.stdout)
    for handler in (problems, requests):
        handler.setFormatter(formatter)
        handler.addFilter(add_ids)
    root = logging.getLogger()
    root.handlers = [problems]
    root.setLevel(max(logging.WARNING, logging.getLevelNamesMapping()[level]))  # libraries have much to tell below that
    for name in ("uvicorn", "uvicorn.error", "cow_service"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [], True
        logger.setLevel(level)
    access = logging.getLogger(ACCESS)
    access.handlers, access.propagate = [requests], False
    logging.captureWarnings(True)
