"""The SDK where things go wrong: broken connections, refusals, proxies, restarts, later versions of the server."""

from __future__ import annotations

import asyncio
import contextlib
import email.utils
import json
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from conftest import ROOT
from sdk import (
    BROKEN,
    DIGEST,
    DONE,
    JOB,
    SIMULATION,
    Asked,
    Connect,
    Reply,
    Scripted,
    connect,
    event,
    hurried,
    stream,
    told,
)
from servers import IMAGE, QUESTION, Served, data_url, slow
from waiting import eventually

from cow_service.client import AsyncClient, CowError, errors
from cow_service.client.protocol import MAX_RETRY_AFTER_SECONDS
from cow_service.errors import kinds

__all__ = ["connect", "hurried"]  # fixtures
pytestmark = pytest.mark.slow

OK = Reply(200, SIMULATION)
ACCEPTED = Reply(202, JOB)
MODELS = Reply(200, {"readers": [], "generators": []})


# --- what is sent again, and how ---


def test_a_call_has_one_key_and_one_body_however_often_it_is_sent(hurried: Connect) -> None:
    cut = Reply(200, SIMULATION, cut=5)
    with Scripted(BROKEN, cut, told("shutting-down", 503), Reply(502, b"<html>"), OK) as server:
        simulation = hurried(server.url).simulate(IMAGE, QUESTION)
    assert simulation.id == "j-1"
    assert server.lines == ["POST /simulate"] * 5
    assert len({asked.headers["idempotency-key"] for asked in server.asked}) == 1
    assert len({asked.body for asked in server.asked}) == 1
    assert len(hurried.slept) == 4


def test_every_call_has_a_key_of_its_own_unless_it_is_given(hurried: Connect) -> None:
    with Scripted(OK) as server:
        client = hurried(server.url)
        client.simulate(IMAGE, QUESTION)
        client.simulate(IMAGE, QUESTION)
        client.simulate(IMAGE, QUESTION, idempotency_key="mine-17")
    first, second, third = [asked.headers["idempotency-key"] for asked in server.asked]
    assert len({first, second, third}) == 3
    assert third == "mine-17"
    assert len(first) >= 20


@pytest.mark.parametrize("key", ["", "two words", "ä", "line\n", "x" * 256])
def test_a_key_that_no_header_can_hold_is_refused(hurried: Connect, key: str) -> None:
    with Scripted(OK) as server, pytest.raises(errors.InvalidRequest, match="idempotency_key"):
        hurried(server.url).simulate(IMAGE, QUESTION, idempotency_key=key)
    assert server.asked == []


@pytest.mark.parametrize("code", ["queue-full", "rate-limited", "shutting-down", "not-ready", "body-too-slow"])
def test_refusals_at_the_door_are_tried_again(hurried: Connect, code: str) -> None:
    with Scripted(told(code, kinds()[code].status, headers={"retry-after": "7"}), OK) as server:
        hurried(server.url).simulate(IMAGE, QUESTION)
    assert len(server.asked) == 2
    assert 7 <= hurried.slept[0] < 7.5


@pytest.mark.parametrize(
    ("retry_after", "least", "most"),
    [
        ("0", 0, 0.3),
        ("3", 3, 3.5),
        ("3600", MAX_RETRY_AFTER_SECONDS, MAX_RETRY_AFTER_SECONDS + 0.3),
        ("9" * 400, MAX_RETRY_AFTER_SECONDS, MAX_RETRY_AFTER_SECONDS + 0.3),
        (30, 20, 31),
        (4000, MAX_RETRY_AFTER_SECONDS, MAX_RETRY_AFTER_SECONDS + 0.3),
        (-50, 0, 0.3),
        ("soon", 0.3, 0.7),
        ("-5", 0.3, 0.7),
        ("1.5", 0.3, 0.7),
        ("Fri, 99 Foo 2026 00:00:00 GMT", 0.3, 0.7),
        ("", 0.3, 0.7),
    ],
)
def test_retry_after_is_heeded_and_capped(
    hurried: Connect, monkeypatch: pytest.MonkeyPatch, retry_after: str | int, least: float, most: float
) -> None:
    """A number of seconds, or a date that many seconds from now, also in the old form, which is in GMT as well."""
    forms = [retry_after]
    if isinstance(retry_after, int):
        then = time.time() + retry_after
        forms = [email.utils.formatdate(then, usegmt=True), time.asctime(time.gmtime(then))]
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    try:
        with Scripted(*(told("queue-full", 503, headers={"retry-after": str(form)}) for form in forms), OK) as server:
            hurried(server.url).simulate(IMAGE, QUESTION)
    finally:
        monkeypatch.undo()
        time.tzset()
    assert len(hurried.slept) == len(forms)
    assert all(least <= pause <= most for pause in hurried.slept)


