"""Which web pages may drive the server: its own, and those of COW_CORS_ORIGINS.

A browser sends a page's requests to any address that it reaches, also to a server on this machine that trusts whoever
can connect. Requests that no page made carry no Origin and are not concerned.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from cow_service.api.problems import respond
from cow_service.errors import OriginNotAllowed

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
            await respond(error)(scope, receive, send)
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
