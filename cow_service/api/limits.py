"""Refuses a body that is larger than the server takes, as soon as that is known, also without a Content-Length."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cow_service.api.problems import respond
from cow_service.errors import BodyTooLarge


class BodyLimit:
    """ASGI middleware: counts the body's bytes as they come."""

    def __init__(self, app: ASGIApp, megabytes: float) -> None:
        self.app = app
        self.megabytes = megabytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on; past the limit the app gets `BodyTooLarge` where it reads the body."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = int(self.megabytes * 1_000_000)
        announced = next((value for name, value in scope["headers"] if name == b"content-length"), b"")
        if announced.isdigit() and int(announced) > limit:
            await respond(self._error())(scope, receive, send)
            return
        seen = 0

        async def counted() -> Message:
            nonlocal seen
            message = await receive()
            seen += len(message.get("body", b""))
            if seen > limit:
                raise self._error()
            return message

        await self.app(scope, counted, send)

    def _error(self) -> BodyTooLarge:
        return BodyTooLarge(
            f"The body is larger than {self.megabytes:g} MB. Send a smaller image, or raise COW_MAX_BODY_MB on the "
            "server."
        )