def test_pauses_grow_where_the_server_asks_for_none(hurried: Connect) -> None:
    with (
        Scripted(BROKEN) as server,
        pytest.raises(errors.ServerUnreachable, match=r"POST http://127.0.0.1:\d+/simulate"),
    ):
        hurried(server.url).simulate(IMAGE, QUESTION)
    assert len(server.asked) == 6
    for pause, about in zip(hurried.slept, (0.5, 1, 2, 4, 8), strict=True):
        assert about * 0.75 <= pause <= about * 1.25


@pytest.mark.parametrize("retries", [0, 1, 3])
def test_how_often_is_tried_is_the_callers(hurried: Connect, retries: int) -> None:
    with Scripted(told("queue-full", 503)) as server, pytest.raises(errors.QueueFull):
        hurried(server.url, retries=retries).submit(IMAGE, QUESTION)
    assert len(server.asked) == retries + 1


FAILURES = ["mllm-unavailable", "mllm-bad-reply", "generator-out-of-memory", "generator-unavailable", "internal-error"]


@pytest.mark.parametrize("code", ["invalid-request", "unauthorized", "storage-unavailable", "canceled", *FAILURES])
def test_what_would_come_to_the_same_is_not_tried_again(hurried: Connect, code: str) -> None:
    with Scripted(told(code, kinds()[code].status)) as server, pytest.raises(kinds()[code]):
        hurried(server.url).simulate(IMAGE, QUESTION)
    assert len(server.asked) == 1
    assert hurried.slept == []


@pytest.mark.parametrize("status", [301, 400, 401, 404, 500, 505])
def test_a_proxys_own_refusals_are_not_tried_again(hurried: Connect, status: int) -> None:
    headers = {"content-type": "text/html", "x-request-id": "p-1", "location": "https://x" if status == 301 else ""}
    page = Reply(status, b"<html>no</html>", headers)
    with Scripted(page) as server, pytest.raises(errors.BadResponse, match=f"{status}.*<html>no") as raised:
        hurried(server.url).models()
    assert len(server.asked) == 1
    assert (raised.value.status, raised.value.code, raised.value.request_id) == (status, "bad-response", "p-1")
    assert ("It points to https://x: is that" in raised.value.detail) == (status == 301)


@pytest.mark.parametrize("status", [408, 425, 429, 502, 503, 504])
def test_a_proxys_passing_refusals_are_tried_again(hurried: Connect, status: int) -> None:
    with Scripted(Reply(status, b"<html>"), Reply(status, b""), MODELS) as server:
        assert hurried(server.url).models().readers == ()
    assert len(server.asked) == 3


def test_a_job_that_is_deleted_and_not_heard_of_is_deleted(hurried: Connect) -> None:
    with Scripted(Reply(200, JOB), BROKEN, told("job-not-found", 404)) as server:
        hurried(server.url).job("j-1").delete()
    assert server.lines == ["GET /jobs/j-1", "DELETE /jobs/j-1", "DELETE /jobs/j-1"]


def test_a_job_that_never_was_cannot_be_deleted(hurried: Connect) -> None:
    with Scripted(Reply(200, JOB), told("job-not-found", 404)) as server, pytest.raises(errors.JobNotFound):
        hurried(server.url).job("j-1").delete()


def test_an_artifact_that_came_damaged_is_not_taken(hurried: Connect) -> None:
    with Scripted(Reply(200, b"other")) as server, pytest.raises(errors.BadResponse, match="damaged"):
        hurried(server.url).artifact(DIGEST)


def test_ids_stay_where_they_belong_in_an_address(hurried: Connect) -> None:
    with Scripted(told("job-not-found", 404)) as server:
        for name in ("../models", "a/b?c#d", "ä"):
            with pytest.raises(errors.JobNotFound):
                hurried(server.url).job(name)
    assert server.lines == ["GET /jobs/..%2Fmodels", "GET /jobs/a%2Fb%3Fc%23d", "GET /jobs/%C3%A4"]


