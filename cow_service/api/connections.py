"""HTTP connections that cannot lock anybody out: none waits for a request for long, and idle ones give way."""

from __future__ import annotations

import asyncio
import sys
from typing import ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_SECONDS = 20.0  # for a request's line and headers, from the connection or the first byte behind a response
MAX_CONNECTIONS = 10_000
RESERVED_FILES = 256  # of what the system lets this process open: for databases, artifacts and other servers


class Connection(H11Protocol):
    """uvicorn's HTTP/1.1 connection. It is closed where no request comes in time.

    Where there are more than `most`, one that has never sent any is closed for the next, the oldest first.
    """

    most: ClassVar[int] = MAX_CONNECTIONS
    _timer: asyncio.TimerHandle | None = None

    @property
    def waits(self) -> bool:
        """Whether there is no request that is being received or answered."""
        return self.cycle is None or self.cycle.response_complete  # pyright: ignore[reportUnnecessaryComparison]

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begins to wait for a request."""
        super().connection_made(transport)
        self._start_timer()
        if len(self.connections) > self.most:
            idle = [each for each in self.connections if isinstance(each, Connection) and each.waits]
            min(idle, key=lambda each: each.priority).close()

    def data_received(self, data: bytes) -> None:
        """Goes on to wait where the headers are not all there."""
        super().data_received(data)
        if self.waits:
            self._start_timer()
        else:
            self._stop_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Waits no more."""
        self._stop_timer()
        super().connection_lost(exc)

    @property
    def priority(self) -> tuple[bool, float]:
        """Which of two waiting ones stays, the larger: one that had a request before, then the one that came later."""
        timer = self._timer or self.timeout_keep_alive_task
        return bool(self.cycle), 0.0 if timer is None else timer.when()

    def close(self) -> None:
        """Closes the connection unless it has a request by now."""
        self._timer = None
        if self.waits and not self.transport.is_closing():
            self.transport.close()

    def _start_timer(self) -> None:
        if self._timer is None:  # slow bytes give no new time
            self._timer = self.loop.call_later(REQUEST_SECONDS, self.close)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def allow_connections() -> None:
    """Raises the number of files that this process may open as far as the system lets it, and fits `most` to it."""
    if sys.platform == "win32":
        return  # it has no such limit on connections
    import resource  # noqa: PLC0415 # of Unix

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_CONNECTIONS + RESERVED_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        Connection.most = max(soft // 2, min(MAX_CONNECTIONS, soft - RESERVED_FILES))
