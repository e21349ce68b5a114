"""Refuses bodies that are too large (even without a Content-Length), too slow, or too many at once."""

import asyncio
from collections import Counter

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cow_service.api.middleware.access import charge
from cow_service.api.problems import respond
from cow_service.errors import BodyTooLarge, BodyTooSlow, CowError, MalformedBody, QueueFull

SHARE_OF_ONE = 0.75  # of the bodies that are held, that one key may have: others find room
_RELEASE = "release_body"  # in the state of a request


class BodyLimit:
    """ASGI middleware: counts the body's bytes, and the seconds from the request's headers to the body's end.

    How long the headers take is the matter of `server.Connection`: the app hears of a request once they are in.
    """

    def __init__(self, app: ASGIApp, megabytes: float, seconds: float, megabytes_at_once: float) -> None:
        self.app = app
        self.megabytes = megabytes
        self.seconds = seconds
        self.megabytes_at_once = max(megabytes_at_once, megabytes)
        self._held = Counter[str | None]()  # bytes of all bodies that are not read yet, by owner

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on; past a limit the app gets `BodyTooLarge` or `BodyTooSlow` where it reads the body."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = int(self.megabytes * 1_000_000)
        if (refusal := self._refused(scope, limit)) is not None:
            await respond(refusal, scope)(scope, receive, send)
            return
        deadline = asyncio.get_running_loop().time() + self.seconds
        owner: str | None = scope.get("state", {}).get("owner")
        share = 1.0 if owner is None else SHARE_OF_ONE
        most, most_own = 1e6 * self.megabytes_at_once, 1e6 * max(self.megabytes, share * self.megabytes_at_once)
        seen = 0
        released = False
        waiting = True  # for more of the body, which the app still wants

        async def counted() -> Message:
            nonlocal seen, waiting
            if not waiting:
                return await receive()
            try:
                async with asyncio.timeout_at(deadline):
                    message = await receive()
            except TimeoutError as error:
                raise BodyTooSlow(
                    f"Of the body {seen} bytes came in {self.seconds:g} s, and not its end. Send it at once, or raise "
                    "COW_BODY_TIMEOUT on the server.",
                    headers={"Connection": "close"},
                ) from error
            waiting = bool(message.get("more_body", False))
            size = len(message.get("body", b""))
            seen += size
            charge.get()("MB of bodies", size / 1e6)
            if not released:
                self._held[owner] += size
            if seen > limit:
                raise self._too_large()
            if self._held.total() > most or self._held[owner] > most_own:
                raise QueueFull(
                    f"The server holds {self._held.total() / 1e6:.0f} MB of unread request bodies, of which "
                    f"{self._held[owner] / 1e6:.0f} MB are yours: COW_MAX_BODIES_MB allows "
                    f"{most / 1e6:.0f} in all and {most_own / 1e6:.0f} for one. Send the request again later.",
                    headers={"Retry-After": "1", "Connection": "close"},
                )
            return message

        def release() -> None:
            nonlocal released
            if not released:
                released = True
                self._held[owner] -= seen

        async def answered(message: Message) -> None:
            nonlocal waiting
            waiting = False  # an app that answers without the whole body must not be disturbed by the rest of it
            await send(message)

        scope.setdefault("state", {})[_RELEASE] = release
        try:
            await self.app(scope, counted, answered)
        finally:
            release()

    def _refused(self, scope: Scope, limit: int) -> CowError | None:
        """What the headers alone show to be wrong."""
        headers = dict(scope["headers"])
        announced = headers.get(b"content-length", b"")
        if announced and b"transfer-encoding" in headers:
            # Servers and proxies differ on which of the two counts (RFC 9112, section 6.1): the next request could be
            # smuggled in this one's body.
            return MalformedBody(
                "The request has both Content-Length and Transfer-Encoding: send one of them.",
                headers={"Connection": "close"},
            )
        return self._too_large() if announced.isdigit() and int(announced) > limit else None

    def _too_large(self) -> BodyTooLarge:
        return BodyTooLarge(
            f"The body is larger than {self.megabytes:g} MB. Send a smaller image, or raise COW_MAX_BODY_MB on the "
            "server."
        )


def release_body(request: Request) -> None:
    """Stops counting the body of a request, which was read and is no longer kept."""
    request.scope.get("state", {}).get(_RELEASE, lambda: None)()