# --- time ---


def test_the_timeout_is_for_everything_together(connect: Connect) -> None:
    def held(asked: Asked) -> Reply:
        if asked.method == "POST":
            time.sleep(1.0)
        return ACCEPTED if asked.method == "POST" else Reply(200, JOB)

    with Scripted(held) as server:
        began = time.monotonic()
        with pytest.raises(errors.WaitTimeout, match=r"j-1.*1\.3 s") as raised:
            connect(server.url).simulate(IMAGE, QUESTION, timeout=1.3)
        assert 1.2 < time.monotonic() - began < 2.2
    assert raised.value.job_id == "j-1"
    assert server.asked[0].headers["prefer"] == "wait=1"


def test_no_pause_goes_past_the_timeout(hurried: Connect) -> None:
    with Scripted(told("queue-full", 503, headers={"retry-after": "30"})) as server, pytest.raises(errors.QueueFull):
        hurried(server.url).simulate(IMAGE, QUESTION, timeout=5)
    assert len(server.asked) == 1


def test_a_wait_can_go_on_after_a_timeout(hurried: Connect) -> None:
    with Scripted(ACCEPTED, Reply(200, JOB), Reply(200, DONE)) as server:
        handle = hurried(server.url).submit(IMAGE, QUESTION)
        with pytest.raises(errors.WaitTimeout) as raised:
            handle.wait(timeout=0)
        assert raised.value.job_id == handle.id
        assert handle.wait().grounding.object == "red ball"
        assert handle.job.status == "succeeded"


def test_a_server_that_says_nothing_is_unreachable(connect: Connect) -> None:
    def silent(_: Asked) -> Reply:
        time.sleep(1)
        return MODELS

    with Scripted(silent) as server, pytest.raises(errors.ServerUnreachable, match=r"Is the server running"):
        connect(server.url, timeout=0.2, retries=0).models()


# --- problems ---


def _documented() -> set[str]:
    told = (ROOT / "openapi.yaml").read_text()
    operations = [operation for path in yaml.safe_load(told)["paths"].values() for operation in path.values()]
    responses = [r for o in operations for status, r in o.get("responses", {}).items() if str(status) >= "400"]
    return {code for response in responses for code in re.findall(r"`([a-z-]+)`", response.get("description", ""))}


def test_every_code_of_the_contract_has_its_class() -> None:
    documented = _documented()
    assert documented
    assert documented <= set(kinds())


def test_a_problem_is_raised_as_the_class_of_its_code(hurried: Connect) -> None:
    fields = [{"pointer": "/fps", "detail": "too fast"}, {"pointer": "/seed", "detail": "odd"}]
    known = sorted(kinds().items())
    named = {"errors": fields, "headers": {"x-request-id": "r-9"}}
    replies = [told(code, kind.status, f"Wrong: {code}.", **named) for code, kind in known]
    with Scripted(*replies) as server:
        client = hurried(server.url, retries=0)
        for code, kind in known:
            with pytest.raises(CowError) as raised:
                client.answer(IMAGE, QUESTION)
            error = raised.value
            assert type(error) is kind
            assert (error.code, error.status, error.request_id) == (code, kind.status, "r-9")
            assert error.detail == str(error) == f"Wrong: {code}."
            assert [(field.pointer, field.detail) for field in error.errors] == [("/fps", "too fast"), ("/seed", "odd")]
            assert any("r-9" in note for note in error.__notes__)
            assert getattr(errors, kind.__name__) is kind


def test_what_a_job_failed_with_is_raised_as_the_same_class(hurried: Connect) -> None:
    known = sorted(kinds().items())
    problems = [told(code, kind.status, "Why.").body for code, kind in known]
    failed = [Reply(200, {**JOB, "status": "failed", "problem": one}, {"x-request-id": "r-8"}) for one in problems]
    with Scripted(ACCEPTED, *failed) as server:
        handle = hurried(server.url).submit(IMAGE, QUESTION)
        for _, kind in known:
            with pytest.raises(CowError, match="Why") as raised:
                handle.wait()
            assert type(raised.value) is kind
            assert raised.value.request_id == "r-8"
    assert len(server.asked) == 1 + len(known)


