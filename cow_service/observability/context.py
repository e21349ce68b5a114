"""What belongs to the request or the job at work right now: its ids, for logs, traces and calls to others.

It follows `await` and anyio's threads by itself. Other threads and processes start without: hand the ids over and
`bound` them there.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

_TRACEPARENT = re.compile(r"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?", re.ASCII)
_SAMPLED = 0x01  # the one flag of version 00 that may be passed on


@dataclass(frozen=True)
class TraceContext:
    """A span by its ids (W3C Trace Context). Not the span itself: it holds no times and records nothing."""

    trace_id: str  # 32 hexadecimal digits
    span_id: str  # 16 hexadecimal digits
    sampled: bool = False

    @property
    def traceparent(self) -> str:
        """The header that names this span as the parent."""
        return f"00-{self.trace_id}-{self.span_id}-{'01' if self.sampled else '00'}"


request_id: ContextVar[str | None] = ContextVar("cow_request_id", default=None)
job_id: ContextVar[str | None] = ContextVar("cow_job_id", default=None)
trace: ContextVar[TraceContext | None] = ContextVar("cow_trace", default=None)


@contextmanager
def bound(
    *, request: str | None = None, job: str | None = None, trace_context: TraceContext | None = None
) -> Generator[None]:
    """Sets those that are given, for as long as the block runs."""
    with ExitStack() as stack:
        if request is not None:
            stack.callback(request_id.reset, request_id.set(request))
        if job is not None:
            stack.callback(job_id.reset, job_id.set(job))
        if trace_context is not None:
            stack.callback(trace.reset, trace.set(trace_context))
        yield


def ids() -> dict[str, str]:
    """The ids that are set, by their names in logs."""
    here = trace.get()
    known = {
        "request_id": request_id.get(),
        "job_id": job_id.get(),
        "trace_id": here.trace_id if here else None,
        "span_id": here.span_id if here else None,
    }
    return {name: value for name, value in known.items() if value is not None}


def parse_traceparent(header: str) -> TraceContext | None:
    """The caller's span, or None where the header is not valid (W3C Trace Context, section 3.2)."""
    found = _TRACEPARENT.fullmatch(header.strip())
    if found is None:
        return None
    version, trace_id, span_id, flags, rest = found.groups()
    # Later versions may add fields behind ours; version 00 has none, and ff is forbidden.
    if version == "ff" or (version == "00" and rest) or not int(trace_id, 16) or not int(span_id, 16):
        return None
    return TraceContext(trace_id, span_id, bool(int(flags, 16) & _SAMPLED))


def child_of(parent: TraceContext | None) -> TraceContext:
    """A new span in the parent's trace, or in a new trace."""
    if parent is None:
        return TraceContext(secrets.token_hex(16), secrets.token_hex(8))
    return TraceContext(parent.trace_id, secrets.token_hex(8), parent.sampled)
