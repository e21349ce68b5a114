"""The middleware around the routes, from the outside in.

Correlation   ids of the request, on every response
AccessLog     log line, metrics, span; answers for faults of what follows
Origins       web pages that may not use the server
CORS          headers for those that may
(framework)   faults of what follows become problems
ApiKeys       who calls
RateLimit     how often
BodyLimit     how much, in `app.py`
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from fastapi import FastAPI
from starlette.types import ASGIApp

from cow_service.api.middleware.access_log import AccessLog
from cow_service.api.middleware.auth import ApiKeys
from cow_service.api.middleware.correlation import Correlation
from cow_service.api.middleware.keys import KeyRing
from cow_service.api.middleware.origins import Origins, cors, is_loopback
from cow_service.api.middleware.rate_limit import RateLimit
from cow_service.observability.metrics import Metrics
from cow_service.settings import Settings

log = logging.getLogger("cow_service")


class LayeredApp(FastAPI):
    """FastAPI with layers around its own, which see also what its handler of unforeseen errors answers."""

    surround: Callable[[ASGIApp], ASGIApp] | None = None

    def build_middleware_stack(self) -> ASGIApp:
        """The framework's layers, and ours around them."""
        stack = super().build_middleware_stack()
        return stack if self.surround is None else self.surround(stack)


def install_layers(app: LayeredApp, settings: Settings, metrics: Metrics) -> None:
    """Puts all layers but the body's limit around the routes of an app that is being made."""
    keys = KeyRing(settings.api_keys)
    if settings.rate_limit is not None:
        app.add_middleware(RateLimit, per_minute=settings.rate_limit)
    app.add_middleware(ApiKeys, keys=keys, count_failures=settings.rate_limit is not None)

    def surround(stack: ASGIApp) -> ASGIApp:
        stack = cors(stack, settings.cors_origins)
        stack = Origins(stack, settings.cors_origins, only_local=not keys and is_loopback(settings.host))
        return Correlation(AccessLog(stack, metrics, paths=lambda: app.openapi()["paths"]))

    app.surround = surround


def warn_if_open(settings: Settings) -> None:
    """Logs a warning where anybody who reaches the server can use it."""
    if not settings.api_keys and not is_loopback(settings.host):
        log.warning("COW_API_KEYS is not set: whoever reaches %s can use this server.", settings.host)
