"""Who may call: API keys, rate limits, and which web pages may drive the server."""

from __future__ import annotations

import hmac
import math
import re
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from hashlib import sha256
from ipaddress import ip_address, ip_network
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from cow_service.api.problems import respond
from cow_service.errors import CowError, OriginNotAllowed, RateLimited, Unauthorized

PREFIX = "cow_"  # lets scanners for leaked secrets know one
ENTROPY_BYTES = 32


def new_key() -> str:
    """A fresh key, random enough that guessing is hopeless and a plain SHA-256 hides it."""
    return PREFIX + secrets.token_urlsafe(ENTROPY_BYTES)


def hash_of(key: str) -> str:
    """The hash as it stands in COW_API_KEYS."""
    # What arrives in a header may hold anything, also what UTF-8 cannot say.
    return "sha256:" + sha256(key.encode(errors="surrogateescape")).hexdigest()


class KeyRing:
    """The hashes of a server's keys, by the name of their owner."""

    def __init__(self, hashes: Mapping[str, str]) -> None:
        self._hashes = {name: value.lower().encode() for name, value in hashes.items()}

    def __len__(self) -> int:
        return len(self._hashes)

    def owner_of(self, key: str) -> str | None:
        """The owner's name, or None where nobody has that key."""
        asked = hash_of(key).encode()
        owner = None
        for name, known in self._hashes.items():  # all of them, so that the time is always the same
            if hmac.compare_digest(asked, known):
                owner = name
        return owner


PATHS = frozenset({"/", "/docs"})
PREFIXES = ("/docs/", "/web/")


def is_page(scope: Scope) -> bool:
    """Whether a request is for a page or a file of one: what the page then asks for needs the key as ever."""
    if scope["type"] != "http" or scope["method"] not in ("GET", "HEAD"):
        return False
    return scope["path"] in PATHS or scope["path"].startswith(PREFIXES)


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
                await respond(rate_limited(detail, wait), scope)(scope, receive, send)
                return
        await self.app(scope, receive, send)


MAX_FAILURES = 30  # per minute from one address, before it has to wait


class ApiKeys:
    """ASGI middleware: finds the owner of the key of each request, `scope["state"]["owner"]`.

    The owner is None where the server has no keys, and for probes and pages. It stands before the router, so that a
    route that is added tomorrow is closed as well.
    """

    def __init__(self, app: ASGIApp, keys: KeyRing, count_failures: bool) -> None:
        self.app = app
        self.keys = keys
        self._failures = Buckets(MAX_FAILURES) if count_failures else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on with its owner, or refuses it."""
        if scope["type"] != "lifespan":
            state = scope.setdefault("state", {})
            state["owner"] = None
            if self.keys and not is_probe(scope) and not is_page(scope):
                key = _bearer(scope)
                owner = None if key is None else self.keys.owner_of(key)
                if owner is None:
                    await respond(self._refusal(scope, given=key is not None), scope)(scope, receive, send)
                    return
                state["owner"] = owner
        await self.app(scope, receive, send)

    def _refusal(self, scope: Scope, given: bool) -> CowError:
        # A right key passes in any case: else one bad neighbour behind the same address would lock all others out.
        wait = self._failures.take(address_of(scope)) if self._failures is not None else 0.0
        if wait:
            return rate_limited("Too many requests without a valid key came from your address.", wait)
        detail = "The key is none of this server's." if given else "The request has no key."
        return Unauthorized(
            f"{detail} Send the header `Authorization: Bearer <key>` with a key that the server's operator gave you.",
            headers={"WWW-Authenticate": "Bearer"},
        )


def _bearer(scope: Scope) -> str | None:
    """The key that was sent; None where there is none, or more than one."""
    sent = Headers(scope=scope).getlist("authorization")
    scheme, _, key = sent[0].strip().partition(" ") if len(sent) == 1 else ("", "", "")
    return key.strip() or None if scheme.lower() == "bearer" else None


METHODS = ("GET", "HEAD", "POST", "DELETE")
REQUEST_HEADERS = (
    "Authorization",
    "Content-Type",
    "Idempotency-Key",
    "Prefer",
    "Cache-Control",
    "Last-Event-ID",
    "X-Request-Id",
    "traceparent",
)
RESPONSE_HEADERS = ("X-Request-Id", "Location", "Retry-After", "traceparent")
_PORT = re.compile(r":\d*$", re.ASCII)
_DEFAULT_PORTS = {"http": ":80", "https": ":443"}  # browsers leave them out


def cors(app: ASGIApp, allowed: Collection[str]) -> ASGIApp:
    """The app with CORS headers for the pages of those origins; without any, the app as it is."""
    if not allowed:
        return app
    return CORSMiddleware(
        app,
        allow_origins=tuple(allowed),
        allow_methods=METHODS,
        allow_headers=REQUEST_HEADERS,
        expose_headers=RESPONSE_HEADERS,
    )


def is_loopback(host: str) -> bool:
    """Whether an address to listen on is reached from this machine alone."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Origins:
    """ASGI middleware: refuses what a foreign page sends.

    `only_local` says that nothing but the address protects the server. A page may then give its own name that address
    (DNS rebinding) and so look like the server's own; names that anybody can register are therefore refused, too.
    """

    def __init__(self, app: ASGIApp, allowed: Collection[str], only_local: bool) -> None:
        self.app = app
        self.allowed = frozenset(allowed)
        self.only_local = only_local
        self._hosts = frozenset(filter(None, (urlsplit(origin).hostname for origin in allowed)))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or refuses it."""
        error = None if scope["type"] == "lifespan" else self._refusal(Headers(scope=scope))
        if error is not None:
            await respond(error, scope)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    def _refusal(self, headers: Headers) -> OriginNotAllowed | None:
        host = headers.get("host", "").lower()
        for origin in headers.getlist("origin"):
            if origin not in self.allowed and "*" not in self.allowed and not _is_own(origin.lower(), host):
                return OriginNotAllowed(
                    f"A page of '{origin[:200]}' may not use this server. Its operator can list that origin in "
                    "COW_CORS_ORIGINS."
                )
        if self.only_local and not self._is_local(host):
            return OriginNotAllowed(
                f"The server listens on this machine only, without keys, and is not known as '{host[:200]}'. Ask for "
                "localhost or 127.0.0.1; its operator can list https://<name> in COW_CORS_ORIGINS, or set COW_API_KEYS."
            )
        return None

    def _is_local(self, host: str) -> bool:
        name = _PORT.sub("", host).strip("[]")
        if "." not in name or name.endswith(".localhost") or name in self._hosts:
            return True  # nobody can register a name without a dot
        try:
            ip_address(name)
        except ValueError:
            return False
        return True


def _is_own(origin: str, host: str) -> bool:
    """Whether a page was served under the very name and port that it asks."""
    scheme, _, place = origin.partition("://")
    port = _DEFAULT_PORTS.get(scheme, "")
    return bool(place) and place == (host.removesuffix(port) if port else host)
