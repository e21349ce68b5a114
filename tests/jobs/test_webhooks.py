"""Webhooks: signed as Standard Webhooks says, repeated until they succeed, and never sent to forbidden addresses."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import re
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from engines import app_for, end_engine, running_engine
from fastapi.testclient import TestClient
from servers import ASYNC, BODY, SLOW_GENERATOR, TERMINAL, events_of, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.errors import StorageUnavailable
from cow_service.jobs.schema import CALLS
from cow_service.jobs.webhooks import ATTEMPT_SECONDS
from cow_service.net import Egress
from cow_service.records import Job
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError, load_settings

pytestmark = pytest.mark.slow

SECRET = b"0123456789abcdef0123456789abcdef"
Counted = Callable[[], dict[str, float]]
LOST = {**BODY, "grounding": None, "motion": None, "question": "If the pink car turns, what happens?"}


@dataclass
class Message:
    """One call of a webhook, and what the server said of its job at that moment."""

    path: str
    headers: dict[str, str]
    body: bytes
    job: httpx.Response

    @property
    def told(self) -> dict[str, Any]:
        return json.loads(self.body)


@dataclass
class Receiver:
    """A caller's server. It answers the statuses one after the other, the last one for ever."""

    look: Callable[[str], httpx.Response]
    port: int = 0
    statuses: list[int] = field(default_factory=lambda: [204])
    heard: list[Message] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/hook?for=me"

    def hear(self, message: Message) -> int:
        self.heard.append(message)
        return self.statuses.pop(0) if len(self.statuses) > 1 else self.statuses[0]

    def until(self, count: int) -> list[Message]:
        """What it has heard, once that are so many messages."""
        eventually(lambda: len(self.heard) >= count)
        return self.heard


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """Of an app with a secret and the one before it, that may call this machine, and does not wait long."""
    from cow_service.jobs import ticker, webhooks

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SLOW_GENERATOR))
        patch.setattr(webhooks, "RETRY_SECONDS", (0, 0))
        patch.setattr(ticker, "TICK_SECONDS", 0.05)
        secret = " ".join(f"whsec_{base64.b64encode(each).decode()}" for each in (b"n" * 32, SECRET))
        app = app_for(Service(Settings(data_dir=tmp_path_factory.mktemp("hooks"), webhook_secret=secret)))
        calls().egress = Egress(None, permitted=lambda address: address == "127.0.0.1", seconds=TIME_LIMIT)
        yield TestClient(app)
        end_engine()


def calls() -> Any:
    """The webhooks of the app."""
    return running_engine().webhooks


@pytest.fixture
def receiver(http: TestClient) -> Iterator[Receiver]:
    one = Receiver(lambda job: http.get(f"/jobs/{job}"))

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            headers = {name.lower(): value for name, value in self.headers.items()}
            self.send_response(one.hear(Message(self.path, headers, body, one.look(json.loads(body)["data"]["id"]))))
            self.send_header("Location", one.url)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    one.port = server.server_address[1]
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield one
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def counted(http: TestClient) -> Counted:
    """What the metrics say of webhooks since the test began, by outcome; `s` counts those that were given up."""

    def read() -> Counter[str]:
        found = re.findall(r"^cow_webhook(\S*)_total(\S*) (\S+)$", http.get("/metrics").text, re.MULTILINE)
        return Counter({re.sub(r".*\"(.*)\"}", r"\1", labels) or name: float(value) for name, labels, value in found})

    before = read()
    return lambda: dict(read() - before)


def submitted(http: TestClient, body: dict[str, Any], **headers: str) -> str:
    response = http.post("/simulate", json=body, headers=ASYNC | headers)
    assert response.status_code == 202, response.text
    return response.json()["id"]


def waiting(job: str) -> tuple[int, float] | None:
    """Attempts to tell of a job's end, and the seconds until the next one; None where none follows."""
    query = sa.select(CALLS.c.attempts, CALLS.c.due).where(CALLS.c.job_id == job)
    rows = running_engine().database.read(query)
    return (rows[0].attempts, rows[0].due - time.time()) if rows else None


def done(http: TestClient, job: str) -> None:
    """The job has ended, and no call follows."""
    eventually(lambda: http.get(f"/jobs/{job}").json()["status"] in TERMINAL and waiting(job) is None)


