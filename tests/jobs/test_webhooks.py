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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import engines
import httpx
import pytest
from dbos import DBOS
from engines import app_for
from fastapi import FastAPI
from fastapi.testclient import TestClient
from servers import ASYNC, BODY, SLOW_GENERATOR, events_of, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.jobs import webhooks
from cow_service.net import Egress
from cow_service.records import Job
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError, load_settings

pytestmark = pytest.mark.slow

SECRET = b"0123456789abcdef0123456789abcdef"
OUTCOMES = ("refused", "delivered")
LOST = {**BODY, "grounding": None, "motion": None, "question": "If the pink car turns, what happens?"}


@dataclass
class Message:
    """One call of a webhook, and what the server said of its job at that moment."""

    path: str
    headers: dict[str, str]
    body: bytes
    job: httpx.Response | None

    @property
    def told(self) -> dict[str, Any]:
        return json.loads(self.body)


@dataclass
class Receiver:
    """A caller's server. It answers the statuses one after the other, the last one for ever."""

    port: int = 0
    statuses: list[int] = field(default_factory=lambda: [204])
    heard: list[Message] = field(default_factory=list)
    look: Callable[[str], httpx.Response] | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/hook?for=me"

    def hear(self, message: Message) -> int:
        self.heard.append(message)
        return self.statuses.pop(0) if len(self.statuses) > 1 else self.statuses[0]


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    one = Receiver()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            headers = {name.lower(): value for name, value in self.headers.items()}
            job = one.look(json.loads(body)["data"]["id"]) if one.look else None
            self.send_response(one.hear(Message(self.path, headers, body, job)))
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
def app(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FastAPI]:
    """An app with a secret and the one before it, that may call this machine, and does not wait long."""
    monkeypatch.syspath_prepend(str(SLOW_GENERATOR))
    monkeypatch.setattr(webhooks, "RETRY_SECONDS", (0, 0))
    monkeypatch.setattr(webhooks, "POLL_SECONDS", 0.05)
    secret = " ".join(f"whsec_{base64.b64encode(each).decode()}" for each in (b"n" * 32, SECRET))
    service = Service(Settings(data_dir=tmp_path / "data", webhook_secret=secret))
    app = app_for(service)
    monkeypatch.setitem(
        vars(engines.webhooks()), "_egress", Egress(None, permitted=lambda address: address == "127.0.0.1")
    )
    yield app
    engines.use_webhooks(Settings(data_dir=tmp_path / "data"), service.metrics)


@pytest.fixture
def http(app: FastAPI, receiver: Receiver) -> TestClient:
    receiver.look = lambda job: TestClient(app).get(f"/jobs/{job}")
    return TestClient(app)


def submitted(http: TestClient, body: dict[str, Any], **headers: str) -> str:
    response = http.post("/simulate", json=body, headers=ASYNC | headers)
    assert response.status_code == 202, response.text
    return response.json()["id"]


def attempts(job: str) -> list[str]:
    """How the attempts to tell of a job's end have ended, as far as they were made."""
    found = [DBOS.get_workflow_status(name) for name in webhooks.attempt_ids(job)]
    return [one.status for one in found if one is not None]


def counted(http: TestClient) -> dict[str, float]:
    """What the metrics say of webhooks."""
    found = re.findall(r"^cow_(webhook\S*_total\S*) (\S+)$", http.get("/metrics").text, re.MULTILINE)
    return {name: float(value) for name, value in found}


def told_of(receiver: Receiver, count: int = 1) -> list[Message]:
    eventually(lambda: len(receiver.heard) >= count)
    return receiver.heard


def all_done(job: str) -> None:
    """Every attempt has been made, and no other follows."""
    eventually(lambda: set(attempts(job)) == {"SUCCESS"})


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
    http: TestClient, receiver: Receiver, body: dict[str, Any], status: str
) -> None:
    job = submitted(http, {**body, "webhook": receiver.url})
    (message,) = told_of(receiver)
    verify(message)
    assert message.path == "/hook?for=me"
    assert message.headers["content-type"] == "application/json"
    assert message.headers["webhook-id"]
    assert message.headers["user-agent"].startswith("cow-service/")
    told = message.told
    assert set(told) == {"type", "timestamp", "data"}
    assert told["type"] == f"job.{status}"
    assert told["timestamp"] == told["data"]["finished_at"]
    data = Job.model_validate(told["data"])
    assert (data.id, data.status, data.result) == (job, status, None)
    assert (data.problem is None) == (status == "succeeded")
    # A receiver that asks for the job gets it as it ended.
    assert message.job is not None
    asked = message.job.json()
    assert (asked["status"], asked["finished_at"], asked["problem"]) == (
        status,
        data.finished_at,
        told["data"]["problem"],
    )
    assert (asked["result"] is not None) == (status == "succeeded")
    all_done(job)
    assert attempts(job) == ["SUCCESS"]
    assert len(receiver.heard) == 1
    assert "webhook" not in http.get(f"/jobs/{job}/request").json()["request"]
    stages = [e["data"]["stage"] for e in events_of(http.get(f"/jobs/{job}/events")) if e["event"] == "stage"]
    assert set(stages) <= {"grounding", "motion", "trajectory", "generation"}


