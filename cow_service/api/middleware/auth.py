"""API keys: where the server has any, only probes and pages are served without one."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from cow_service.api.middleware.keys import KeyRing
from cow_service.api.middleware.pages import is_page
from cow_service.api.middleware.rate_limit import Buckets, address_of, is_probe, rate_limited
from cow_service.api.problems import respond
from cow_service.errors import CowError, Unauthorized

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
                    await respond(self._refusal(scope, given=key is not None))(scope, receive, send)
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
