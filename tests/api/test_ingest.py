"""Taking requests: what is refused costs others nothing, no picture is decoded where requests are taken, and no key has
all the room for bodies and fetches. Connections that say nothing are closed, and lock nobody out."""

from __future__ import annotations

import hashlib
import json
import resource
import select
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from servers import ASYNC, BODY, QUESTION, Served, data_url, picture, problem
from waiting import TIME_LIMIT, eventually

from cow_service.api.middleware.access import hash_of, new_key
from cow_service.api.submission import MAX_CONCURRENT_FETCHES

pytestmark = pytest.mark.slow

KEYS = {name: new_key() for name in ("busy", "quiet")}
FILES = 1024  # that the server may have open
# A decoder that runs where requests are taken ends that process. Images may be fetched from this machine. The headers
# of a request must be there after 2 s.
SERVE = f"""
import os
import resource
from PIL.ImageFile import ImageFile
from cow_service import net, server

resource.setrlimit(resource.RLIMIT_NOFILE, ({FILES}, {FILES}))
server.REQUEST_SECONDS = 2.0
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
            self.server.released.wait(TIME_LIMIT)
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
    one = stack.enter_context(socket.create_connection(served.host_and_port, timeout=TIME_LIMIT))
    head = f"POST /simulate HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {KEYS[key]}\r\nContent-Type: application/json"
    one.sendall(f"{head}\r\nContent-Length: {size}\r\n\r\n".encode() + body)
    return one


def test_the_bodies_of_one_key_leave_room_for_others(served: Served) -> None:
    unfinished = b"[" + b" " * 900_000
    with ExitStack() as stack:
        held = [sent(served, stack, "busy", unfinished, 950_000) for _ in range(2)]
        (refused,), _, _ = select.select(held, [], [], TIME_LIMIT)
        assert b" 503 " in refused.recv(65536).split(b"\r\n")[0]
        padded = json.dumps(BODY).encode() + b" " * 900_000
        for key in ("quiet", "quiet"):  # what was read is no longer counted
            assert submitted(served, key, padded) == 200
        assert submitted(served, "busy", json.dumps(BODY).encode()) == 200, "a small one fits beside the other"
    # As soon as the server has seen that the others are gone.
    eventually(lambda: submitted(served, "busy", padded) == 200)


def submitted(served: Served, key: str, body: bytes) -> int:
    headers = {"Content-Type": "application/json", "Authorization": f"Bearer {KEYS[key]}"}
    return served.http.post("/simulate", content=body, headers=headers).status_code


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


# --- connections ---


@pytest.mark.parametrize(
    "sent", [b"", b"GET /livez HTTP/1.1\r\nHost: x\r\n", b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\nG"]
)
def test_a_connection_without_a_whole_request_is_closed(served: Served, sent: bytes) -> None:
    with socket.create_connection(served.host_and_port, timeout=0.3) as one:
        one.sendall(sent)

        def is_closed() -> bool:
            try:
                return not one.recv(65536)
            except TimeoutError:
                if sent:
                    one.send(b"x")  # slow bytes give no new time
            except OSError:
                return True
            return False

        eventually(is_closed)


def test_more_idle_connections_than_files_lock_nobody_out(served: Served) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, 2 * FILES + 100)), hard))
    with ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(2 * FILES):  # all at once
            one = stack.enter_context(socket.socket())
            one.setblocking(False)
            one.connect_ex(served.host_and_port)
        for _ in range(40):
            assert served.http.get("/livez").status_code == 200
    assert "Too many open files" not in served.log()


def test_headers_of_more_than_64_kb_are_refused(served: Served) -> None:
    with socket.create_connection(served.host_and_port, timeout=TIME_LIMIT) as one:
        one.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\n" + b"X: " + b"a" * 70_000)
        assert b" 400 " in one.recv(65536).split(b"\r\n")[0]
