"""One log line, two metrics and the attributes of a span for each request.

It also turns exceptions of the inner layers into problems, so that every caller gets one.
"""

import logging
import re
import secrets
import time
from collections.abc import Callable, Iterable
from urllib.parse import quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.routing import compile_path
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cow_service.api.problems import respond
from cow_service.errors import unforeseen
from cow_service.observability import logging as context
from cow_service.observability import tracing
from cow_service.observability.metrics import Metrics

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
UNMATCHED = "unmatched"
CLIENT_CLOSED = 499  # nothing was sent: the caller disconnected, or the server stopped
MAX_PATH = 500  # characters of a path in a log
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,128}", re.ASCII)

log = logging.getLogger("cow_service")
access = logging.getLogger("cow_service.access")


class AccessLog:
    """ASGI middleware, the outermost: records each request from its first to its last byte, with ids.

    Every response has X-Request-Id, traceparent and X-Content-Type-Options. A caller's own X-Request-Id is kept where
    it is harmless in a log, and its trace goes on where it is valid. `paths` gives the templates of all routes, for
    requests that were refused before the router saw them.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, paths: Callable[[], Iterable[str]]) -> None:
        self.app = app
        self.metrics = metrics
        self._paths = paths
        self._templates: list[tuple[re.Pattern[str], str]] | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on within its ids."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        given = headers.get("x-request-id", "")
        request_id = given if _REQUEST_ID.fullmatch(given) else secrets.token_hex(16)
        added = {"X-Request-Id": request_id, "X-Content-Type-Options": "nosniff"}
        started, status, complete = time.perf_counter(), 0, False

        async def observed(message: Message) -> None:
            nonlocal status, complete
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message).update(added)
            elif message["type"] == "http.response.body":
                complete = not message.get("more_body", False)
            await send(message)

        with tracing.request_span(scope["method"], headers.get("traceparent")), context.bound(request=request_id):
            added["traceparent"] = context.traceparent() or ""
            try:
                await self.app(scope, receive, observed)
            except Exception as error:
                if not status:
                    log.error("%s %s failed", scope["method"], _shown(scope), exc_info=error)
                    await respond(unforeseen(), scope)(scope, receive, observed)
                elif not complete:
                    raise  # the server must break the connection off: the caller would take the part for the whole
                # Else the framework has answered and logged it, and raised it again only to tell the server.
            finally:
                self._record(scope, status or CLIENT_CLOSED, time.perf_counter() - started)

    def _record(self, scope: Scope, status: int, seconds: float) -> None:
        method = scope["method"] if scope["method"] in METHODS else "other"
        route, path = getattr(scope.get("route"), "path", None), _shown(scope)
        if not isinstance(route, str):  # the route that would have matched: there are few of those
            if self._templates is None:
                self._templates = [(compile_path(template)[0], template) for template in self._paths()]
            fitting = (template for regex, template in self._templates if regex.match(scope["path"]))
            route = next(fitting, UNMATCHED)
        owner = scope.get("state", {}).get("owner")
        self.metrics.request(method, route, status, seconds)
        tracing.describe(
            f"{method} {route}" if route != UNMATCHED else method,
            failed=status >= 500,
            **{
                "http.request.method": method,
                "http.response.status_code": status,
                "http.route": route,
                "url.path": path,
                "cow.owner": owner,
            },
        )
        milliseconds = round(seconds * 1000, 1)
        fields = {"method": method, "path": path, "status": status, "milliseconds": milliseconds, "owner": owner}
        access.info("%s %s %d %.1f ms", method, path, status, milliseconds, extra=fields)


def _shown(scope: Scope) -> str:
    """The path without its query, percent-encoded: nothing in it can end a line of a log."""
    return quote(scope["path"][:MAX_PATH], safe="/:@!$&'()*+,;=~")
