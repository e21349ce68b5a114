"""What tests of the SDK share: clients that are quickly made and never pause, and a server with scripted answers."""

from __future__ import annotations

import atexit
import json
import socketserver
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import httpx
import pytest
from servers import Served

from cow_service.client import Client
from cow_service.client.sync_io import BlockingIO


class Connect:
    """Makes clients. They share one HTTP client, which takes long to make."""

    def __init__(self, http: httpx.Client) -> None:
        self.slept: list[float] = []
        self.now = time.monotonic()
        self._http = http

    def __call__(self, base_url: str | None = None, **named: Any) -> Client:
        return Client(base_url, **{"http_client": self._http} | named)

    async def sleep(self, seconds: float) -> None:
        """Only remembers the pause, by which the clock goes on."""
        self.slept.append(seconds)
        self.now += seconds


_served: list[Served] = []


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Served:
    """A real server with the slow generator: one for all files that import this fixture."""
    if not _served:
        _served.append(Served(tmp_path_factory.mktemp("sdk"), COW_MAX_BODY_MB="3"))
        _served[0].start()
        atexit.register(_served[0].kill)
    return _served[0]


@pytest.fixture(scope="module")
def connect() -> Iterator[Connect]:
    with httpx.Client() as http:
        yield Connect(http)


@pytest.fixture
def address(served: Served) -> str:
    """Of the server with the slow generator."""
    return str(served.http.base_url).rstrip("/")


@pytest.fixture
def client(connect: Connect, address: str) -> Client:
    """Asks that server."""
    return connect(address)


@pytest.fixture
def hurried(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> Connect:
    """The same, and no client sleeps: `slept` has each pause, and `now` is the time on their clock."""
    connect.slept.clear()
    monkeypatch.setattr(BlockingIO, "sleep", lambda _, seconds: connect.sleep(seconds))
    monkeypatch.setattr(time, "monotonic", lambda: connect.now)
    return connect


@dataclass(frozen=True)
class Asked:
    """A request that came."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes


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
    **{"id": "j-1", "kind": "simulate", "generator": "cutout", "created_at": "2026-01-01T00:00:00Z"},
    **{"status": "running", "stage": "motion", "progress": 0.25},
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
        return [f"{asked.method} {asked.path}" for asked in self.asked]

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
