"""Who may call: API keys, rate limits, and which web pages may drive the server."""

import hmac
import math
import re
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from contextvars import ContextVar
from hashlib import sha256
from ipaddress import ip_address, ip_network
from typing import Literal
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from cow_service.api.problems import respond
from cow_service.errors import CowError, OriginNotAllowed, RateLimited, Unauthorized
from cow_service.settings import Settings

PREFIX = "cow_"  # lets scanners for leaked secrets know one
ENTROPY_BYTES = 32


def new_key() -> str:
    """A fresh key, random enough that guessing is hopeless and a plain SHA-256 hides it."""
    return PREFIX + secrets.token_urlsafe(ENTROPY_BYTES)


def hash_of(key: str) -> str:
    """The hash as it stands in COW_API_KEYS."""
    # What arrives in a header may hold anything, also what UTF-8 cannot say.
    return "sha256:" + sha256(key.encode(errors="surrogateescape")).hexdigest()


def key_owner(key: str, hashes: Mapping[str, str]) -> str | None:
    """The name of a key's owner, or None for an unknown key. `hashes` are those of COW_API_KEYS, by name."""
    asked = hash_of(key)
    owner = None
    for name, known in hashes.items():  # all of them, so that the time is always the same
        if hmac.compare_digest(asked, known):
            owner = name
    return owner


PROBES = ("/livez", "/readyz")
PAGES = ("/", "/docs")
PAGE_FILES = ("/docs/", "/web/")
MAX_CALLERS = 10_000  # remembered; beyond that the one that has been idle longest gets a full bucket
MAX_FAILURES = 30  # per minute from one address, before it has to wait


def is_open(path: str) -> bool:
    """Whether everybody may ask for it: probes, and pages with their files."""
    return path in (*PROBES, *PAGES) or path.startswith(PAGE_FILES)


class Guard:
    """ASGI middleware: answers with the error of `refuse`, where that has one for a request; else passes it on."""

    def __init__(self, app: ASGIApp, refuse: Callable[[Scope], CowError | None]) -> None:
        self.app = app
        self._refuse = refuse

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on, or refuses it."""
        error = None if scope["type"] == "lifespan" else self._refuse(scope)
        await (self.app if error is None else respond(error, scope))(scope, receive, send)


Unit = Literal["requests", "MB of bodies", "CPU seconds for reading bodies"]


charge: ContextVar[Callable[[Unit, float], None]] = ContextVar("charge", default=lambda unit, amount: None)
"""Counts what the request at hand has used towards the limits of its caller, whatever becomes of it."""


class Callers:
    """Finds the owner of the key of each request, `scope["state"]["owner"]`, and limits what each key uses in a minute.

    Without keys the owner is None, and the limits are of addresses. Probes, and pages with their files, are open to
    everybody: what a page then asks for needs the key as ever. Refusing stands before the router, so that a route that
    is added tomorrow is closed as well.
    """

    def __init__(self, settings: Settings) -> None:
        self._keys = settings.api_keys
        per_minute: dict[Unit, float | None] = {
            "requests": settings.rate_limit,
            "MB of bodies": settings.rate_limit_mb,
            "CPU seconds for reading bodies": settings.rate_limit_cpu,
        }
        self._limits = {unit: Buckets(most) for unit, most in per_minute.items() if most is not None}
        self._failures = Buckets(MAX_FAILURES) if self._limits else None

    def refuse(self, scope: Scope) -> CowError | None:
        """Why a request is refused, if it is."""
        state = scope.setdefault("state", {})
        owner = state["owner"] = None
        if scope["type"] == "http" and scope["method"] in ("GET", "HEAD") and is_open(scope["path"]):
            return None
        if self._keys:
            sent = Headers(scope=scope).getlist("authorization")
            scheme, _, rest = sent[0].strip().partition(" ") if len(sent) == 1 else ("", "", "")
            key = rest.strip() if scheme.lower() == "bearer" else ""
            owner = state["owner"] = key_owner(key, self._keys) if key else None
            if owner is None:
                # A right key passes in any case: else one bad neighbour behind an address would lock all others out.
                if self._failures is not None and (wait := self._failures.take(address_of(scope))):
                    return rate_limited("Too many requests without a valid key came from your address.", wait)
                what = "a key that this server does not know" if key else "no key"
                return Unauthorized(
                    f"The request has {what}. Send the header `Authorization: Bearer <key>` with a key that the "
                    "server's operator gave you.",
                    headers={"WWW-Authenticate": "Bearer"},
                )
        if self._limits:
            return self._limit(f"address {address_of(scope)}" if owner is None else f"key {owner}")
        return None

    def _limit(self, caller: str) -> CowError | None:
        """Takes a request of the caller's; the rest that it uses is charged when that is known."""

        def charge_caller(unit: Unit, amount: float) -> None:
            if unit in self._limits:
                self._limits[unit].charge(caller, amount)

        charge.set(charge_caller)
        for unit, buckets in self._limits.items():
            if wait := buckets.take(caller, 1 if unit == "requests" else 0):
                whose = "this key" if caller.startswith("key ") else "your address"
                return rate_limited(f"The server allows {buckets.per_minute:g} {unit} per minute with {whose}.", wait)
        return None


