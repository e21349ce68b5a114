"""What tests of the SDK share: both clients called in the same way, and a server with scripted answers."""

from __future__ import annotations

import asyncio
import inspect
import json
import socketserver
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import httpx
import pytest

from cow_service.client import (
    AsyncAnswer,
    AsyncClient,
    AsyncJobHandle,
    AsyncSimulation,
    Client,
    async_io,
    sync_io,
)

Kind = Literal["sync", "async"]
KINDS: tuple[Kind, ...] = ("sync", "async")


class Blocking:
    """An object of `AsyncClient`'s world, called as one of `Client`'s."""

    def __init__(self, inner: Any, runner: asyncio.Runner) -> None:
        self._inner, self._runner = inner, runner

    def __repr__(self) -> str:
        return repr(self._inner)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._inner, name)
        if not inspect.ismethod(value):
            return self._plain(value)
        return lambda *args, **named: self._plain(value(*args, **named))

    def _plain(self, value: Any) -> Any:
        if inspect.iscoroutine(value):
            value = self._runner.run(value)
        if isinstance(value, AsyncIterator):
            return self._each(value)
        ours = isinstance(value, AsyncJobHandle | AsyncSimulation | AsyncAnswer)
        return Blocking(value, self._runner) if ours else value

    def _each(self, values: Any) -> Iterator[Any]:
        try:
            while True:
                try:
                    value = self._runner.run(_next(values))
                except StopAsyncIteration:
                    return
                yield self._plain(value)
        finally:
            self._runner.run(values.aclose())


async def _next(values: AsyncIterator[Any]) -> Any:
    return await anext(values)


class Connect:
    """Makes clients of one kind, and closes them at the end. They share one HTTP client: each takes long to make."""

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        self.slept: list[float] = []
        self._runner = asyncio.Runner() if kind == "async" else None
        self._made: list[Any] = []
        self._shared = self.http()

    def __call__(self, base_url: str | None = None, **named: Any) -> Any:
        """A client, and what it returns, without `await`. With `http_client=None` it makes its own, as it does else."""
        named.setdefault("http_client", self._shared)
        if self._runner is None:
            client: Any = Client(base_url, **named)
        else:
            client = Blocking(AsyncClient(base_url, **named), self._runner)
        self._made.append(client)
        return client

    def http(self, **named: Any) -> Any:
        """An HTTP client of the kind that these clients take."""
        http = httpx.Client(**named) if self.kind == "sync" else httpx.AsyncClient(**named)
        self._made.append(http if self._runner is None else Blocking(_Closing(http), self._runner))
        return http

    def seen(self) -> tuple[Any, list[str]]:
        """An HTTP client, and the list in which it writes down every request: method and path."""
        told: list[str] = []

        def write(request: httpx.Request) -> None:
            told.append(f"{request.method} {request.url.path}")

        async def write_async(request: httpx.Request) -> None:
            write(request)

        return self.http(event_hooks={"request": [write if self.kind == "sync" else write_async]}), told

    def close(self) -> None:
        """Closes all that was made here."""
        for made in reversed(self._made):
            made.close()
        if self._runner is not None:
            self._runner.close()


@dataclass
class _Closing:
    http: Any

    async def close(self) -> None:
        await self.http.aclose()


@pytest.fixture(params=KINDS, scope="module")
def connect(request: pytest.FixtureRequest) -> Iterator[Connect]:
    """Makes clients of either kind: every test with it says the same of both."""
    one = Connect(request.param)
    yield one
    one.close()


class Hurried:
    """A clock module whose sleeps return at once and are recorded."""

    def __init__(self, module: Any, slept: list[float]) -> None:
        self._module, self._slept = module, slept

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    def sleep(self, seconds: float) -> Any:
        self._slept.append(seconds)
        return asyncio.sleep(0) if self._module is asyncio else None


