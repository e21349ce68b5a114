"""The SDK where things go wrong: broken connections, refusals, proxies, restarts, later versions of the server."""

from __future__ import annotations

import asyncio
import email.utils
import signal
import socket
import threading
import time
from typing import Any

import httpx
import pytest
from refusals import refused
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
from servers import IMAGE, QUESTION
from waiting import TIME_LIMIT

from cow_service import __version__
from cow_service.client import AsyncClient, Client, CowError, errors
from cow_service.client.protocol import endpoint_of, pause_before_retry
from cow_service.errors import FieldError, kinds

__all__ = ["connect", "hurried"]  # fixtures

OK = Reply(200, SIMULATION)
ACCEPTED = Reply(202, JOB)
CANCELED = Reply(200, {**JOB, "status": "canceled"})
MODELS = Reply(200, {"readers": [], "generators": []})
PAGE = {"content-type": "text/html"}


# --- what is sent again, and how ---


def test_a_call_has_one_key_and_one_body_however_often_it_is_sent(hurried: Connect) -> None:
    cut = Reply(200, SIMULATION, cut=5)
    with Scripted(BROKEN, cut, told("shutting-down", 503), Reply(502, b"<html>"), OK) as server:
        client = hurried(server.url)
        assert client.simulate(IMAGE, QUESTION).id == "j-1"
        assert server.lines == ["POST /simulate"] * 5
        assert len({(asked.headers["idempotency-key"], asked.body) for asked in server.asked}) == 1
        assert len(hurried.slept) == 4
        client.simulate(IMAGE, QUESTION)
        client.simulate(IMAGE, QUESTION, idempotency_key="mine-17")
    first, second, third = [asked.headers["idempotency-key"] for asked in server.asked[4:]]
    assert first != second
    assert third == "mine-17"
    assert len(first) >= 20


def test_a_problem_is_raised_as_the_class_of_its_code_and_only_refusals_at_the_door_are_tried_again(
    hurried: Connect,
) -> None:
    again = {"queue-full", "rate-limited", "shutting-down", "not-ready", "body-too-slow"}
    fields = [{"pointer": "/fps", "detail": "too fast"}, {"pointer": "/seed", "detail": "odd"}]
    more = {"errors": fields, "headers": {"x-request-id": "r-9", "retry-after": "7"}}
    known = sorted(kinds().items())
    replies = [
        told(code, kind.status, f"Wrong: {code}.", **more) for code, kind in known for _ in range(1 + (code in again))
    ]
    with Scripted(*replies, OK) as server:
        client = hurried(server.url, retries=1)
        for code, kind in known:
            with refused(code, "/fps", "/seed") as caught:
                client.answer(IMAGE, QUESTION)
            error = caught.value
            assert type(error) is kind is getattr(errors, kind.__name__)
            assert (error.status, error.request_id) == (kind.status, "r-9")
            assert error.detail == str(error) == f"Wrong: {code}."
            assert error.errors == (FieldError("/fps", "too fast"), FieldError("/seed", "odd"))
            assert any("r-9" in note for note in error.__notes__)
    assert len(server.asked) == len(replies) == len(known) + len(again)
    assert len(hurried.slept) == len(again)
    assert all(7 <= pause <= 7.25 for pause in hurried.slept)


def test_a_proxys_refusals_are_tried_again_where_they_pass(hurried: Connect) -> None:
    passing = [Reply(status, b"<html>") for status in (408, 425, 429, 502, 503, 504)]
    with Scripted(*passing, MODELS) as server:
        assert hurried(server.url, retries=len(passing)).models().readers == ()
        assert len(server.asked) == len(passing) + 1
    for status in (301, 400, 500, 505):
        headers = {**PAGE, "x-request-id": "p-1", "location": "https://x.example" if status == 301 else ""}
        with Scripted(Reply(status, b"<html>no</html>", headers)) as server, refused("bad-response") as caught:
            hurried(server.url).models()
        assert len(server.asked) == 1
        assert (caught.value.status, caught.value.request_id) == (status, "p-1")
        assert all(part in caught.value.detail for part in (str(status), "<html>no", headers["location"]))


