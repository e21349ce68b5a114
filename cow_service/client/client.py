"""`Client`: calls that block."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from cow_service.client.base import BaseClient
from cow_service.client.http_library import import_httpx

if TYPE_CHECKING:
    import httpx

    from cow_service.client.batches import Outcome
    from cow_service.client.handles import JobHandle
    from cow_service.client.models import Models
    from cow_service.client.results import Answer, Simulation
    from cow_service.records import Workers

    _Base = BaseClient[
        httpx.Client,
        Simulation,
        Answer,
        JobHandle[Simulation],
        JobHandle[Answer],
        JobHandle[Simulation | Answer],
        Iterator[JobHandle[Simulation | Answer]],
        Generator[Outcome[Simulation]],
        Generator[Outcome[Answer]],
        bytes,
        Models,
        Workers,
        None,
    ]
else:
    _Base = BaseClient


class Client(_Base):
    """A COW server.

    `base_url` and `api_key` come from COW_BASE_URL and COW_API_KEY where they are not given; without either the server
    is http://127.0.0.1:8000. `timeout` is how long the server may say nothing, in seconds; how long a job may take is
    said where one waits for it. `retries` is how often a call is sent again that may then succeed. `http_client` brings
    proxies, certificates, transports; it is not closed here. Safe to share between threads.

    >>> question = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
    >>> with Client(base_url) as client:
    ...     answer = client.answer("image.jpg", question)
    >>> answer.option
    'No'
    """

    def _connect(self, *arguments: Any) -> Any:
        import_httpx()
        from cow_service.client.connection import Connection  # noqa: PLC0415 - httpx and pydantic take 0.3 s to import

        return Connection(*arguments)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
