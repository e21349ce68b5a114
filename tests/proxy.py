"""A network between two processes: a TCP proxy that passes bytes on, holds them, or cuts the connections."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress


class Proxy:
    """Listens on a port of its own for a server on this machine. Its methods may be called from any thread."""

    def __init__(self, port: int) -> None:
        self._target = port
        self.started = threading.Event()
        self._passing = asyncio.Event()
        self._writers: set[asyncio.StreamWriter] = set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]

    def hold(self) -> None:
        """Loses every byte from now on, and says nothing: neither side learns of it."""
        self._loop.call_soon_threadsafe(self._passing.clear)

    def restore(self) -> None:
        """Passes bytes on again. What was held before arrives now."""
        self._loop.call_soon_threadsafe(self._passing.set)

    def cut(self) -> None:
        """Ends all connections with a reset."""

        def abort() -> None:
            for writer in self._writers:
                writer.transport.abort()

        self._loop.call_soon_threadsafe(abort)

    def stop(self) -> None:
        """Ends it."""
        self._loop.call_soon_threadsafe(self._stopping.set)

    async def serve(self) -> None:
        """Listens until it is stopped."""
        self._loop, self._stopping = asyncio.get_running_loop(), asyncio.Event()
        self._passing.set()
        await asyncio.start_server(self._connected, sock=self._listener)
        self.started.set()
        await self._stopping.wait()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self._passing.wait()
        there, back = await asyncio.open_connection("127.0.0.1", self._target)
        self._writers |= {writer, back}
        with suppress(ConnectionError):
            async with asyncio.TaskGroup() as both:
                both.create_task(self._pass(reader, back))
                both.create_task(self._pass(there, writer))

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                await self._passing.wait()
                writer.write(data)
                await writer.drain()
        finally:
            writer.transport.abort()
            self._writers.discard(writer)


@contextmanager
def proxy(port: int) -> Iterator[Proxy]:
    """A proxy before a port of this machine."""
    between = Proxy(port)
    thread = threading.Thread(target=asyncio.run, args=(between.serve(),), daemon=True)
    thread.start()
    between.started.wait()
    try:
        yield between
    finally:
        between.stop()
        thread.join()