def rate_limited(detail: str, wait: float) -> RateLimited:
    """The error for a caller who is to wait so many seconds."""
    seconds = max(1, math.ceil(wait))
    return RateLimited(f"{detail} Try again in {seconds} s.", headers={"Retry-After": str(seconds)})


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

    def __init__(self, per_minute: float, most: int = MAX_CALLERS, clock: Callable[[], float] = time.monotonic) -> None:
        self.per_minute = per_minute
        self._rate = per_minute / 60  # tokens per second
        self._most = most
        self._clock = clock
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()  # tokens left, and when that was, s

    def __len__(self) -> int:
        return len(self._levels)

    def take(self, caller: str, tokens: float = 1) -> float:
        """Takes tokens: returns 0, or the seconds until there are enough."""
        missing = tokens - self.charge(caller, 0)
        if missing > 0:
            return missing / self._rate
        self.charge(caller, tokens)
        return 0.0

    def charge(self, caller: str, tokens: float) -> float:
        """Takes tokens, also those that come later; returns how many are left, below 0 where too many were used."""
        now = self._clock()
        level, at = self._levels.pop(caller, (float(self.per_minute), now))
        level = min(self.per_minute, level + (now - at) * self._rate) - tokens
        self._levels[caller] = (level, now)
        if len(self._levels) > self._most:
            self._levels.popitem(last=False)
        return level


_PORT = re.compile(r":\d*$", re.ASCII)
_DEFAULT_PORTS = {"http": ":80", "https": ":443"}  # browsers leave them out


def is_loopback(host: str) -> bool:
    """Whether an address to listen on is reached from this machine alone."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Origins:
    """Refuses what a foreign page sends.

    `only_local` says that nothing but the address protects the server. A page may then give its own name that address
    (DNS rebinding) and so look like the server's own; names that anybody can register are therefore refused, too.
    """

    def __init__(self, allowed: Collection[str], only_local: bool) -> None:
        self._allowed = frozenset(allowed)
        self._only_local = only_local
        self._hosts = frozenset(filter(None, (urlsplit(origin).hostname for origin in allowed)))

    def refuse(self, scope: Scope) -> OriginNotAllowed | None:
        """Why a request is refused, if it is."""
        headers = Headers(scope=scope)
        host = headers.get("host", "").lower()
        for origin in headers.getlist("origin"):
            scheme, _, place = origin.lower().partition("://")
            port = _DEFAULT_PORTS.get(scheme, "")
            is_own = bool(place) and place == (host.removesuffix(port) if port else host)
            if origin not in self._allowed and "*" not in self._allowed and not is_own:
                return OriginNotAllowed(
                    f"Pages from '{origin[:200]}' may not use this server. Its operator can add that origin to "
                    "COW_CORS_ORIGINS."
                )
        if self._only_local and not self._is_local(host):
            return OriginNotAllowed(
                f"The server listens only on this machine, without keys, and not under the name '{host[:200]}'. Use "
                "localhost or 127.0.0.1; its operator can list https://<name> in COW_CORS_ORIGINS, or set COW_API_KEYS."
            )
        return None

    def _is_local(self, host: str) -> bool:
        name = _PORT.sub("", host).strip("[]")
        if "." not in name or name.endswith(".localhost") or name in self._hosts:
            return True  # a name without a dot cannot be registered
        try:
            ip_address(name)
        except ValueError:
            return False
        return True