def test_a_caller_who_waits_has_a_webhook_too(http: TestClient, receiver: Receiver) -> None:
    response = http.post("/simulate", json={**BODY, "webhook": receiver.url})
    assert response.status_code == 200
    assert told_of(receiver)[0].told["data"]["id"] == response.json()["id"]


def test_a_canceled_job_is_told_once(http: TestClient, receiver: Receiver) -> None:
    job = submitted(http, {**slow(30), "webhook": receiver.url})
    eventually(lambda: http.get(f"/jobs/{job}").json()["stage"] == "generation")
    for _ in range(3):
        assert http.post(f"/jobs/{job}/cancel").json()["status"] == "canceled"
    (message,) = told_of(receiver)
    verify(message)
    assert message.told["type"] == "job.canceled"
    assert message.job is not None
    assert message.job.json()["status"] == "canceled"
    all_done(job)
    assert http.delete(f"/jobs/{job}").status_code == 204
    assert not attempts(job)  # nothing is left of them
    time.sleep(0.5)
    assert len(receiver.heard) == 1


def test_a_job_that_is_deleted_at_once_is_told_once_at_most(http: TestClient, receiver: Receiver) -> None:
    job = submitted(http, {**slow(30), "webhook": receiver.url})
    assert http.delete(f"/jobs/{job}").status_code == 204
    last = submitted(http, {**BODY, "webhook": receiver.url})
    eventually(lambda: last in [message.told["data"]["id"] for message in receiver.heard])
    assert [message.told["data"]["id"] for message in receiver.heard].count(job) <= 1


def test_a_key_that_comes_back_after_its_job_was_deleted_has_its_own_webhook(
    http: TestClient, receiver: Receiver
) -> None:
    key = {"Idempotency-Key": "hook"}
    job = submitted(http, {**BODY, "webhook": receiver.url}, **key)
    told_of(receiver)
    all_done(job)
    http.delete(f"/jobs/{job}")
    assert submitted(http, {**BODY, "webhook": receiver.url, "seed": 1}, **key) == job
    told_of(receiver, 2)
    all_done(job)
    assert len(receiver.heard) == 2
    other = {**BODY, "webhook": receiver.url + "&more", "seed": 1}
    problem(http.post("/simulate", json=other, headers=ASYNC | key), 422, "idempotency-key-reused")


@pytest.mark.slow
@pytest.mark.parametrize("status", [500, 503, 404, 400, 302, 429])
def test_whoever_did_not_take_it_is_asked_again(http: TestClient, receiver: Receiver, status: int) -> None:
    receiver.statuses = [status, 200]
    job = submitted(http, {**BODY, "webhook": receiver.url})
    first, second = told_of(receiver, 2)
    verify(first)
    verify(second)
    assert first.body == second.body
    assert first.headers["webhook-id"] == second.headers["webhook-id"]
    all_done(job)
    assert len(receiver.heard) == 2
    attempts_of = {outcome: counted(http)[f'webhook_attempts_total{{outcome="{outcome}"}}'] for outcome in OUTCOMES}
    assert attempts_of == {"refused": 1, "delivered": 1}


@pytest.mark.slow
def test_it_is_given_up_in_the_end(http: TestClient, receiver: Receiver) -> None:
    receiver.statuses = [500]
    job = submitted(http, {**BODY, "webhook": receiver.url})
    told_of(receiver, 3)
    all_done(job)
    assert attempts(job) == ["SUCCESS"] * 3
    assert len(receiver.heard) == 3
    assert http.get(f"/jobs/{job}").json()["status"] == "succeeded"
    assert counted(http) == {'webhook_attempts_total{outcome="refused"}': 3, "webhooks_given_up_total": 1}


@pytest.mark.slow
def test_nobody_there_is_no_end_either(http: TestClient, receiver: Receiver) -> None:
    job = submitted(http, {**BODY, "webhook": "http://127.0.0.1:1/"})
    eventually(lambda: len(attempts(job)) == 3)
    all_done(job)
    assert counted(http) == {'webhook_attempts_total{outcome="unreachable"}': 3, "webhooks_given_up_total": 1}