def test_every_error_class_can_be_imported_from_the_sdk() -> None:
    from cow_service import errors as ours

    classes = {
        name
        for module in (ours, errors)
        for name, value in vars(module).items()
        if isinstance(value, type) and value.__module__ == module.__name__
    }
    assert classes <= set(vars(errors))


def test_a_code_of_a_later_version_is_a_plain_error_with_that_code(hurried: Connect) -> None:
    with Scripted(told("moon-too-full", 418, "It is.", moon=1)) as server, pytest.raises(CowError) as raised:
        hurried(server.url).models()
    assert type(raised.value) is CowError
    assert (raised.value.code, raised.value.status, raised.value.detail) == ("moon-too-full", 418, "It is.")


ODD: list[Any] = [
    {"type": "urn:cow:problem:queue-full", "status": "many", "errors": 7, "detail": None, "title": "Full."},
    {"errors": ["x", {"pointer": None}]},
    {},
]


@pytest.mark.parametrize("problem", ODD)
def test_problems_that_are_odd_are_raised_all_the_same(hurried: Connect, problem: Any) -> None:
    reply = Reply(400, problem, {"content-type": "Application/Problem+JSON; charset=utf-8"})
    with Scripted(reply) as server, pytest.raises(CowError):
        hurried(server.url, retries=0).models()


@pytest.mark.parametrize(
    "reply",
    [
        Reply(200, b"<html>log in here</html>", {"content-type": "text/html"}),
        Reply(200, b""),
        Reply(200, b"\xff\xfe\x00"),
        Reply(200, [1]),
        Reply(200, {"readers": 3}),
        Reply(418, b"not json", {"content-type": "application/problem+json"}),
        Reply(418, b"[]", {"content-type": "application/problem+json"}),
        Reply(200, b"none", {"content-encoding": "gzip"}),
    ],
)
def test_what_is_none_of_cows_is_a_bad_response(hurried: Connect, reply: Reply) -> None:
    with Scripted(reply) as server, pytest.raises(errors.BadResponse):
        hurried(server.url).models()
    assert len(server.asked) == 1


def test_a_job_whose_result_cannot_be_read_is_a_bad_response(hurried: Connect) -> None:
    results = [None, {}, {**SIMULATION, "frames": "many"}, [1]]
    with Scripted(Reply(200, JOB), *(Reply(200, {**DONE, "result": result}) for result in results)) as server:
        handle = hurried(server.url).job("j-1")
        for _ in results:
            with pytest.raises(errors.BadResponse, match="version"):
                handle.wait()


def test_nobody_there_is_unreachable_and_says_where(hurried: Connect) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(errors.ServerUnreachable, match=rf"http://127.0.0.1:{port}/models.*COW_BASE_URL") as raised:
        hurried(f"http://user:secret@127.0.0.1:{port}").models()
    assert raised.value.status == 0
    assert "secret" not in str(raised.value)


# --- later versions of the server ---


def _more(value: Any) -> Any:
    """The same with a field more in every object."""
    if isinstance(value, dict):
        return {name: _more(part) for name, part in value.items()} | {"of_tomorrow": {"x": [1]}}
    return [_more(part) for part in value] if isinstance(value, list) else value


def test_fields_of_a_later_version_are_left_out(hurried: Connect) -> None:
    later = _more(SIMULATION) | {"timings": {"grounding": 0.1}}
    page = {"jobs": [_more(JOB)], "next": None, "more": 1}
    done = Reply(200, _more({**DONE, "result": None}) | {"result": later})
    rest = [Reply(202, _more(JOB)), done, Reply(200, page), Reply(200, _more(MODELS.body))]
    with Scripted(Reply(200, later), *rest) as server:
        client = hurried(server.url)
        assert client.simulate(IMAGE, QUESTION).model_dump() == client.submit(IMAGE, QUESTION).wait().model_dump()
        assert [handle.id for handle in client.jobs()] == ["j-1"]
        client.models()


# --- events ---


