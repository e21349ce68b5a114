"""Rate limit: a token bucket for each caller, in this process."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable
from ipaddress import ip_address, ip_network

from starlette.types import ASGIApp, Receive, Scope, Send

from cow_service.api.middleware.pages import is_page
from cow_service.api.problems import respond
from cow_service.errors import RateLimited

MAX_CALLERS = 10_000  # remembered; beyond that the one that has been idle longest gets a full bucket
PROBES = frozenset({"/livez", "/readyz"})


def is_probe(scope: Scope) -> bool:
    """Whether a request is a health probe, which must always be served."""
    return scope["type"] == "http" and scope["method"] in ("GET", "HEAD") and scope["path"] in PROBES


def address_of(scope: Scope) -> str:
    """The caller's address. Of IPv6 the network: a single caller commonly has all 2^64 addresses of one."""
    client = scope.get("client")
    if not client:
        return "unknown"  # a Unix socket
    try:
        address = ip_address(client[0].partition("%")[0])
    except ValueError:
        return str(client[0])
    return str(ip_network((address, 64), strict=False)) if address.version == 6 else str(address)


class Buckets:
    """A token bucket for each caller, full at first. For the event loop alone: it takes no lock."""

    def __init__(self, per_minute: int, most: int = MAX_CALLERS, clock: Callable[[], float] = time.monotonic) -> None:
        self.per_minute = per_minute
        self._rate = per_minute / 60  # tokens per second
        self._most = most
        self._clock = clock
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()  # tokens left, and when that was, s

    def __len__(self) -> int:
        return len(self._levels)

    def take(self, caller: str) -> float:
        """Takes a token: 0 where there was one, else the seconds until there is."""
        now = self._clock()
        level, at = self._levels.pop(caller, (float(self.per_minute), now))
        level = min(self.per_minute, level + (now - at) * self._rate)
        wait = 0.0 if level >= 1 else (1 - level) / self._rate
        self._levels[caller] = (level if wait else level - 1, now)
        if len(self._levels) > self._most:
            self._levels.popitem(last=False)
        return wait


def rate_limited(detail: str, wait: float) -> RateLimited:
    """The error for a caller who is to wait so many seconds."""
    seconds = max(1, math.ceil(wait))
    return RateLimited(f"{detail} Try again in {seconds} s.", headers={"Retry-After": str(seconds)})


class RateLimit:
    """ASGI middleware: so many requests a minute for each key, or for each address where there are no keys."""

    def __init__(self, app: ASGIApp, per_minute: int) -> None:
        self.app = app
        self.buckets = Buckets(per_minute)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or answers that it came too soon."""
        if scope["type"] != "lifespan" and not is_probe(scope) and not is_page(scope):
            owner = scope["state"]["owner"]
            wait = self.buckets.take(f"key {owner}" if owner is not None else f"address {address_of(scope)}")
            if wait:
                whose = "this key" if owner is not None else "your address"
                detail = f"The server takes {self.buckets.per_minute} requests a minute with {whose}."
                await respond(rate_limited(detail, wait))(scope, receive, send)
                return
        await self.app(scope, receive, send)
