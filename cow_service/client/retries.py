"""When a call is sent again, and how long to wait before.

Every call can be: those that make a job carry one idempotency key through all attempts, so that none makes a second.
"""

from __future__ import annotations

import email.utils
import random
import time
from datetime import UTC

import httpx

from cow_service.client.errors import code_of

MAX_RETRY_AFTER_SECONDS = 60.0  # a server that asks for more is asked again after this time
FIRST_BACKOFF_SECONDS, BACKOFF_GROWTH, MAX_BACKOFF_SECONDS = 0.5, 2.0, 8.0  # without a Retry-After
# Refusals before a job is made. What a job has failed with is final: the same key would return it again.
RETRYABLE_CODES = frozenset({"queue-full", "rate-limited", "shutting-down", "not-ready", "body-too-slow"})
RETRYABLE_STATUS = frozenset({408, 425, 429, 502, 503, 504})  # of a proxy in front of the server
_BROKEN_CONNECTION = (httpx.NetworkError, httpx.TimeoutException, httpx.RemoteProtocolError)


def pause_before_retry(outcome: httpx.Response | httpx.HTTPError, attempts: int) -> float | None:
    """Seconds to wait after so many attempts; None where another would have the same outcome."""
    if isinstance(outcome, httpx.HTTPError):
        return _backoff(attempts) if isinstance(outcome, _BROKEN_CONNECTION) else None
    code = code_of(outcome)
    if code not in RETRYABLE_CODES if code is not None else outcome.status_code not in RETRYABLE_STATUS:
        return None
    retry_after = _retry_after(outcome.headers.get("retry-after"))
    return (
        _backoff(attempts)
        if retry_after is None
        else min(retry_after, MAX_RETRY_AFTER_SECONDS) + random.uniform(0, 0.25)
    )


def _backoff(attempts: int) -> float:
    return min(FIRST_BACKOFF_SECONDS * BACKOFF_GROWTH ** (attempts - 1), MAX_BACKOFF_SECONDS) * random.uniform(
        0.75, 1.25
    )


def _retry_after(header: str | None) -> float | None:
    """The header `Retry-After`, a number or a date (RFC 9110), as seconds from now."""
    if header is None:
        return None
    if header.isascii() and header.isdecimal():
        return float(header)
    try:
        date = email.utils.parsedate_to_datetime(header)
    except ValueError:
        return None
    # Without a zone it is the old asctime form, which is in GMT as well.
    return max(0.0, (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp() - time.time())
