"""The ids of a request: in its logs and traces, and in its response."""

from __future__ import annotations

import re
import secrets

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cow_service.observability import context, tracing

_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,128}", re.ASCII)


class Correlation:
    """ASGI middleware, the outermost: X-Request-Id, traceparent and X-Content-Type-Options on every response.

    A caller's own X-Request-Id is kept where it is harmless in a log, and its trace goes on where it is valid.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on within its ids."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        given = headers.get("x-request-id", "")
        request_id = given if _REQUEST_ID.fullmatch(given) else secrets.token_hex(16)
        with tracing.request_span(scope["method"], headers.get("traceparent")), context.bound(request=request_id):
            traceparent = context.traceparent() or ""

            async def tagged(message: Message) -> None:
                if message["type"] == "http.response.start":
                    response = MutableHeaders(scope=message)
                    response["X-Request-Id"] = request_id
                    response["traceparent"] = traceparent
                    response["X-Content-Type-Options"] = "nosniff"
                await send(message)

            await self.app(scope, receive, tagged)
