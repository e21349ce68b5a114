"""`AsyncClient`: the same calls as `Client`, to be awaited."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Coroutine
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from cow_service.client.base import BaseClient
from cow_service.client.http_library import import_httpx

if TYPE_CHECKING:
    import httpx

    from cow_service.client.batches import Outcome
    from cow_service.client.handles import AsyncJobHandle
    from cow_service.client.models import Models
    from cow_service.client.results import AsyncAnswer, AsyncSimulation
    from cow_service.records import Workers

    _Base = BaseClient[
        httpx.AsyncClient,
        Coroutine[Any, Any, AsyncSimulation],
        Coroutine[Any, Any, AsyncAnswer],
        Coroutine[Any, Any, AsyncJobHandle[AsyncSimulation]],
        Coroutine[Any, Any, AsyncJobHandle[AsyncAnswer]],
        Coroutine[Any, Any, AsyncJobHandle[AsyncSimulation | AsyncAnswer]],
        AsyncIterator[AsyncJobHandle[AsyncSimulation | AsyncAnswer]],
        AsyncGenerator[Outcome[AsyncSimulation]],
        AsyncGenerator[Outcome[AsyncAnswer]],
        Coroutine[Any, Any, bytes],
        Coroutine[Any, Any, Models],
        Coroutine[Any, Any, Workers],
        Coroutine[Any, Any, None],
    ]
else:
    _Base = BaseClient


class AsyncClient(_Base):
    """A COW server.

    `base_url` and `api_key` come from COW_BASE_URL and COW_API_KEY where they are not given; without either the server
    is http://127.0.0.1:8000. `timeout` is how long the server may say nothing, in seconds; how long a job may take is
    said where one waits for it. `retries` is how often a call is sent again that may then succeed. `http_client` brings
    proxies, certificates, transports; it is not closed here. For one event loop.

    >>> async def ask(question):
    ...     async with AsyncClient(base_url) as client:
    ...         return (await client.answer("image.jpg", question)).option
    >>> asyncio.run(ask("If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"))
    'No'
    """

    def _connect(self, *arguments: Any) -> Any:
        import_httpx()
        from cow_service.client.async_connection import AsyncConnection  # noqa: PLC0415 - see `Client`

        return AsyncConnection(*arguments)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
