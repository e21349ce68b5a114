"""When a call is sent again, and how long to wait before.

Every call can be: those that make a job carry one idempotency key through all tries, so that no try makes a second.
"""

from __future__ import annotations

import email.utils
import random
import time
from datetime import UTC

import httpx

from cow_service.client.errors import code_of

LONGEST_PAUSE = 60.0  # seconds; what a server asks for beyond that is not waited for
FIRST_PAUSE, GROWTH, SLOWEST = 0.5, 2.0, 8.0  # seconds, where the server asks for nothing
# Refusals at the door. What a job has failed with stands: the same key would only tell it again.
PASSING = frozenset({"queue-full", "rate-limited", "shutting-down", "not-ready", "body-too-slow"})
PASSING_STATUS = frozenset({408, 425, 429, 502, 503, 504})  # of whatever stands in front of the server
_BROKEN = (httpx.NetworkError, httpx.TimeoutException, httpx.RemoteProtocolError)


def pause_before_retry(outcome: httpx.Response | httpx.HTTPError, tried: int) -> float | None:
    """Seconds to wait before the next try, after so many; None where another would come to the same."""
    if isinstance(outcome, httpx.HTTPError):
        return _backoff(tried) if isinstance(outcome, _BROKEN) else None
    code = code_of(outcome)
    if code not in PASSING if code is not None else outcome.status_code not in PASSING_STATUS:
        return None
    asked = _asked(outcome.headers.get("retry-after"))
    return _backoff(tried) if asked is None else min(asked, LONGEST_PAUSE) + random.uniform(0, 0.25)


def _backoff(tried: int) -> float:
    return min(FIRST_PAUSE * GROWTH ** (tried - 1), SLOWEST) * random.uniform(0.75, 1.25)


def _asked(retry_after: str | None) -> float | None:
    """What `Retry-After` says, in seconds: a number, or a date (RFC 9110)."""
    if retry_after is None:
        return None
    if retry_after.isascii() and retry_after.isdecimal():
        return float(retry_after)
    try:
        date = email.utils.parsedate_to_datetime(retry_after)
    except ValueError:
        return None
    # Without a zone it is the old asctime form, which is in GMT as well.
    return max(0.0, (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp() - time.time())