NOW = 1_700_000_000.0
JITTER = 0.25


@pytest.mark.parametrize(
    ("retry_after", "least"),
    [
        ("0", 0),
        ("3", 3),
        ("3600", 60),
        (email.utils.formatdate(NOW + 30, usegmt=True), 30),
        (time.asctime(time.gmtime(NOW + 30)), 30),  # the old form, which is in GMT as well
        (email.utils.formatdate(NOW - 50, usegmt=True), 0),
        ("1.5", 0.375),  # no number of whole seconds
    ],
)
def test_retry_after_is_heeded_and_capped(monkeypatch: pytest.MonkeyPatch, retry_after: str, least: float) -> None:
    monkeypatch.setattr(time, "time", lambda: NOW)
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    try:
        pause = pause_before_retry(httpx.Response(503, headers={"retry-after": retry_after}), 1)
    finally:
        monkeypatch.undo()
        time.tzset()
    assert pause is not None
    assert least <= pause <= least + JITTER


def test_pauses_grow_where_the_server_asks_for_none_and_nobody_is_asked_for_ever(hurried: Connect) -> None:
    with Scripted(BROKEN) as server, refused("server-unreachable") as caught:
        hurried(server.url, retries=6).simulate(IMAGE, QUESTION)
    assert f"POST {server.url}/simulate" in caught.value.detail
    assert len(server.asked) == 7
    for pause, about in zip(hurried.slept, (0.5, 1, 2, 4, 8, 8), strict=True):
        assert about * 0.75 <= pause <= about * 1.25


def test_nobody_there_is_soon_unreachable_and_says_where(hurried: Connect) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with refused("server-unreachable") as caught:
        hurried(f"http://user:secret@127.0.0.1:{port}").models()
    assert caught.value.status == 0
    assert f"http://127.0.0.1:{port}/models" in caught.value.detail
    assert "secret" not in str(caught.value)
    assert len(hurried.slept) == 2, "a server that has never answered is tried three times"


def test_a_job_that_is_deleted_and_not_heard_of_is_deleted(hurried: Connect) -> None:
    gone = told("job-not-found", 404)
    with Scripted(Reply(200, JOB), BROKEN, gone) as server:
        job = hurried(server.url).job("j-1")
        job.delete()
        assert server.lines == ["GET /jobs/j-1", "DELETE /jobs/j-1", "DELETE /jobs/j-1"]
        with refused("job-not-found"):  # one that never was
            job.delete()


def test_an_artifact_is_not_taken_damaged_and_is_missed_where_it_lies(hurried: Connect) -> None:
    with Scripted(Reply(200, b"other")) as server, refused("bad-response"):
        hurried(server.url).artifact(DIGEST)
    with Scripted(BROKEN) as store, Scripted(Reply(307, b"", {"location": f"{store.url}/a"})) as server:
        with refused("server-unreachable") as caught:
            hurried(server.url, retries=0, api_key="cow_own").artifact(DIGEST)
        assert "COW_ARTIFACTS_REDIRECT" in caught.value.detail
        assert "authorization" not in store.asked[0].headers


def test_ids_stay_where_they_belong_in_an_address(hurried: Connect) -> None:
    with Scripted(told("job-not-found", 404)) as server:
        for name in ("../models", "a/b?c#d", "ä"):
            with refused("job-not-found"):
                hurried(server.url).job(name)
    assert server.lines == ["GET /jobs/..%2Fmodels", "GET /jobs/a%2Fb%3Fc%23d", "GET /jobs/%C3%A4"]


# --- time ---


