"""Forwards chats to the OpenAI-compatible server behind a model, and its replies back, once and unchanged."""

import asyncio
import json
from collections.abc import AsyncGenerator, Generator
from contextlib import AsyncExitStack, aclosing, asynccontextmanager, contextmanager, suppress
from http import HTTPStatus
from typing import Any, TypeAlias, cast

import httpx
from httpx_sse import EventSource
from sse_starlette import ServerSentEvent

from cow_service import __version__
from cow_service.adaptive import BUSY, AdaptivePlaces
from cow_service.api.openai.chats import as_json, wrong
from cow_service.client.protocol import retry_after
from cow_service.errors import MllmBadReply, MllmUnavailable, shortened
from cow_service.readers.chat import ChatTurn, Upstream
from cow_service.settings import Settings

CONNECT_SECONDS = 10.0
MAX_ERROR_CHARACTERS = 2000  # of a server's own words
PASSED_HEADERS = ("retry-after", "retry-after-ms", "x-should-retry")
PASSED_PREFIX = "x-ratelimit-"
# These say that this server's own key, or address, is wrong: nothing that a caller could mend.
NOT_THE_CALLERS = (HTTPStatus.UNAUTHORIZED, HTTPStatus.PROXY_AUTHENTICATION_REQUIRED)
DONE = "[DONE]"  # the data of a stream's last event

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
            self._client = httpx.AsyncClient(
                timeout=httpx.Timeout(self._timeout, connect=CONNECT_SECONDS, pool=None),
                limits=httpx.Limits(max_connections=None, max_keepalive_connections=self._places.limit.most),
                headers={"User-Agent": f"cow-service/{__version__}"},
            )
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
                    response = await client.send(request, stream=True)
            except MllmUnavailable:
                call.refuse()
                raise
            stack.push_async_callback(response.aclose)
            if response.status_code in BUSY:
                seconds = retry_after(response)
                call.refuse(seconds if (seconds or 0.0) < self._budget else None)  # else no other chat could be sent
            call.succeeded = response.is_success
            is_stream = response.headers.get("content-type", "").startswith("text/event-stream")
            if response.status_code == HTTPStatus.OK and is_stream:
                yield _events(response)
            else:
                with _translated():
                    await response.aread()
                yield _whole(response, upstream)


@contextmanager
def _translated() -> Generator[None]:
    """Translates the errors of a connection, in words without addresses."""
    try:
        yield
    except httpx.HTTPError as error:
        if isinstance(error, httpx.TimeoutException):
            reason = "it did not reply in time (COW_MLLM_TIMEOUT)"
        elif isinstance(error, httpx.ConnectError):
            reason = "it could not be reached; check that it runs, and COW_MLLM_BASE_URL"
        else:
            reason = "it broke off before its reply was whole"
        detail = f"The server of the multimodal LLM gave no reply: {reason}. It was asked once."
        raise MllmUnavailable(detail) from error


async def _events(response: httpx.Response) -> Events:
    """The events of a stream. Raises `MllmUnavailable` if it ends early."""
    ended = False
    with _translated():
        async with aclosing(EventSource(response).aiter_sse()) as events:
            async for event in events:
                ended = ended or event.data.strip() == DONE
                name = None if event.event == "message" else event.event  # that of an event without one
                yield ServerSentEvent(event.data, event=name, sep="\n")
    if not ended:
        raise MllmUnavailable("The server of the multimodal LLM ended its stream before the reply was whole ([DONE]).")


def _whole(response: httpx.Response, upstream: Upstream) -> ChatTurn:
    """A reply, or what the server says went wrong, in OpenAI's form. Raises `MllmBadReply`, `MllmUnavailable`."""
    status = response.status_code
    text, value = response.content.decode("utf-8", errors="replace"), None
    with suppress(ValueError, RecursionError):
        value = json.loads(text)
    if status == HTTPStatus.OK:
        if not isinstance(value, dict):
            raise MllmBadReply("The server of the multimodal LLM replied with something other than a JSON object.")
        return ChatTurn(cast("dict[str, Any]", value))
    if status in NOT_THE_CALLERS or status < HTTPStatus.BAD_REQUEST:
        raise MllmUnavailable(
            f"The server of the multimodal LLM answered with status {status}: its address or this server's own key for "
            "it is wrong (COW_MLLM_BASE_URL, COW_MLLM_API_KEY)."
        )
    headers = {
        name: value
        for name, value in response.headers.items()
        if name in PASSED_HEADERS or name.startswith(PASSED_PREFIX)
    }
    error = cast("dict[str, Any]", value) if isinstance(value, dict) else {}
    if not isinstance(error.get("error"), dict):  # else it is in OpenAI's form already
        plain = text.strip() if response.headers.get("content-type", "").startswith("text/plain") else ""
        said = error.get("message") or error.get("error") or error.get("detail") or plain
        message = shortened(said if isinstance(said, str) else as_json(said), MAX_ERROR_CHARACTERS)
        error = {
            "error": {
                "message": message or f"The server of the multimodal LLM answered with status {status}.",
                "type": error.get("type", "upstream_error"),
                "param": error.get("param"),
                "code": error.get("code", str(status)),
            }
        }
    return ChatTurn(_without(error, upstream.key) if upstream.key else error, status, headers=headers)


def _without(value: Any, key: str) -> Any:
    """A JSON value in which this server's own key does not stand."""
    if isinstance(value, dict):
        return {name: _without(held, key) for name, held in cast("dict[str, Any]", value).items()}
    if isinstance(value, list):
        return [_without(held, key) for held in cast("list[Any]", value)]
    return value.replace(key, "***") if isinstance(value, str) else value