@pytest.fixture
def hurried(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> Connect:
    """The same, and no client sleeps: `slept` has what each pause would have been."""
    connect.slept.clear()
    monkeypatch.setattr(sync_io, "time", Hurried(sync_io.time, connect.slept))
    monkeypatch.setattr(async_io, "asyncio", Hurried(asyncio, connect.slept))
    return connect


@dataclass(frozen=True)
class Asked:
    """A request that came."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes

    @property
    def line(self) -> str:
        return f"{self.method} {self.path}"


@dataclass(frozen=True)
class Reply:
    """A response; `cut` leaves out that many bytes at its end, and the connection breaks there."""

    status: int = 200
    body: Any = None
    headers: dict[str, str] = field(default_factory=dict)
    cut: int = 0

    def wire(self) -> bytes:
        plain = self.body if isinstance(self.body, bytes) else json.dumps(self.body).encode()
        headers = {"content-type": "application/json", "content-length": str(len(plain)), **self.headers}
        head = "".join(f"{name}: {value}\r\n" for name, value in headers.items() if value)
        whole = f"HTTP/1.1 {self.status} Told\r\n{head}connection: close\r\n\r\n".encode() + plain
        return whole[: len(whole) - self.cut]


BROKEN = Reply(cut=10**9)  # nothing at all comes back


def told(code: str, status: int, detail: str = "It is so.", **more: Any) -> Reply:
    """A problem of COW's."""
    headers = {"content-type": "application/problem+json", **more.pop("headers", {})}
    body = {"type": f"urn:cow:problem:{code}", "title": "T", "status": status, "detail": detail, "errors": [], **more}
    return Reply(status, body, headers)


def stream(*blocks: str, cut: bool = False) -> Reply:
    """A stream of events; with `cut` it breaks instead of ending."""
    text = "".join(f"{block}\n\n" for block in blocks).encode()
    headers = {"content-type": "text/event-stream", "content-length": str(len(text) + 1) if cut else ""}
    return Reply(200, text, headers)


def event(name: str, number: int | None, job: dict[str, Any] | None) -> str:
    """One event as it is sent."""
    head = "" if number is None else f"id: {number}\n"
    return f"{head}event: {name}\ndata: {json.dumps(job or {})}"


JOB: dict[str, Any] = {
    "id": "j-1",
    "kind": "simulate",
    "status": "running",
    "stage": "motion",
    "progress": 0.25,
    "created_at": "2026-01-01T00:00:00Z",
    "generator": "cutout",
}


class Scripted:
    """A real server on a real socket, which answers each request with the next reply, and the last for ever."""

    def __init__(self, *replies: Reply | Callable[[Asked], Reply]) -> None:
        self.asked: list[Asked] = []
        self._replies = list(replies)
        guard = threading.Lock()

        class Handler(socketserver.StreamRequestHandler):
            def handle(handler) -> None:
                method, path, _ = handler.rfile.readline().decode().split(" ", 2)
                headers = {}
                while line := handler.rfile.readline().strip().decode("latin-1"):
                    name, _, value = line.partition(":")
                    headers[name.lower()] = value.strip()
                body = handler.rfile.read(int(headers.get("content-length", 0)))
                with guard:
                    asked = Asked(method, path, headers, body)
                    self.asked.append(asked)
                    reply = self._replies.pop(0) if len(self._replies) > 1 else self._replies[0]
                handler.wfile.write((reply(asked) if callable(reply) else reply).wire())

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address = True
            daemon_threads = True

        self._server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    @property
    def lines(self) -> list[str]:
        return [asked.line for asked in self.asked]

    def __enter__(self) -> Scripted:
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.005})
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


DIGEST = "0" * 64
SIMULATION: dict[str, Any] = {
    "id": "j-1",
    "created_at": "2026-01-01T00:00:00Z",
    "question": "What happens?",
    "image": {"width": 64, "height": 48, "sha256": DIGEST},
    "grounding": {"object": "red ball", "point": [10, 10], "bbox": [5, 5, 15, 15], "source": "embedded"},
    "motion": {
        "kind": "linear",
        "direction": [1, 0],
        "cue": "text",
        "speed": 10,
        "metres_per_pixel": {"value": 0.01, "source": "default"},
        "sentence": "The red ball moves to the right.",
        "source": "embedded",
    },
    "trajectory": {
        "fps": 16,
        "states": [[0, 0, 1, 1, 0, 0], [1, 0, 1, 1, 0, 0]],
        "points": [[10, 10], [11, 10]],
        "visible": [True, True],
        "scale": [1, 1],
        "tracks": [[[10, 10], [11, 10]]],
        "anchors": [[1, 1]],
        "encounters": [{"object": "blue mug", "bbox": [20, 5, 30, 15], "first_frame": 1, "kind": "touches"}],
    },
    "frames": [{"index": 1, "time": 0.06, "url": f"/artifacts/{DIGEST}", "sha256": DIGEST, "width": 64, "height": 48}],
    "video": None,
    "overlay": {"sha256": DIGEST, "url": f"/artifacts/{DIGEST}", "media_type": "image/png", "size": 9},
    "generator": {"name": "cutout", "seed": 0},
    "reader": {"name": "embedded"},
    "timings": {"grounding": 0.1},
}
DONE: dict[str, Any] = {**JOB, "status": "succeeded", "stage": None, "progress": 1, "result": SIMULATION}