def test_the_timeout_is_for_everything_together(hurried: Connect) -> None:
    def held(asked: Asked) -> Reply:
        hurried.now += 1.0 if asked.method == "POST" else 0.0
        return ACCEPTED if asked.method == "POST" else Reply(200, JOB)

    with Scripted(held) as server, refused("wait-timeout") as caught:
        hurried(server.url).simulate(IMAGE, QUESTION, timeout=1.3)
    assert hurried.slept == pytest.approx([0.1, 0.15, 0.05])
    assert isinstance(caught.value, errors.WaitTimeout)
    assert caught.value.job_id == "j-1"
    assert server.asked[0].headers["prefer"] == "wait=1"
    with Scripted(told("queue-full", 503, headers={"retry-after": "30"})) as server, refused("queue-full"):
        hurried(server.url).simulate(IMAGE, QUESTION, timeout=5)
    assert len(server.asked) == 1, "no pause goes past the timeout"


def test_looks_at_a_job_become_rarer_and_a_wait_can_go_on_after_a_timeout(hurried: Connect) -> None:
    running = [Reply(200, JOB)] * 9
    with Scripted(ACCEPTED, *running, Reply(200, DONE)) as server:
        handle = hurried(server.url).submit(IMAGE, QUESTION)
        with refused("wait-timeout") as caught:
            handle.wait(timeout=0)
        assert isinstance(caught.value, errors.WaitTimeout)
        assert caught.value.job_id == handle.id
        assert handle.wait().grounding.object == "red ball"
        assert handle.job.status == "succeeded"
    assert hurried.slept == pytest.approx([0.1, 0.15, 0.225, 0.3375, 0.50625, 0.759375, 1.1390625, 1.70859375])
    assert {asked.method for asked in server.asked[1:]} == {"GET"}, "who waits no longer cancels nothing"


def test_how_long_the_server_may_say_nothing(connect: Connect) -> None:
    ended = threading.Event()

    def silent(_: Asked) -> Reply:
        ended.wait(TIME_LIMIT)
        return MODELS

    with Scripted(silent) as server:
        with refused("server-unreachable"):
            connect(server.url, timeout=0.2, retries=0).models()
        ended.set()
    endpoint = endpoint_of("http://cow", None, 60)
    assert endpoint.timeout.as_dict() == {"connect": 10, "read": 60, "write": 60, "pool": 60}
    assert endpoint.stream_timeout.as_dict() == {"connect": 10, "read": 60, "write": 60, "pool": 60}
    assert endpoint.limited(20).as_dict() == {"connect": 10, "read": 20, "write": 20, "pool": 20}
    assert endpoint_of("http://cow", None, None).limited(3).as_dict()["read"] == 3
    waits = [endpoint_of("http://cow", None, silence).server_wait(None) for silence in (60, 7, None)]
    assert waits == [10, 3, 10]
    assert endpoint.server_wait(4.9) == 4


# --- what is none of COW's ---


def test_what_a_job_failed_with_is_raised(hurried: Connect) -> None:
    failed = {**JOB, "status": "failed", "problem": told("cannot-ground", 422, "Why.", errors=[]).body}
    with Scripted(ACCEPTED, Reply(200, failed, {"x-request-id": "r-8"}), CANCELED) as server:
        handle = hurried(server.url).submit(IMAGE, QUESTION)
        with refused("cannot-ground") as caught:
            handle.wait()
        assert isinstance(caught.value, errors.CannotGround)
        assert (caught.value.detail, caught.value.request_id) == ("Why.", "r-8")
        with refused("canceled"):
            handle.wait()


def test_a_code_of_a_later_version_is_a_plain_error_with_that_code(hurried: Connect) -> None:
    more = {"usage": {"calls": 3}, "refusal": {"missing": ["object"]}, "remedy": "Wait.", "moon": 1}
    with Scripted(told("moon-too-full", 418, "It is.", **more)) as server, refused("moon-too-full") as caught:
        hurried(server.url).models()
    error = caught.value
    assert type(error) is CowError
    assert (error.status, error.detail, error.remedy) == (418, "It is.", "Wait.")
    assert (error.usage, error.refusal) == (more["usage"], more["refusal"])


