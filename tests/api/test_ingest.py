"""Taking requests: what is refused costs others nothing, no picture is decoded where requests are taken, and no key has
all the room for bodies and fetches."""

from __future__ import annotations

import hashlib
import json
import select
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from servers import ASYNC, BODY, QUESTION, Served, data_url, picture, problem
from waiting import eventually

from cow_service.api.middleware.access import hash_of, new_key
from cow_service.api.submission import MAX_CONCURRENT_FETCHES

pytestmark = pytest.mark.slow

KEYS = {name: new_key() for name in ("busy", "quiet")}
# A decoder that runs where requests are taken ends that process. Images may be fetched from this machine.
SERVE = """
import os
from PIL.ImageFile import ImageFile
from cow_service import net

ImageFile.load = lambda self: os._exit(9)
listed = net.Egress.__post_init__


def permit_all(self, allow):
    listed(self, allow)
    self.permitted = lambda ip: True


net.Egress.__post_init__ = permit_all
from cow_service.cli.main import app
app(["serve"])
"""
REST = {name: value for name, value in BODY.items() if name not in ("image", "question")}
FOREIGN_MASK = {"objects": [{"object": "x", "mask": "data:image/png;base64,/9j/4AAQSkZJRg=="}]}


class Site(ThreadingHTTPServer):
    """Serves pictures; those under /slow when `released` is set."""

    daemon_threads = True
    request_queue_size = 2 * MAX_CONCURRENT_FETCHES
    data = picture()

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.released = threading.Event()
        self.waiting = 0

    @property
    def host(self) -> str:
        return f"127.0.0.1:{self.server_port}"


class _Handler(BaseHTTPRequestHandler):
    server: Site

    def do_GET(self) -> None:
        if self.path == "/slow":
            self.server.waiting += 1
            self.server.released.wait(60)
        self.send_response(200)
        self.send_header("Content-Length", str(len(self.server.data)))
        self.end_headers()
        self.wfile.write(self.server.data)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    with Site() as one:
        threading.Thread(target=one.serve_forever, daemon=True).start()
        yield one
        one.released.set()
        one.shutdown()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, site: Site) -> Iterator[Served]:
    settings = {
        "COW_WORKERS": "true",
        "COW_API_KEYS": json.dumps({name: hash_of(key) for name, key in KEYS.items()}),
        "COW_ALLOW_IMAGE_URLS": json.dumps([site.host]),
        "COW_WEBHOOK_SECRET": "whsec_" + "a" * 32,
        "COW_MAX_BODY_MB": "1",
        "COW_MAX_BODIES_MB": "2",
    }
    with Served(tmp_path_factory.mktemp("ingest"), SERVE, **settings) as one:
        one.http.headers["Authorization"] = f"Bearer {KEYS['quiet']}"
        yield one


def kept(served: Served) -> set[str]:
    return {path.stem for path in (served.data / "artifacts").glob("??/*")}


@pytest.mark.parametrize(
    ("rest", "code"),
    [
        ({"seed": -5}, "invalid-request"),
        ({"reader": "nobody"}, "invalid-request"),
        ({"generator_options": {"nothing": 1}}, "invalid-request"),
        ({"webhook": "ftp://example.org/"}, "webhook-not-allowed"),
        (FOREIGN_MASK, "invalid-request"),
        ({"seed": 7}, "idempotency-key-reused"),
    ],
    ids=lambda value: value if isinstance(value, str) else next(iter(value)),
)
def test_nothing_of_a_refused_request_is_kept(served: Served, site: Site, rest: dict[str, Any], code: str) -> None:
    key = {"Idempotency-Key": "taken"}
    assert served.http.post("/simulate", json=BODY, headers=key).status_code == 200
    headers, before, asked = key if "seed" in rest and rest["seed"] > 0 else {}, kept(served), {**REST, **rest}
    site.data = picture(3)
    form = {"question": QUESTION, "request": json.dumps(asked)}
    problem(served.http.post("/simulate", data=form, files={"image": ("a", picture(1))}, headers=headers), 422, code)
    for path in ("/simulate", "/answer"):
        for image in (data_url(picture(2)), {"url": f"http://{site.host}/quick"}):
            body = {**asked, "image": image, "question": QUESTION}
            problem(served.http.post(path, json=body, headers=headers), 422, code)
    parts = [{"type": "text", "text": QUESTION}, {"type": "image_url", "image_url": {"url": data_url(picture(2))}}]
    chat = {"model": "cow/embedded", "messages": [{"role": "user", "content": parts}], "cow": asked}
    problem(served.http.post("/v1/chat/completions", json=chat, headers=headers), 422, code)
    assert kept(served) == before


def test_no_decoder_runs_where_requests_are_taken(served: Served) -> None:
    whole = picture(10)
    kept_as = hashlib.sha256(whole).hexdigest()
    assert served.http.post("/simulate", json={**BODY, "image": data_url(whole)}).json()["image"]["sha256"] == kept_as
    damaged = {**BODY, "image": data_url(whole[: len(whole) // 2])}
    problem(served.http.post("/simulate", json=damaged), 422, "image-unreadable")
    job = served.ended(served.http.post("/simulate", json=damaged, headers=ASYNC).json()["id"])
    assert (job["status"], job["problem"]["type"]) == ("failed", "urn:cow:problem:image-unreadable")
    headless = {**BODY, "image": data_url(whole[:20])}
    problem(served.http.post("/simulate", json=headless, headers=ASYNC), 422, "image-unreadable")


def sent(served: Served, stack: ExitStack, key: str, body: bytes, size: int) -> socket.socket:
    """A request with a part of its body."""
    one = stack.enter_context(socket.create_connection(served.host_and_port, timeout=30))
    head = f"POST /simulate HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {KEYS[key]}\r\nContent-Type: application/json"
    one.sendall(f"{head}\r\nContent-Length: {size}\r\n\r\n".encode() + body)
    return one


def test_the_bodies_of_one_key_leave_room_for_others(served: Served) -> None:
    unfinished = b"[" + b" " * 900_000
    with ExitStack() as stack:
        held = [sent(served, stack, "busy", unfinished, 950_000) for _ in range(2)]
        (refused,), _, _ = select.select(held, [], [], 30)
        assert b" 503 " in refused.recv(65536).split(b"\r\n")[0]
        padded = json.dumps(BODY).encode() + b" " * 900_000
        response = served.http.post("/simulate", content=padded, headers={"Content-Type": "application/json"})
        assert response.status_code == 200, response.text


def test_slow_image_urls_of_one_key_hold_up_no_other(served: Served, site: Site) -> None:
    site.data = picture(20)
    slow = json.dumps({**BODY, "image": {"url": f"http://{site.host}/slow"}}).encode()
    with ExitStack() as stack:
        stack.callback(site.released.set)
        waiting = [sent(served, stack, "busy", slow, len(slow)) for _ in range(MAX_CONCURRENT_FETCHES + 2)]
        eventually(lambda: site.waiting >= MAX_CONCURRENT_FETCHES * 3 // 4)
        quick = {**BODY, "image": {"url": f"http://{site.host}/quick"}}
        assert served.http.post("/simulate", json=quick).status_code == 200
        assert not select.select(waiting, [], [], 0)[0], "it did not wait for any of them"