def test_silent_receivers_hold_up_their_own_calls_alone(http: TestClient, receiver: Receiver) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:  # connections are made, and never answered
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/"
        waiting = [submitted(http, {**BODY, "seed": seed, "webhook": url}) for seed in range(9)]
        connection, _ = silent.accept()
        submitted(http, {**BODY, "webhook": receiver.url})
        told_of(receiver)
        assert all(set(attempts(job)) <= {"ENQUEUED", "PENDING"} for job in waiting), "none has given up yet"
        connection.close()
        for job in waiting:
            assert http.delete(f"/jobs/{job}").status_code == 204


def test_a_receiver_that_is_gone_is_left_alone(http: TestClient, receiver: Receiver) -> None:
    receiver.statuses = [410]
    job = submitted(http, {**BODY, "webhook": receiver.url})
    told_of(receiver)
    all_done(job)
    assert attempts(job) == ["SUCCESS"]


@pytest.mark.parametrize(
    "url",
    [
        "http://127.0.0.1:1/",
        "http://10.0.0.1",
        "http://[::1]/",
        "http://169.254.169.254/latest/meta-data",
        "http://0x7f.1/",
        "https://user:password@example.org/",
        "ftp://example.org/",
        "//example.org",
        "example.org",
        "http://",
        "http://example.org:0/",
        "http://exa mple.org/",
        "javascript:alert(1)",
    ],
)
def test_addresses_that_are_never_called(
    app: FastAPI, http: TestClient, monkeypatch: pytest.MonkeyPatch, url: str
) -> None:
    monkeypatch.setitem(vars(engines.webhooks()), "_egress", Egress(None))
    before = len(http.get("/jobs", params={"limit": 500}).json()["jobs"])
    for headers in (ASYNC, {}):
        response = http.post("/simulate", json={**BODY, "webhook": url}, headers=headers)
        told = problem(response, 422, "webhook-not-allowed")
        assert "password" not in told["detail"] or "user name or a password" in told["detail"]
    assert len(http.get("/jobs", params={"limit": 500}).json()["jobs"]) == before


def test_a_name_that_leads_inside_is_not_called(
    http: TestClient, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(vars(engines.webhooks()), "_egress", Egress(None))
    job = submitted(http, {**BODY, "webhook": receiver.url.replace("127.0.0.1", "localhost")})
    eventually(lambda: attempts(job))
    all_done(job)
    assert attempts(job) == ["SUCCESS"]  # nor is it tried again
    assert not receiver.heard


@pytest.mark.parametrize("webhook", ["", "x" * 2049, 7, ["http://example.org"]])
def test_what_is_no_webhook_is_an_invalid_field(http: TestClient, webhook: object) -> None:
    told = problem(http.post("/simulate", json={**BODY, "webhook": webhook}), 422, "invalid-request")
    assert [error["pointer"] for error in told["errors"]] == ["/webhook"]


def test_a_server_without_a_secret_calls_none(tmp_path: Path, receiver: Receiver) -> None:
    http = TestClient(app_for(Service(Settings(data_dir=tmp_path / "data"))))
    told = problem(http.post("/simulate", json={**BODY, "webhook": receiver.url}), 422, "webhook-not-allowed")
    assert "COW_WEBHOOK_SECRET" in told["detail"]


def test_the_secret_is_told_nowhere(http: TestClient, receiver: Receiver, caplog: pytest.LogCaptureFixture) -> None:
    job = submitted(http, {**BODY, "webhook": receiver.url})
    message = told_of(receiver)[0]
    secret = base64.b64encode(SECRET).decode()
    assert secret not in caplog.text + str(message.headers) + message.body.decode() + http.get(f"/jobs/{job}").text


@pytest.mark.parametrize(
    "secret",
    [
        "plain",
        "whsec_",
        "whsec_!",
        "whsec_A",
        "whsec_AAA",
        "whsec_AAAAA=",
        "whsec_" + "A" * 28,
        "WHSEC_" + "A" * 32,
        "x" * 5000,
        " ".join(["whsec_" + "A" * 32] * 3),
        "whsec_" + "A" * 32 + " ",
    ],
)
def test_a_secret_that_is_none_stops_the_start_and_is_not_repeated(
    monkeypatch: pytest.MonkeyPatch, secret: str
) -> None:
    monkeypatch.setenv("COW_WEBHOOK_SECRET", secret)
    with pytest.raises(SettingsError, match="COW_WEBHOOK_SECRET") as caught:
        load_settings()
    assert f"'{secret}'" not in str(caught.value)