ODD: list[dict[str, Any]] = [
    {"type": "urn:cow:problem:queue-full", "status": "many", "errors": 7, "detail": None, "title": "Full."},
    {"errors": ["x", {"pointer": None}], "usage": 3, "refusal": []},
]
PROBLEM = {"content-type": "Application/Problem+JSON; charset=utf-8"}


def test_what_is_none_of_cows_is_a_bad_response_and_an_odd_problem_a_problem(hurried: Connect) -> None:
    pages = [Reply(200, b"<html>log in here</html>", PAGE), Reply(200, [1]), Reply(200, {"readers": 3})]
    pages += [Reply(418, b"not json", PROBLEM), Reply(418, b"[]", PROBLEM)]
    for reply in (*pages, Reply(200, b"none", {"content-encoding": "gzip"})):
        with Scripted(reply) as server, refused("bad-response"):
            hurried(server.url).models()
        assert len(server.asked) == 1
    for problem in ODD:
        with Scripted(Reply(400, problem, PROBLEM)) as server, pytest.raises(CowError) as caught:
            hurried(server.url, retries=0).models()
        assert caught.value.detail == problem.get("title", "")
        assert not isinstance(caught.value, errors.BadResponse)


def test_a_job_whose_result_cannot_be_read_is_a_bad_response(hurried: Connect) -> None:
    results = [None, {}, {**SIMULATION, "frames": "many"}, [1]]
    with Scripted(Reply(200, JOB), *(Reply(200, {**DONE, "result": result}) for result in results)) as server:
        handle = hurried(server.url).job("j-1")
        for _ in results:
            with refused("bad-response"):
                handle.wait()


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
        event("queued", 101, JOB),  # after the end: never heard
    )
    with Scripted(Reply(200, JOB), begun, BROKEN, told("shutting-down", 503), stream(), rest) as server:
        handle = hurried(server.url, retries=4).job("j-1")
        heard = [(one.name, one.number) for one in handle.events()]
        assert heard == [("queued", 1), ("running", 2), ("progress", None), ("stage", 3), ("succeeded", 100)]
        assert handle.job.status == "succeeded"
    assert [asked.headers.get("last-event-id") for asked in server.asked[1:]] == [None, "2", "2", "2", "2"]
    assert server.asked[1].headers["accept"] == "text/event-stream"
    assert len(hurried.slept) == 4


def test_events_after_a_number_of_a_job_that_is_deleted_and_before_their_end(hurried: Connect) -> None:
    replies = [stream(event("canceled", 100, JOB)), Reply(204, b""), stream(event("deleted", 100, None))]
    with Scripted(Reply(200, JOB), *replies, stream(event("queued", 1, JOB))) as server:
        handle = hurried(server.url).job("j-1")
        assert [one.number for one in handle.events(after=3)] == [100]
        assert list(handle.events(after=100)) == []
        assert [(one.name, one.job) for one in handle.events()] == [("deleted", None)]
        events = handle.events()
        assert next(events).name == "queued"
        events.close()
    assert [asked.headers.get("last-event-id") for asked in server.asked] == [None, "3", "100", None, None]


def test_a_stream_that_breaks_again_and_again_is_given_up(hurried: Connect) -> None:
    for reply in (BROKEN, stream(), stream(cut=True)):
        with Scripted(Reply(200, JOB), reply) as server:
            handle = hurried(server.url, retries=2).job("j-1")
            with refused("server-unreachable") as caught:
                list(handle.events())
        assert "/jobs/j-1/events" in caught.value.detail
        assert len(server.asked) == 1 + 3


def test_events_that_cannot_be_had(hurried: Connect) -> None:
    odd = [Reply(200, b"<html>", PAGE), stream("event: queued\ndata: {broken"), stream(event("queued", 1, {"id": 3}))]
    for code, reply in (("job-not-found", told("job-not-found", 404)), *(("bad-response", reply) for reply in odd)):
        with Scripted(Reply(200, JOB), reply) as server:
            handle = hurried(server.url).job("j-1")
            with refused(code):
                list(handle.events())
        assert len(server.asked) == 2