def verify(message: Message) -> None:
    """As https://www.standardwebhooks.com says, symmetric."""
    headers = message.headers
    assert abs(int(headers["webhook-timestamp"]) - time.time()) < TIME_LIMIT
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + message.body
    wanted = base64.b64encode(hmac.digest(SECRET, signed, hashlib.sha256)).decode()
    signatures = headers["webhook-signature"].split(" ")
    assert len(signatures) == 2, "while one secret takes over from another, both sign"
    assert f"v1,{wanted}" in signatures


@pytest.mark.parametrize(("body", "status"), [(BODY, "succeeded"), (LOST, "failed")])
def test_an_end_is_told_once_and_signed(
    http: TestClient, receiver: Receiver, caplog: pytest.LogCaptureFixture, body: dict[str, Any], status: str
) -> None:
    job = submitted(http, {**body, "webhook": receiver.url})
    (message,) = receiver.until(1)
    verify(message)
    assert message.path == "/hook?for=me"
    assert message.headers["content-type"] == "application/json"
    assert message.headers["user-agent"].startswith("cow-service/")
    data = Job.model_validate(message.told["data"])
    assert message.told == {"type": f"job.{status}", "timestamp": data.finished_at, "data": message.told["data"]}
    assert (data.id, data.status, data.result) == (job, status, None)
    assert (data.problem is None) == (status == "succeeded")
    # A receiver that asks for the job gets it as it ended.
    assert message.job.json() | {"result": None} == message.told["data"]
    assert (message.job.json()["result"] is not None) == (status == "succeeded")
    done(http, job)
    assert len(receiver.heard) == 1
    assert "webhook" not in http.get(f"/jobs/{job}/request").json()["request"]
    stages = [e["data"]["stage"] for e in events_of(http.get(f"/jobs/{job}/events")) if e["event"] == "stage"]
    assert set(stages) <= {"grounding", "generation"}
    secret = base64.b64encode(SECRET).decode()
    assert secret not in caplog.text + str(message.headers) + message.body.decode() + message.job.text


def test_canceled_and_deleted_jobs_are_told_once_at_most(http: TestClient, receiver: Receiver) -> None:
    job = submitted(http, {**slow(100), "webhook": receiver.url})
    eventually(lambda: http.get(f"/jobs/{job}").json()["stage"] == "generation")
    for _ in range(3):
        assert http.post(f"/jobs/{job}/cancel").json()["status"] == "canceled"
    (message,) = receiver.until(1)
    verify(message)
    assert (message.told["type"], message.job.json()["status"]) == ("job.canceled", "canceled")
    done(http, job)
    assert http.delete(f"/jobs/{job}").status_code == 204
    at_once = submitted(http, {**slow(100), "webhook": receiver.url})
    assert http.delete(f"/jobs/{at_once}").status_code == 204
    last = http.post("/simulate", json={**BODY, "webhook": receiver.url}).json()["id"]  # by a caller who waits
    done(http, last)
    heard = Counter(one.told["data"]["id"] for one in receiver.heard)
    assert (heard[job], heard[last], heard[at_once] <= 1) == (1, 1, True)


def test_whoever_did_not_take_it_is_asked_again(http: TestClient, receiver: Receiver, counted: Counted) -> None:
    receiver.statuses = [300, 302, 200]
    key = {"Idempotency-Key": "hook"}
    body = {**BODY, "webhook": receiver.url}
    job = submitted(http, body, **key)
    done(http, job)
    for message in receiver.heard:
        verify(message)
    assert len(receiver.heard) == 3
    assert len({(one.body, one.headers["webhook-id"]) for one in receiver.heard}) == 1
    assert counted() == {"refused": 2, "delivered": 1}
    other = http.post("/simulate", json=body | {"webhook": receiver.url + "&more"}, headers=ASYNC | key)
    problem(other, 422, "idempotency-key-reused")
    http.delete(f"/jobs/{job}")
    assert submitted(http, body | {"seed": 1}, **key) == job
    done(http, job)


def test_it_is_given_up_in_the_end(http: TestClient, receiver: Receiver, counted: Counted) -> None:
    receiver.statuses = [500]
    for url in (receiver.url, "http://127.0.0.1:1/"):
        job = submitted(http, {**BODY, "webhook": url})
        done(http, job)
        assert http.get(f"/jobs/{job}").json()["status"] == "succeeded"
    assert len(receiver.heard) == 3
    assert counted() == {"refused": 3, "unreachable": 3, "s_given_up": 2}


