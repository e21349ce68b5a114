"""Forwards chats to the OpenAI-compatible server behind a model, once, and its replies back unchanged.

Its errors come back with their status and code alone: their words may name accounts and addresses.
"""

import asyncio
import json
import re
from collections.abc import AsyncGenerator, Generator
from contextlib import AsyncExitStack, aclosing, asynccontextmanager, contextmanager, suppress
from http import HTTPStatus
from typing import Any, TypeAlias, cast

import httpx
from anyio import to_thread
from httpx_sse import EventSource
from sse_starlette import ServerSentEvent

from cow_service import __version__
from cow_service.adaptive import BUSY, AdaptivePlaces
from cow_service.api.openai.chats import as_json
from cow_service.client.protocol import retry_after
from cow_service.errors import MllmBadReply, MllmUnavailable, wrong
from cow_service.net import Unreachable, limit_replies
from cow_service.readers.chat import ChatTurn, Upstream, log_refusal
from cow_service.settings import Settings

CONNECT_SECONDS = 10.0
PASSED_HEADERS = ("retry-after", "retry-after-ms", "x-should-retry")
PASSED_PREFIX = "x-ratelimit-"
# These say that this server's own key, or address, is wrong: nothing that a caller could mend.
NOT_THE_CALLERS = (HTTPStatus.UNAUTHORIZED, HTTPStatus.PROXY_AUTHENTICATION_REQUIRED)
DONE = "[DONE]"  # the data of a stream's last event
_CODE = re.compile(r"[A-Za-z_]{1,64}|\d{3}|[a-z_]{1,64}(?:\[\d+\]|\.[a-z_]{1,64}){1,4}")  # no keys, accounts, addresses

Events: TypeAlias = AsyncGenerator[ServerSentEvent]


class Forwarder:
    """One connection pool for all chats, used from one event loop.

    As many are sent at the same time as the MLLM's server takes, `COW_MLLM_CONCURRENCY` at most.
    """

    def __init__(self, settings: Settings) -> None:
        self._timeout, self._budget = settings.mllm_timeout, settings.mllm_budget
        self._places = AdaptivePlaces(settings.mllm_concurrency)
        self._client: httpx.AsyncClient | None = None

    async def close(self) -> None:
        """Closes its connections."""
        if self._client is not None:
            await self._client.aclose()
            self._client = None

    @asynccontextmanager
    async def send(self, upstream: Upstream, body: dict[str, Any]) -> AsyncGenerator[ChatTurn | Events]:
        """The reply to a chat, sent once: whole, or its events.

        Raises `InvalidRequest`, `MllmUnavailable`, `MllmBadReply`.
        """
        try:
            content = json.dumps(body, allow_nan=False)
        except ValueError as error:
            raise wrong("", "holds a number that is too large for a double, such as 1e999") from error
        headers = {"Content-Type": "application/json"}
        if upstream.key is not None:
            headers["Authorization"] = f"Bearer {upstream.key}"
        url = f"{upstream.base_url}/chat/completions"
        if self._client is None:
            client = httpx.AsyncClient(
                timeout=httpx.Timeout(self._timeout, connect=CONNECT_SECONDS, pool=None),
                limits=httpx.Limits(max_connections=None, max_keepalive_connections=self._places.limit.most),
                headers={"User-Agent": f"cow-service/{__version__}"},
            )
            self._client = limit_replies(client, each_event=True)
        client = self._client
        request = client.build_request("POST", url, content=content, headers=headers)
        async with AsyncExitStack() as stack:
            try:
                async with asyncio.timeout(self._budget):
                    call = await stack.enter_async_context(self._places.held())
            except TimeoutError as error:
                limit = self._places.limit
                raise MllmUnavailable(
                    f"{limit.in_flight} chats were being answered (of {limit.most} that COW_MLLM_CONCURRENCY allows, "
                    f"as many as the server took), and there was no place within {self._budget:g} s (COW_MLLM_BUDGET). "
                    "Ask with fewer threads."
                ) from error
            try:
                with _translated():
                    async with asyncio.timeout(self._timeout):
                        response = await client.send(request, stream=True)
                        stack.push_async_callback(response.aclose)
                        kind, ok = response.headers.get("content-type", ""), response.status_code == HTTPStatus.OK
                        is_stream = ok and kind.startswith("text/event-stream")
                        if not is_stream:
                            await response.aread()
            except MllmUnavailable:
                call.refuse()
                raise
            if response.status_code in BUSY:
                seconds = retry_after(response)
                call.refuse(seconds if (seconds or 0.0) < self._budget else None)  # else no other chat could be sent
            call.succeeded = response.is_success
            key = upstream.key
            yield _events(response, key) if is_stream else await to_thread.run_sync(_whole, response, key)