# --- who is asked, and how ---


def test_addresses_and_keys_that_are_none(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    for address in ("127.0.0.1:8000", "ftp://x", "http://", "https:///path", "http://[x", "http://x:99999", "http://x?a=1",
                    "http://x#y", "http://x\n", "http://x y"):  # fmt: skip
        with pytest.raises(ValueError, match="base_url"):
            connect(address)
    monkeypatch.setenv("COW_BASE_URL", "ftp://x")
    with pytest.raises(ValueError, match="base_url"):
        connect()
    for key in ("cow_secret\n", "cow secret", "sécret"):
        with pytest.raises(ValueError, match="api_key") as raised:
            connect("http://x:65535", api_key=key)
        assert "cret" not in str(raised.value)


def test_address_and_key_come_from_the_environment(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    with Scripted(MODELS) as server:
        monkeypatch.setenv("COW_BASE_URL", server.url + "/")
        monkeypatch.setenv("COW_API_KEY", "cow_env")
        assert connect().base_url == server.url
        connect().models()
        connect(api_key="cow_own").models()
        connect(server.url + "/behind/").models()
        connect(api_key="").models()
        monkeypatch.delenv("COW_API_KEY")
        connect().models()
    sent = [asked.headers.get("authorization") for asked in server.asked]
    assert sent == ["Bearer cow_env", "Bearer cow_own", "Bearer cow_env", None, None]
    assert server.lines[2] == "GET /behind/models"
    assert server.asked[0].headers["user-agent"] == f"cow-service/{__version__}"
    monkeypatch.delenv("COW_BASE_URL")
    assert connect().base_url == "http://127.0.0.1:8000"


def test_an_http_client_of_ones_own(hurried: Connect) -> None:
    asked: list[httpx.Request] = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request)
        if len(asked) == 1:
            raise httpx.ConnectError("not yet")
        return httpx.Response(200, json=SIMULATION)

    own = {"X-Tenant": "t-1", "Authorization": "Basic abc"}
    with httpx.Client(transport=httpx.MockTransport(answer), headers=own, base_url="http://elsewhere") as http:
        with hurried("https://cow.example/api", http_client=http) as client:
            assert client.simulate(IMAGE, QUESTION, fresh=True, timeout=3).id == "j-1"
        assert not http.is_closed
        hurried("https://cow.example", http_client=http, api_key="k").simulate(IMAGE, QUESTION)
    assert [str(request.url) for request in asked[:2]] == ["https://cow.example/api/simulate"] * 2
    sent = [asked[1].headers.get(name) for name in ("x-tenant", "authorization", "cache-control")]
    assert sent == ["t-1", "Basic abc", "no-cache"]
    assert asked[0].extensions["timeout"]["read"] == 4  # a little more than the caller waits
    assert asked[2].headers["authorization"] == "Bearer k"


def test_the_environments_proxies_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    with Scripted(MODELS) as proxy:
        monkeypatch.setenv("http_proxy", proxy.url)
        with Client("http://cow.example") as client:
            client.models()
        with refused("server-unreachable"):  # it has closed the HTTP client that it made
            client.models()
    assert proxy.lines == ["GET http://cow.example/models"]


# --- callers who leave ---


@pytest.mark.parametrize("kind", ["sync", "async"])
@pytest.mark.parametrize("when", ["before its job is known", "when the server is gone", "while it looks at the job"])
def test_a_call_that_is_broken_off_ends_its_job(kind: str, when: str) -> None:
    """Ctrl-C; where the first request waits, the server may have made a job of it, or may be gone."""
    reached, left = threading.Event(), threading.Event()
    known = when == "while it looks at the job"

    def held(asked: Asked) -> Reply:
        if asked.method == "GET":
            reached.set()
            return Reply(200, JOB)
        if asked.headers.get("prefer", "").startswith("wait=") and not known:
            reached.set()
            left.wait(TIME_LIMIT)
            return BROKEN
        return BROKEN if when == "when the server is gone" else ACCEPTED if asked.path == "/simulate" else CANCELED

    with Scripted(held) as server:
        _leave(kind, server.url, reached)
        left.set()
    posts = [line for line in server.lines if line.startswith("POST")]
    assert posts == ["POST /simulate"] * (2 - known) + ["POST /jobs/j-1/cancel"] * (when != "when the server is gone")
    if not known:
        first, second = server.asked[:2]
        assert first.headers["idempotency-key"] == second.headers["idempotency-key"]
        assert second.headers["prefer"] == "respond-async"


def _leave(kind: str, url: str, when: threading.Event) -> None:
    """Interrupts a simulation at that moment, as a person at a terminal or a canceled task does."""
    if kind == "async":

        async def ask() -> None:
            async with AsyncClient(url) as client:
                task = asyncio.create_task(client.simulate(IMAGE, QUESTION))
                await asyncio.to_thread(when.wait, TIME_LIMIT)
                task.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await task

        asyncio.run(ask())
        return

    def interrupt() -> None:
        when.wait(TIME_LIMIT)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    with Client(url) as client:
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            client.simulate(IMAGE, QUESTION)
    thread.join()


def test_a_task_that_is_canceled_twice_ends_its_job_all_the_same() -> None:
    """As anyio's cancel scopes do, whose every `await` is canceled; the client is closed once the server knows."""
    looked, ending, ended = threading.Event(), threading.Event(), threading.Event()

    def held(asked: Asked) -> Reply:
        if asked.method == "GET":
            looked.set()
            return Reply(200, JOB)
        if asked.path == "/simulate":
            return ACCEPTED
        ending.set()
        time.sleep(0.2)  # long enough for a client that does not wait to leave
        ended.set()
        return CANCELED

    async def ask(url: str) -> None:
        async with AsyncClient(url) as client:
            task = asyncio.create_task(client.simulate(IMAGE, QUESTION))
            await asyncio.to_thread(looked.wait, TIME_LIMIT)
            task.cancel()
            await asyncio.to_thread(ending.wait, TIME_LIMIT)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        assert ended.is_set()

    with Scripted(held) as server:
        asyncio.run(ask(server.url))


def test_a_progress_function_that_raises_ends_the_job(hurried: Connect) -> None:
    def fail(_: Any) -> None:
        raise RuntimeError("enough")

    with Scripted(ACCEPTED, Reply(200, JOB), CANCELED) as server:
        with pytest.raises(RuntimeError, match="enough"):
            hurried(server.url).simulate(IMAGE, QUESTION, progress=fail)
        assert server.lines == ["POST /simulate", "GET /jobs/j-1", "POST /jobs/j-1/cancel"]
        wrong: Any = "bar"
        with pytest.raises(ValueError, match="progress"):
            hurried(server.url).simulate(IMAGE, QUESTION, progress=wrong)
    assert len(server.asked) == 3


# --- the event loop's own ---


def test_an_async_client_hears_events_and_pauses_between_looks() -> None:
    async def ask(url: str) -> None:
        async with AsyncClient(url) as client:
            handle = await client.job("j-1")
            assert [one.name async for one in handle.events()] == ["queued", "succeeded"]
            with refused("bad-response"):
                _ = [one async for one in handle.events()]
            began = time.monotonic()
            await handle.wait()
            assert time.monotonic() - began >= 0.1

    replies = [stream(event("queued", 1, JOB), event("succeeded", 100, JOB)), Reply(200, b"<html>", PAGE)]
    with Scripted(Reply(200, JOB), *replies, Reply(200, JOB), Reply(200, DONE)) as server:
        asyncio.run(ask(server.url))