def test_events_go_on_where_the_connection_broke(hurried: Connect) -> None:
    begun = stream(event("queued", 1, JOB), event("running", 2, JOB), event("progress", None, JOB), cut=True)
    rest = stream(
        event("running", 2, JOB),  # a proxy that lost the header
        event("stage", 3, _more(JOB)),
        event("of-tomorrow", 4, {"anything": 1}),
        ": a comment",
        event("succeeded", 100, {**JOB, "status": "succeeded"}),
    )
    with Scripted(Reply(200, JOB), begun, BROKEN, told("shutting-down", 503), stream(), rest) as server:
        handle = hurried(server.url).job("j-1")
        heard = [(one.name, one.number) for one in handle.events()]
        assert heard == [("queued", 1), ("running", 2), ("progress", None), ("stage", 3), ("succeeded", 100)]
        assert handle.job.status == "succeeded"
    assert [asked.headers.get("last-event-id") for asked in server.asked[1:]] == [None, "2", "2", "2", "2"]
    assert server.asked[1].headers["accept"] == "text/event-stream"


def test_events_after_a_number(hurried: Connect) -> None:
    with Scripted(Reply(200, JOB), stream(event("canceled", 100, JOB)), Reply(204, b"")) as server:
        handle = hurried(server.url).job("j-1")
        assert [one.number for one in handle.events(after=3)] == [100]
        assert list(handle.events(after=100)) == []
    assert [asked.headers.get("last-event-id") for asked in server.asked] == [None, "3", "100"]


def test_a_job_that_is_deleted_ends_its_events(hurried: Connect) -> None:
    with Scripted(Reply(200, JOB), stream(event("deleted", 100, None))) as server:
        (one,) = hurried(server.url).job("j-1").events()
    assert (one.name, one.job) == ("deleted", None)


@pytest.mark.parametrize("replies", [(BROKEN,), (stream(),), (stream(cut=True),)])
def test_a_stream_that_breaks_again_and_again_is_given_up(hurried: Connect, replies: tuple[Reply, ...]) -> None:
    with Scripted(Reply(200, JOB), *replies) as server:
        handle = hurried(server.url, retries=2).job("j-1")
        with pytest.raises(errors.ServerUnreachable, match="/jobs/j-1/events"):
            list(handle.events())
    assert len(server.asked) == 1 + 3


@pytest.mark.parametrize(
    ("reply", "error"),
    [
        (told("job-not-found", 404), errors.JobNotFound),
        (Reply(200, b"<html>", {"content-type": "text/html"}), errors.BadResponse),
        (stream("event: queued\ndata: {broken"), errors.BadResponse),
        (stream("event: queued\ndata: [1]"), errors.BadResponse),
        (stream(event("queued", 1, {"id": 3})), errors.BadResponse),
    ],
)
def test_events_that_cannot_be_had(hurried: Connect, reply: Reply, error: type[CowError]) -> None:
    with Scripted(Reply(200, JOB), reply) as server:
        handle = hurried(server.url).job("j-1")
        with pytest.raises(error):
            list(handle.events())
    assert len(server.asked) == 2


def test_events_may_be_left_before_their_end(hurried: Connect) -> None:
    with Scripted(Reply(200, JOB), stream(event("queued", 1, JOB), event("succeeded", 100, JOB))) as server:
        events = hurried(server.url).job("j-1").events()
        assert next(events).name == "queued"
        events.close()


# --- who is asked, and how ---


