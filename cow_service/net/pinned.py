"""Connections to addresses that were checked, on which everything ends with one clock."""

from __future__ import annotations

import socket
import ssl
from time import monotonic
from typing import Any

import httpcore


class Clock:
    """What is left of the time for an exchange."""

    def __init__(self, seconds: float) -> None:
        self._end = monotonic() + seconds

    def left(self) -> float:
        """Seconds, more than none. Raises `TimeoutError` after the end."""
        left = self._end - monotonic()
        if left <= 0:
            raise TimeoutError("the time for this exchange is over")
        return left


class Pinned(httpcore.NetworkBackend):
    """Connects to addresses that were checked, whatever the name."""

    def __init__(self, addresses: list[str], clock: Clock, seconds: float) -> None:
        self._addresses = addresses
        self._clock = clock
        self._seconds = seconds

    def connect_tcp(self, host: str, port: int, *_: Any, **__: Any) -> httpcore.NetworkStream:
        """A connection to the first address that takes one. Raises `OSError`."""
        failed: OSError = OSError("no address")
        for address in self._addresses:
            try:
                line = socket.create_connection((address, port), min(self._seconds, self._clock.left()))
            except OSError as error:  # the last one is raised
                failed = error
            else:
                line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                return _Line(line, self._clock)
        raise failed


class _Line(httpcore.NetworkStream):
    """A connection on which everything ends with the clock. Raises `OSError`."""

    def __init__(self, line: socket.socket, clock: Clock) -> None:
        self._line = line
        self._clock = clock

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        self._line.settimeout(self._clock.left())
        return self._line.recv(max_bytes)

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        rest = memoryview(buffer)
        while rest:  # not sendall, which with TLS begins its time limit anew for every piece
            self._line.settimeout(self._clock.left())
            rest = rest[self._line.send(rest) :]

    def close(self) -> None:
        self._line.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        """The same connection with TLS, for the name in the URL. Raises `OSError`."""
        try:
            self._line.settimeout(self._clock.left())
            return _Line(ssl_context.wrap_socket(self._line, server_hostname=server_hostname), self._clock)
        except BaseException:
            self._line.close()
            raise
