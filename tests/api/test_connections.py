"""Connections of a real server: those that say nothing are closed, and neither they nor bodies lock anybody out."""

from __future__ import annotations

import json
import resource
import select
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from servers import BODY, Served
from waiting import eventually

pytestmark = pytest.mark.slow

SECONDS = 2.0  # instead of REQUEST_SECONDS
FILES = 1024  # that the server may have open
SERVE = f"""
import resource
resource.setrlimit(resource.RLIMIT_NOFILE, ({FILES}, {FILES}))
from cow_service import server
server.REQUEST_SECONDS = {SECONDS}
from cow_service.cli.main import app
app(["serve"])
"""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with Served(tmp_path_factory.mktemp("connections"), SERVE, COW_MAX_BODY_MB="1", COW_MAX_BODIES_MB="2") as one:
        yield one


def opened(served: Served, stack: ExitStack) -> socket.socket:
    url = served.http.base_url
    return stack.enter_context(socket.create_connection((url.host, url.port), timeout=15))


@pytest.mark.parametrize(
    "sent", [b"", b"GET /livez HTTP/1.1\r\nHost: x\r\n", b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\nG"]
)
def test_a_connection_without_a_whole_request_is_closed(served: Served, sent: bytes) -> None:
    with ExitStack() as stack:
        one = opened(served, stack)
        one.sendall(sent)
        until = time.monotonic() + 10
        one.settimeout(0.3)
        while True:
            try:
                if not one.recv(65536):
                    break
            except TimeoutError:
                assert time.monotonic() < until
                if sent:
                    one.send(b"x")  # slow bytes give no new time
            except OSError:
                break


def test_more_idle_connections_than_files_lock_nobody_out(served: Served) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, 2 * FILES + 100)), hard))
    with ExitStack() as stack:
        for _ in range(2 * FILES):  # all at once
            one = stack.enter_context(socket.socket())
            one.setblocking(False)
            one.connect_ex(served.host_and_port)
        for _ in range(40):
            assert served.http.get("/livez", timeout=15).status_code == 200
    assert "Too many open files" not in served.log()


def test_headers_of_more_than_64_kb_are_refused(served: Served) -> None:
    with ExitStack() as stack:
        one = opened(served, stack)
        one.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\n" + b"X: " + b"a" * 70_000)
        assert b" 400 " in one.recv(65536).split(b"\r\n")[0]


def test_bodies_that_are_held_are_bounded(served: Served) -> None:
    def unfinished(stack: ExitStack) -> socket.socket:
        one = opened(served, stack)
        head = "POST /simulate HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 950000\r\n\r\n"
        one.sendall(head.encode() + b"[" + b" " * 900_000)
        return one

    padded = json.dumps(BODY).encode() + b" " * 800_000
    json_type = {"Content-Type": "application/json"}
    for _ in range(3):  # what was read is no longer counted
        assert served.http.post("/simulate", content=padded, headers=json_type).status_code == 200
    with ExitStack() as stack:
        held = [unfinished(stack) for _ in range(3)]
        (answered,), _, _ = select.select(held, [], [], 15)
        refused = b""
        while b"COW_MAX_BODIES_MB" not in refused:  # it may come in parts
            part = answered.recv(65536)
            assert part, refused
            refused += part
        assert b" 503 " in refused.split(b"\r\n")[0]
        assert served.http.post("/simulate", json=BODY).status_code == 200, "a small one fits beside the others"
    # As soon as the server has seen that the others are gone.
    eventually(lambda: served.http.post("/simulate", content=padded, headers=json_type).status_code == 200)