def test_addresses_that_are_none(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    for address in ("127.0.0.1:8000", "ftp://x", "http://", "https:///path", "http://[x", "http://x:99999", "http://x?a=1",
                    "http://x#y", "http://x\n", "http://x y"):  # fmt: skip
        with pytest.raises(ValueError, match="base_url"):
            connect(address)
        monkeypatch.setenv("COW_BASE_URL", address)
        with pytest.raises(ValueError, match="base_url"):
            connect()


def test_keys_that_are_none_are_not_told(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    for key in ("cow_secret\n", "cow secret", "sécret"):
        with pytest.raises(ValueError, match="api_key") as raised:
            connect(api_key=key)
        assert "cret" not in str(raised.value)
        monkeypatch.setenv("COW_API_KEY", key)
        with pytest.raises(ValueError, match="api_key"):
            connect()


def test_address_and_key_come_from_the_environment(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    with Scripted(MODELS) as server:
        monkeypatch.setenv("COW_BASE_URL", server.url + "/")
        monkeypatch.setenv("COW_API_KEY", "cow_env")
        assert connect().base_url == server.url
        connect().models()
        connect(api_key="cow_own").models()
        connect(server.url + "/behind/").models()
        monkeypatch.delenv("COW_API_KEY")
        connect().models()
    assert [asked.headers.get("authorization") for asked in server.asked] == [
        "Bearer cow_env", "Bearer cow_own", "Bearer cow_env", None,
    ]  # fmt: skip
    assert server.lines[2] == "GET /behind/models"
    assert server.asked[0].headers["user-agent"].startswith("cow-service/")
    monkeypatch.delenv("COW_BASE_URL")
    assert connect().base_url == "http://127.0.0.1:8000"


def test_an_http_client_of_ones_own(hurried: Connect) -> None:
    with Scripted(OK) as server:
        http = hurried.http(headers={"X-Tenant": "t-1", "Authorization": "Basic abc"}, base_url="http://elsewhere")
        client = hurried(server.url, http_client=http)
        client.simulate(IMAGE, QUESTION, fresh=True)
        client.close()
        assert not http.is_closed
    headers = server.asked[0].headers
    assert (headers["x-tenant"], headers["authorization"], headers["cache-control"]) == ("t-1", "Basic abc", "no-cache")


def test_a_transport_of_ones_own(hurried: Connect) -> None:
    asked: list[httpx.Request] = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request)
        if len(asked) == 1:
            raise httpx.ConnectError("not yet")
        return httpx.Response(200, json=SIMULATION)

    http = hurried.http(transport=httpx.MockTransport(answer))
    assert hurried("https://cow.example/api", http_client=http, api_key="k").simulate(IMAGE, QUESTION).id == "j-1"
    assert [str(request.url) for request in asked] == ["https://cow.example/api/simulate"] * 2
    assert asked[1].headers["authorization"] == "Bearer k"


def test_an_app_in_the_same_process() -> None:
    async def app(scope: Any, receive: Any, send: Any) -> None:
        assert scope["path"] == "/models"
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"application/json")]})
        await send({"type": "http.response.body", "body": json.dumps(MODELS.body).encode()})

    async def ask() -> None:
        async with (
            httpx.AsyncClient(transport=httpx.ASGITransport(app)) as http,
            AsyncClient("http://cow", http_client=http) as client,
        ):
            assert (await client.models()).generators == ()

    asyncio.run(ask())