def test_a_receiver_that_is_gone_is_left_alone_and_a_retry_waits_for_its_time(
    http: TestClient, receiver: Receiver, counted: Counted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cow_service.jobs.webhooks.RETRY_SECONDS", (1000,))
    receiver.statuses = [410, 500]
    done(http, submitted(http, {**BODY, "webhook": receiver.url}))
    assert counted() == {"gone": 1}
    job = submitted(http, {**BODY, "webhook": receiver.url})
    attempts, seconds = eventually(lambda: left if (left := waiting(job)) and left[1] > 200 else None)
    assert (attempts, len(receiver.heard)) == (1, 2)
    assert 800 - TIME_LIMIT <= seconds <= 1200
    http.delete(f"/jobs/{job}")
    assert waiting(job) is None


def test_silent_receivers_hold_up_their_own_calls_alone(http: TestClient, receiver: Receiver) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # connections are made, and never answered
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/"
        jobs = [submitted(http, {**BODY, "seed": seed, "webhook": url}) for seed in range(9)]

        def begun() -> int:
            return sum(left[0] for job in jobs if (left := waiting(job)) is not None)

        eventually(lambda: begun() == 2)
        submitted(http, {**BODY, "webhook": receiver.url})
        receiver.until(1)
        assert begun() == 2
        for job in jobs:
            assert http.delete(f"/jobs/{job}").status_code == 204


def test_what_is_never_called_is_refused_at_once(http: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table of all such addresses is that of `Egress`."""
    monkeypatch.setattr(calls(), "egress", Egress(None))
    before = http.get("/jobs", params={"limit": 500}).json()
    for url in ("http://127.0.0.1:1/", "https://user:password@example.org/", "example.org"):
        for headers in (ASYNC, {}):
            response = http.post("/simulate", json={**BODY, "webhook": url}, headers=headers)
            problem(response, 422, "webhook-not-allowed")
            assert ":password" not in response.text
    for webhook in ("", "x" * 2049, 7):
        told = problem(http.post("/simulate", json={**BODY, "webhook": webhook}), 422, "invalid-request")
        assert [error["pointer"] for error in told["errors"]] == ["/webhook"]
    assert http.get("/jobs", params={"limit": 500}).json() == before


def test_a_name_that_leads_inside_is_not_called(
    http: TestClient,
    receiver: Receiver,
    counted: Counted,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(calls(), "egress", Egress(None))
    done(http, submitted(http, {**BODY, "webhook": receiver.url.replace("127.0.0.1", "localhost")}))
    assert counted() == {"not-allowed": 1}, "nor is it tried again"
    assert not receiver.heard


def test_an_attempt_whose_process_ended_is_made_again_in_time(http: TestClient, receiver: Receiver) -> None:
    """Whoever begins one moves the time of the next before: that is all that a process leaves."""
    engine = running_engine()
    ended = http.post("/simulate", json=BODY).json()["id"]
    left = {"job_id": ended, "url": receiver.url, "receiver": "r", "attempts": 1}
    with engine.database.transaction() as connection:
        connection.execute(sa.insert(CALLS).values(**left, due=time.time() + 2))
    engine.webhooks.send_due()
    assert waiting(ended) is not None
    assert not receiver.heard
    verify(receiver.until(1)[0])
    done(http, ended)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/"
        job = submitted(http, {**BODY, "webhook": url})
        attempts, seconds = eventually(lambda: left if (left := waiting(job)) and left[0] else None)
        assert (attempts, seconds > ATTEMPT_SECONDS - TIME_LIMIT) == (1, True)
        http.delete(f"/jobs/{job}")


def test_a_disk_that_is_full_for_a_while_takes_no_places(
    http: TestClient, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    hooks, tries = calls(), list[int]()

    def fail(*_: object) -> bool:
        tries.append(1)
        raise StorageUnavailable("The disk is full.")

    with monkeypatch.context() as patch:
        patch.setattr(hooks, "change", fail)
        job = submitted(http, {**BODY, "webhook": receiver.url})
        eventually(lambda: len(tries) > 3)
        assert not receiver.heard
    verify(receiver.until(1)[0])
    done(http, job)


@pytest.mark.parametrize(
    "secret",
    ["plain", "whsec_", "whsec_!", "whsec_AAAAA=", "whsec_" + "A" * 28, " ".join(["whsec_" + "A" * 32] * 3)],
)
def test_a_secret_that_is_none_stops_the_start_and_is_not_repeated(
    monkeypatch: pytest.MonkeyPatch, secret: str
) -> None:
    monkeypatch.setenv("COW_WEBHOOK_SECRET", secret)
    with pytest.raises(SettingsError, match="COW_WEBHOOK_SECRET") as caught:
        load_settings()
    assert f"'{secret}'" not in str(caught.value)
