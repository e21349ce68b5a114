"""A network between two processes: a TCP proxy that passes bytes on, holds them, or cuts the connections."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from typing import Self


class Proxy:
    """Listens on a port of its own before a port of this machine, until the end of the `with` block."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._requests, self._replies = threading.Event(), threading.Event()  # whether their bytes are passed on
        self.restore()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._sockets: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept)]

    def hold(self, *, requests: bool = True) -> None:
        """Passes no byte on from now on, or none of the replies, and says nothing: neither side learns of it."""
        self._replies.clear()
        if requests:
            self._requests.clear()

    def restore(self) -> None:
        """Passes bytes on again. What was held before arrives now."""
        self._requests.set()
        self._replies.set()

    def cut(self) -> None:
        """Ends all connections. What is held is lost."""
        for one in self._sockets:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> Self:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self.restore()
        self.cut()
        for thread in self._threads:
            thread.join()
        for one in (self._listener, *self._sockets):
            one.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                caller, _ = self._listener.accept()
                try:
                    server = socket.create_connection(("127.0.0.1", self._target))
                except ConnectionRefusedError:
                    caller.close()
                    continue
                self._sockets += [caller, server]
                for way in ((caller, server, self._requests), (server, caller, self._replies)):
                    self._threads.append(threading.Thread(target=self._pass, args=way))
                    self._threads[-1].start()

    def _pass(self, source: socket.socket, target: socket.socket, passing: threading.Event) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                passing.wait()
                target.sendall(data)
        passing.wait()
        for one in (source, target):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