def test_the_environments_proxies_are_used(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    with Scripted(MODELS) as proxy:
        monkeypatch.setenv("http_proxy", proxy.url)
        connect("http://cow.example", http_client=None).models()
    assert proxy.lines == ["GET http://cow.example/models"]


# --- callers who leave ---


def test_a_call_that_is_broken_off_before_its_job_is_known_ends_it(hurried: Connect) -> None:
    """Ctrl-C while the first request waits: the server may have made a job of it."""
    waiting = threading.Event()

    def held(asked: Asked) -> Reply:
        if asked.headers.get("prefer", "").startswith("wait="):
            waiting.set()
            time.sleep(0.5)
            return BROKEN
        return Reply(202, JOB) if asked.path == "/simulate" else Reply(200, {**JOB, "status": "canceled"})

    with Scripted(held) as server:
        _leave(hurried, server.url, waiting)
    assert server.lines[0] == "POST /simulate"
    assert server.lines[-2:] == ["POST /simulate", "POST /jobs/j-1/cancel"]
    assert len({asked.headers["idempotency-key"] for asked in server.asked if asked.path == "/simulate"}) == 1
    assert server.asked[-2].headers["prefer"] == "respond-async"


def test_a_call_that_is_broken_off_later_ends_its_job(connect: Connect) -> None:
    looked = threading.Event()

    def held(asked: Asked) -> Reply:
        if asked.method == "GET":
            looked.set()
            return Reply(200, JOB)
        return ACCEPTED if asked.path == "/simulate" else Reply(200, {**JOB, "status": "canceled"})

    with Scripted(held) as server:
        _leave(connect, server.url, looked)
    assert server.lines.count("POST /simulate") == 1
    assert server.lines[-1] == "POST /jobs/j-1/cancel"


def test_leaving_a_dead_server_is_still_leaving(hurried: Connect) -> None:
    waiting = threading.Event()

    def held(asked: Asked) -> Reply:
        waiting.set()
        time.sleep(0.3)
        return BROKEN

    with Scripted(held) as server:
        _leave(hurried, server.url, waiting)


def _leave(connect: Connect, url: str, when: threading.Event) -> None:
    """Interrupts a simulation at that moment, as a person at a terminal or a canceled task does."""
    if connect.kind == "async":

        async def ask() -> None:
            async with AsyncClient(url) as client:
                task = asyncio.create_task(client.simulate(IMAGE, QUESTION))
                await asyncio.to_thread(when.wait, 10)
                task.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await task

        asyncio.run(ask())
        return

    def interrupt() -> None:
        when.wait(10)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        connect(url, http_client=None).simulate(IMAGE, QUESTION)
    thread.join()


def test_a_task_that_is_canceled_twice_ends_its_job_all_the_same() -> None:
    """As anyio's cancel scopes do, whose every `await` is canceled."""
    looked, ended = threading.Event(), threading.Event()

    def held(asked: Asked) -> Reply:
        if asked.method == "GET":
            looked.set()
            return Reply(200, JOB)
        if asked.path == "/simulate":
            return ACCEPTED
        time.sleep(0.2)
        ended.set()
        return Reply(200, {**JOB, "status": "canceled"})

    async def ask(url: str) -> None:
        async with AsyncClient(url) as client:
            task = asyncio.create_task(client.simulate(IMAGE, QUESTION))
            await asyncio.to_thread(looked.wait, 10)
            task.cancel()
            await asyncio.sleep(0.05)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert await asyncio.to_thread(ended.wait, 5)

    with Scripted(held) as server:
        asyncio.run(ask(server.url))


def test_a_progress_function_that_raises_ends_the_job(hurried: Connect) -> None:
    def fail(_: Any) -> None:
        raise RuntimeError("enough")

    canceled = Reply(200, {**JOB, "status": "canceled"})
    with Scripted(ACCEPTED, Reply(200, JOB), canceled) as server, pytest.raises(RuntimeError, match="enough"):
        hurried(server.url).simulate(IMAGE, QUESTION, progress=fail)
    assert server.lines == ["POST /simulate", "GET /jobs/j-1", "POST /jobs/j-1/cancel"]


def test_progress_that_nobody_knows_is_refused_before_anything_is_sent(hurried: Connect) -> None:
    with Scripted(OK) as server, pytest.raises(ValueError, match="progress"):
        hurried(server.url).simulate(IMAGE, QUESTION, progress="bar")
    assert server.asked == []


# --- a server that is killed and comes back ---


class Relay:
    """One address for a server that comes back at another."""

    def __init__(self) -> None:
        self.to: tuple[str, int] | None = None
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._carry, args=(near,), daemon=True).start()

    def _carry(self, near: socket.socket) -> None:
        with near:
            try:
                with socket.create_connection(self.to or ("127.0.0.1", 1)) as far:
                    there = threading.Thread(target=_pump, args=(near, far), daemon=True)
                    there.start()
                    _pump(far, near)
                    there.join()
            except OSError:
                return

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()


def _pump(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            sink.sendall(data)
    for end in (source, sink):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def relay() -> Iterator[Relay]:
    one = Relay()
    yield one
    one.close()


@pytest.mark.soak
@pytest.mark.slow
def test_a_wait_outlives_a_server_that_is_killed(connect: Connect, relay: Relay, tmp_path: Path) -> None:
    with Served(tmp_path) as served:
        relay.to = served.host_and_port
        client = connect(relay.url, retries=12)  # over a minute: as long as `Served.start` may take on a busy machine
        body = slow(4, seed=5)
        options = {name: value for name, value in body.items() if name not in ("image", "question")}
        handle = client.submit(data_url(IMAGE), QUESTION, **options)

        def accident() -> None:
            eventually(served.clips)
            served.kill()
            served.start()
            relay.to = served.host_and_port

        thread = threading.Thread(target=accident)
        thread.start()
        events = [(one.name, one.number) for one in handle.events() if one.name != "progress"]
        result = handle.wait(timeout=60)
        thread.join()
        assert result.id == handle.id
        assert [number for _, number in events] == [1, 2, 3, 4, 100]
        assert len(result.pil_frames()) == 40
        assert client.submit(data_url(IMAGE), QUESTION, idempotency_key="k-1", **options).wait().generator.seed == 5