@contextmanager
def _translated() -> Generator[None]:
    """Translates the errors of a connection, in words without addresses."""
    try:
        yield
    except Unreachable as error:
        raise MllmBadReply(f"The server of the multimodal LLM gave no usable reply. {error}") from error
    except (httpx.HTTPError, TimeoutError) as error:
        if isinstance(error, (httpx.TimeoutException, TimeoutError)):
            reason = "it did not reply in time (COW_MLLM_TIMEOUT)"
        elif isinstance(error, httpx.ConnectError):
            reason = "it could not be reached; check that it runs, and COW_MLLM_BASE_URL"
        else:
            reason = "it broke off before its reply was whole"
        detail = f"The server of the multimodal LLM gave no reply: {reason}. It was asked once."
        raise MllmUnavailable(detail) from error


async def _events(response: httpx.Response, key: str | None) -> Events:
    """The events of a stream. Raises `MllmUnavailable` if it ends early."""
    ended = False
    with _translated():
        async with aclosing(EventSource(response).aiter_sse()) as events:
            async for event in events:
                ended = ended or event.data.strip() == DONE
                name = None if event.event == "message" else event.event  # that of an event without one
                is_error = name == "error" or '"error"' in event.data
                error = _error_of(event.data, None, key, is_error=name == "error") if is_error else None
                yield ServerSentEvent(as_json(error) if error else event.data, event=name, sep="\n")
    if not ended:
        raise MllmUnavailable("The server of the multimodal LLM ended its stream before the reply was whole ([DONE]).")


def _whole(response: httpx.Response, key: str | None) -> ChatTurn:
    """A reply, or what went wrong, in OpenAI's form. Raises `MllmBadReply`, `MllmUnavailable`. CPU work."""
    status, text = response.status_code, response.content.decode("utf-8", errors="replace")
    if status == HTTPStatus.OK:
        with suppress(ValueError, RecursionError):
            if isinstance(value := json.loads(text), dict):
                return ChatTurn(cast("dict[str, Any]", value))
        raise MllmBadReply("The server of the multimodal LLM replied with something other than a JSON object.")
    error = _error_of(text, status, key) or {}
    if status in NOT_THE_CALLERS or status < HTTPStatus.BAD_REQUEST:
        raise MllmUnavailable(
            f"The server of the multimodal LLM answered with status {status}: its address or this server's own key for "
            "it is wrong (COW_MLLM_BASE_URL, COW_MLLM_API_KEY)."
        )
    told = response.headers.items()
    headers = {name: value for name, value in told if name in PASSED_HEADERS or name.startswith(PASSED_PREFIX)}
    return ChatTurn(error, status, headers=headers)


def _error_of(text: str, status: int | None, key: str | None, *, is_error: bool = False) -> dict[str, Any] | None:
    """An error of the server in OpenAI's form, without its words, which are logged.

    `status` is None for an event of a stream, which may be no error unless `is_error`: then None is returned.
    """
    value: Any = None
    with suppress(ValueError, RecursionError):
        value = json.loads(text)
    found = cast("dict[str, Any]", value) if isinstance(value, dict) else {}
    if status is None and not (is_error or found.get("error") or found.get("object") == "error"):
        return None
    log_refusal(text, key)
    found = found["error"] if isinstance(found.get("error"), dict) else found
    told = {name: each for name in ("type", "param", "code") if _CODE.fullmatch(str((each := found.get(name)) or ""))}
    how = "broke off its reply" if status is None else f"answered with status {status}"
    message = f"The server of the multimodal LLM {how} (COW_LOG_LEVEL=debug logs its own words)."
    code = None if status is None else str(status)
    return {"error": {"message": message, "type": "upstream_error", "param": None, "code": code} | told}
