"""Durable jobs and the HTTP contract around them, asked of real servers that are stopped, killed and started again."""

from __future__ import annotations

import json
import re
import socket
import sqlite3
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from datetime import datetime, timedelta
from itertools import groupby
from typing import Any
from uuid import uuid4

import cv2
import httpx
import numpy as np
import pytest
from conftest import SCALE
from drawn import png_bytes
from hypothesis import HealthCheck, given
from hypothesis import settings as trying
from hypothesis import strategies as st
from servers import (
    ASYNC,
    BODY,
    IMAGE,
    QUESTION,
    TERMINAL,
    Served,
    data_url,
    events_of,
    parsed,
    picture,
    plain,
    problem,
    slow,
)
from waiting import eventually

from cow_service.records import Job, JobPage, Simulation

STAGES = ["grounding", "motion", "trajectory", "generation"]
LOST = {**BODY, "grounding": None, "motion": None, "question": "If the pink car turns, what happens?"}
FRESH = {"Cache-Control": "no-cache"}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with Served(tmp_path_factory.mktemp("served"), COW_WORKERS="true") as one:
        yield one


@pytest.fixture(scope="module")
def tight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """One clip at a time, two jobs at hand, three in all."""
    own = {
        "COW_CONCURRENCY": "1",
        "COW_MLLM_CONCURRENCY": "1",
        "COW_GENERATOR_CONCURRENCY": '{"slow": 1}',
        "COW_QUEUE_LIMIT": "3",
    }
    with Served(tmp_path_factory.mktemp("tight"), **own) as one:
        yield one


@pytest.fixture
def emptied(tight: Served) -> Iterator[Served]:
    """The tight server, and afterwards none of its jobs is open."""
    yield tight
    for job in tight.http.get("/jobs", params={"status": ["queued", "running"]}).json()["jobs"]:
        tight.http.post(f"/jobs/{job['id']}/cancel")


def new_key() -> str:
    return uuid4().hex


def ids(page: httpx.Response) -> list[str]:
    assert page.status_code == 200, page.text
    return [job["id"] for job in JobPage.model_validate(page.json()).model_dump()["jobs"]]


# --- Prefer ---


def test_respond_async(served: Served) -> None:
    response = served.http.post("/simulate", json=BODY, headers=ASYNC)
    assert response.status_code == 202
    job = Job.model_validate(response.json())
    assert response.headers["location"] == f"/jobs/{job.id}"
    assert int(response.headers["retry-after"]) >= 1
    assert response.headers["preference-applied"] == "respond-async"
    assert (job.kind, job.generator, job.problem) == ("simulate", "cutout", None)
    done = served.ended(job.id)
    assert (done["status"], done["progress"], done["stage"]) == ("succeeded", 1, None)
    Job.model_validate(done)
    assert done["result"]["id"] == job.id
    assert done["result"]["created_at"] == done["created_at"] == job.created_at


def test_the_result_of_a_job_is_what_a_caller_who_waits_gets(served: Served) -> None:
    job = served.ended(served.submit(BODY, **FRESH)["id"])
    response = served.http.post("/simulate", json=BODY, headers=FRESH)
    assert response.status_code == 200
    assert plain(response.json()) == plain(job["result"])
    Simulation.model_validate(job["result"])


def test_wait_is_long_enough(served: Served) -> None:
    response = served.http.post("/simulate", json=BODY, headers={"Prefer": "respond-async, wait=50"})
    assert response.status_code == 200
    assert response.json()["frames"]


@pytest.mark.slow
def test_wait_is_too_short(served: Served) -> None:
    response = served.http.post("/simulate", json=slow(30, seed=1), headers={"Prefer": "wait=1"})
    assert response.status_code == 202
    assert response.headers["preference-applied"] == "wait=1"
    job = response.json()
    assert response.headers["location"] == f"/jobs/{job['id']}"
    assert job["status"] in ("queued", "running")
    assert served.http.post(f"/jobs/{job['id']}/cancel").json()["status"] == "canceled"


@pytest.mark.parametrize(
    "prefer", ["wait=0", "respond-async; x=1, wait=0", "handling=strict, respond-async", 'wait="0"']
)
def test_not_waiting_at_all(served: Served, prefer: str) -> None:
    response = served.http.post("/simulate", json=slow(0.01, seed=2), headers={"Prefer": prefer})
    assert response.status_code == 202
    assert served.ended(response.json()["id"])["status"] == "succeeded"


@pytest.mark.parametrize(
    "prefer", ["wait=", "wait=soon", "wait=-1", "wait=1.5", "=", ",;,", "respondasync", "wait=٣", "a" * 5000]
)
def test_a_preference_that_is_none_is_ignored(served: Served, prefer: str) -> None:
    response = served.http.post("/simulate", json=BODY, headers={"Prefer": prefer.encode()})  # type: ignore[dict-item]
    assert response.status_code == 200
    assert "preference-applied" not in response.headers


def test_two_headers_are_one_list_and_the_first_of_a_name_counts(served: Served) -> None:
    headers = [("Prefer", "wait=0"), ("Prefer", "wait=100, respond-async")]
    response = served.http.post("/simulate", json=BODY, headers=headers)
    assert response.status_code == 202
    assert response.headers["preference-applied"] == "respond-async, wait=0"


# --- a job's way ---


@pytest.mark.slow
def test_a_job_goes_its_way_in_order(emptied: Served) -> None:
    first = [emptied.submit(slow(1, seed=seed))["id"] for seed in (10, 11)]
    last = emptied.submit(slow(0.5, seed=12, image=data_url(picture(3))))
    assert (last["status"], last["stage"], last["progress"]) == ("queued", None, 0)
    seen: list[tuple[str, str | None, float]] = []

    def look() -> bool:
        job = emptied.job(last["id"])
        seen.append((job["status"], job["stage"], job["progress"]))
        return job["status"] in TERMINAL

    eventually(look)
    statuses = [status for status, _, _ in seen]
    assert [status for status, _ in groupby(statuses)] == ["queued", "running", "succeeded"]
    stages = [stage for status, stage, _ in seen if status == "running"]
    assert stages == sorted(stages, key=STAGES.index)
    assert "generation" in stages
    progress = [done for _, _, done in seen]
    assert progress == sorted(progress)
    assert progress[0] == 0
    assert progress[-1] == 1
    assert [emptied.ended(job)["status"] for job in first] == ["succeeded"] * 2


def test_a_job_is_never_done_before_it_came(served: Served) -> None:
    for _ in range(3):
        job = served.ended(served.submit(BODY)["id"])
        assert job["created_at"] <= job["finished_at"]


def test_a_failed_job_keeps_its_problem(served: Served) -> None:
    response = served.http.post("/simulate", json=LOST)
    told = problem(response, 422, "cannot-ground")
    job = served.ended(served.submit(LOST)["id"])
    Job.model_validate(job)
    assert (job["status"], job["result"]) == ("failed", None)
    assert job["problem"] == told
    (listed,) = [
        one for one in served.http.get("/jobs", params={"status": "failed"}).json()["jobs"] if one["id"] == job["id"]
    ]
    assert listed["problem"] == told
    key, replayed = new_key(), []
    for _ in range(2):
        again = served.http.post("/simulate", json=LOST, headers={"Idempotency-Key": key})
        replayed.append(again.headers.get("idempotent-replayed"))
        assert problem(again, 422, "cannot-ground") == told
    assert replayed == [None, "true"]


def test_what_can_be_told_at_once_makes_no_job(served: Served) -> None:
    before = ids(served.http.get("/jobs", params={"limit": 500}))
    bad = {**BODY, "generator_options": {"clean_cues": "perhaps"}}
    problem(served.http.post("/simulate", json=bad, headers=ASYNC), 422, "invalid-request")
    gone = {**BODY, "image": {"artifact": "0" * 64}}
    problem(served.http.post("/simulate", json=gone, headers=ASYNC), 404, "artifact-not-found")
    assert ids(served.http.get("/jobs", params={"limit": 500})) == before


@pytest.mark.parametrize(
    "call",
    ["GET /jobs/{}", "GET /jobs/{}/request", "GET /jobs/{}/events", "POST /jobs/{}/cancel", "DELETE /jobs/{}"],
)
def test_there_is_no_such_job(served: Served, call: str) -> None:
    method, path = call.split()
    for name in (str(uuid4()), "x", "0" * 64):
        problem(served.http.request(method, path.format(name)), 404, "job-not-found")
    for name in ("a" * 65, "a_b", "%C3%A4", f"{uuid4()}.webhook.1"):
        problem(served.http.request(method, path.format(name)), 422, "invalid-request")


def test_the_request_of_a_job_can_be_sent_again(served: Served) -> None:
    mask = np.zeros((160, 240), np.uint8)
    mask[60:98, 170:205] = 255
    cube = {"object": "blue cube", "role": "obstacle"}
    body = {**BODY, "objects": [{**cube, "mask": data_url(png_bytes(mask))}], "priority": "low", "question": "?" * 300}
    job = served.ended(served.submit(body)["id"])
    assert (job["question"], job["image"]) == (body["question"], job["result"]["image"]["sha256"])
    assert served.http.get("/jobs", params={"limit": 1}).json()["jobs"][0] | {"result": job["result"]} == job | {
        "question": "?" * 199 + "…"
    }
    told = served.http.get(f"/jobs/{job['id']}/request").json()
    digest = told["request"]["objects"][0]["mask"]["artifact"]
    artifacts = {"image": {"artifact": job["image"]}, "objects": [{**cube, "mask": {"artifact": digest}}]}
    assert told == {"kind": "simulate", "request": {**body, **artifacts}}
    again = served.ended(served.submit(told["request"])["id"])
    assert plain(again["result"]) == plain(job["result"]) | {"usage": again["result"]["usage"]}
    assert again["result"]["reused"] == STAGES
    assert served.http.get(f"/jobs/{again['id']}/request").json() == told


# --- GET /jobs ---


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, list[dict[str, Any]]]]:
    """A server with 24 jobs of every sort, and these, oldest first."""
    with Served(tmp_path_factory.mktemp("many")) as one:
        made = []
        for number in range(24):
            sort = number % 4
            body = (BODY, LOST, {**BODY, "question": f"{QUESTION} A) Yes B) No"}, slow(600, seed=number))[sort]
            job = one.submit(body, path="/answer" if sort == 2 else "/simulate")
            made.append(job)
            if sort == 3:
                one.http.post(f"/jobs/{job['id']}/cancel")
        yield one, [one.ended(job["id"]) for job in made]


def test_jobs_are_listed_newest_first_as_they_are(many: tuple[Served, list[dict[str, Any]]]) -> None:
    served, made = many
    listed = served.http.get("/jobs").json()
    assert listed["next"] is None
    assert listed["jobs"] == [{**job, "result": None} for job in reversed(made)]


@pytest.mark.parametrize(
    "asked",
    [
        {"status": "succeeded"},
        {"status": ["failed", "canceled"]},
        {"status": ["queued", "running"]},
        {"kind": "answer"},
        {"kind": "simulate", "status": "succeeded"},
        {"status": ["succeeded", "succeeded"], "kind": "answer", "limit": 500},
    ],
)
def test_filters(many: tuple[Served, list[dict[str, Any]]], asked: dict[str, Any]) -> None:
    served, made = many
    statuses = asked.get("status", TERMINAL)
    wanted = [
        job["id"]
        for job in reversed(made)
        if job["status"] in statuses and asked.get("kind", job["kind"]) == job["kind"]
    ]
    assert ids(served.http.get("/jobs", params=asked)) == wanted
    assert all_pages(served, {**asked, "limit": 2}) == wanted


def test_times_are_included_to_the_millisecond(many: tuple[Served, list[dict[str, Any]]]) -> None:
    served, made = many
    for first, last in ((0, 23), (5, 5), (3, 17), (12, 12), (22, 23)):
        after, before = made[first]["created_at"], made[last]["created_at"]
        wanted = [job["id"] for job in reversed(made) if after <= job["created_at"] <= before]
        asked = {"created_after": after, "created_before": before}
        assert ids(served.http.get("/jobs", params=asked)) == wanted
        assert all_pages(served, {**asked, "limit": 3}) == wanted
        elsewhere = {"created_after": in_tokyo(after), "created_before": in_tokyo(before)}
        assert ids(served.http.get("/jobs", params=elsewhere)) == wanted
    just_after = in_tokyo(made[7]["created_at"], milliseconds=1)
    assert ids(served.http.get("/jobs", params={"created_after": just_after})) == [
        job["id"] for job in reversed(made) if job["created_at"] > made[7]["created_at"]
    ]


def in_tokyo(moment: str, **later: int) -> str:
    return (datetime.fromisoformat(moment) + timedelta(**later)).isoformat().replace("+00:00", "Z")


@pytest.mark.parametrize(
    "moment",
    [
        "0001-01-01T00:00:00+14:00",
        "9999-12-31T23:59:59-14:00",
        "1969-12-31T23:59:59Z",
        "1970-01-01T00:00:00Z",
        "2500-01-01T00:00:00Z",
    ],
)
def test_times_at_the_ends_of_the_calendar(many: tuple[Served, list[dict[str, Any]]], moment: str) -> None:
    served, made = many
    everything = [job["id"] for job in reversed(made)]
    early = moment < "2000"
    assert ids(served.http.get("/jobs", params={"created_after": moment})) == (everything if early else [])
    assert ids(served.http.get("/jobs", params={"created_before": moment})) == ([] if early else everything)
    if not early:
        assert all_pages(served, {"created_before": moment, "limit": 10}) == everything


@pytest.mark.parametrize(
    "asked",
    [
        {"status": "done"},
        {"status": ["queued", ""]},
        {"kind": "dream"},
        {"limit": 0},
        {"limit": 501},
        {"limit": "all"},
        {"created_after": "yesterday"},
        {"created_before": "2026-01-01T00:00:00"},  # where?
        {"cursor": ""},
        {"cursor": "x" * 40_001},
        {"cursor": "W10"},  # []
        {"cursor": "WzEsMl0"},  # [1,2]
        {"cursor": "WzFlMzAwLFtdXQ"},  # [1e300,[]]
        {"cursor": "Wy0xZTE4LFtdXQ"},  # [-1e18,[]]
        {"cursor": "W05hTixbXV0"},  # [NaN,[]]
        {"cursor": "Ä"},
    ],
)
def test_bad_questions(many: tuple[Served, list[dict[str, Any]]], asked: dict[str, Any]) -> None:
    problem(many[0].http.get("/jobs", params=asked), 422, "invalid-request")


def test_a_cursor_and_a_time_together(many: tuple[Served, list[dict[str, Any]]]) -> None:
    served, made = many
    page = served.http.get("/jobs", params={"limit": 4}).json()
    asked = {"cursor": page["next"], "created_before": made[10]["created_at"], "limit": 100}
    assert ids(served.http.get("/jobs", params=asked)) == [
        job["id"] for job in reversed(made) if job["created_at"] <= made[10]["created_at"]
    ]


def test_random_cursors_are_refused(many: tuple[Served, list[dict[str, Any]]]) -> None:
    http = many[0].http
    known = http.get("/jobs", params={"limit": 4}).json()["next"]
    places = st.integers(0, len(known) - 1)
    damaged = st.builds(lambda at, new: known[:at] + new + known[at + 1 :], places, st.characters(codec="utf-8"))

    @given(cursor=st.one_of(st.text(st.characters(codec="utf-8"), min_size=1, max_size=60), damaged))
    @trying(max_examples=60, suppress_health_check=list(HealthCheck))
    def check(cursor: str) -> None:
        response = http.get("/jobs", params={"cursor": cursor})
        if response.status_code != 200:  # by chance it may be one that can be read
            problem(response, 422, "invalid-request")

    check()


def all_pages(
    served: Served, asked: dict[str, Any], between: Callable[[list[str]], None] = lambda _: None
) -> list[str]:
    """The ids of all pages together."""
    listed: list[str] = []
    cursor: dict[str, str] = {}
    while True:
        response = served.http.get("/jobs", params={**asked, **cursor})
        shown = ids(response)
        assert len(shown) <= asked["limit"]
        listed += shown
        if response.json()["next"] is None:
            return listed
        assert len(shown) == asked["limit"]
        cursor = {"cursor": response.json()["next"]}
        between(listed)


@pytest.mark.parametrize("limit", [1, 3, 5, 24, 25])
def test_all_pages_together_list_every_job_once_in_order(many: tuple[Served, list[dict[str, Any]]], limit: int) -> None:
    served, made = many
    assert all_pages(served, {"limit": limit}) == [job["id"] for job in reversed(made)]


@pytest.mark.slow
def test_jobs_that_come_and_go_between_pages_hide_no_others(tmp_path_factory: pytest.TempPathFactory) -> None:
    with Served(tmp_path_factory.mktemp("coming")) as one:

        @given(data=st.data(), limit=st.integers(1, 6), count=st.integers(1, 12))
        @trying(max_examples=6 * SCALE, suppress_health_check=list(HealthCheck))
        def check(data: st.DataObject, limit: int, count: int) -> None:
            made = [one.submit(BODY)["id"] for _ in range(count)]
            for job in made:
                one.ended(job)
            deleted: set[str] = set()

            def between(listed: list[str]) -> None:
                left = [job for job in made if job not in deleted]
                for job in data.draw(st.lists(st.sampled_from(left), max_size=2, unique=True)) if left else []:
                    assert one.http.delete(f"/jobs/{job}").status_code == 204
                    deleted.add(job)
                if data.draw(st.booleans()):
                    one.submit(BODY)

            listed = [job for job in all_pages(one, {"limit": limit}, between) if job in made]
            assert len(set(listed)) == len(listed)
            assert set(made) - deleted <= set(listed)
            order = [job for job in reversed(made) if job in listed]
            assert listed == order
            for job in ids(one.http.get("/jobs", params={"limit": 500})):
                one.ended(job)
                one.http.delete(f"/jobs/{job}")

        check()


# --- events ---


def numbers(events: list[dict[str, Any]]) -> list[int]:
    return [int(event["id"]) for event in events if "id" in event]


def lasting(events: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Without progress, which is reported once."""
    return [event for event in events if "id" in event]


@pytest.mark.slow
def test_the_events_of_a_job(served: Served) -> None:
    job = served.submit(slow(0.6, seed=20, image=data_url(picture(5))))
    events = events_of(served.http.get(f"/jobs/{job['id']}/events"))
    names = [event["event"] for event in lasting(events)]
    stages = [event["data"]["stage"] for event in events if event["event"] == "stage"]
    assert names == ["queued", "running", *["stage"] * len(stages), "succeeded"]
    assert numbers(events) == [*range(1, len(names)), 100]
    assert stages == sorted(stages, key=STAGES.index)
    assert stages[-1] == "generation"
    told = [event["data"]["progress"] for event in events if event["event"] == "progress"]
    assert told
    assert told == sorted(told)
    for event in events:
        Job.model_validate(event["data"])
        assert event["data"]["id"] == job["id"]
        assert event["data"]["result"] is None
        assert (event["data"]["finished_at"] is None) == (event["event"] != "succeeded")
    again = events_of(served.http.get(f"/jobs/{job['id']}/events"))
    assert [(event["id"], event["event"]) for event in again] == [
        (event["id"], event["event"]) for event in lasting(events)
    ]
    assert {event["data"]["finished_at"] for event in again[:-1]} == {None}


@pytest.mark.parametrize("after", [0, 1, 2, 3, 4, 5, 6, 99])
def test_events_go_on_after_the_last_that_was_heard(served: Served, after: int) -> None:
    job = served.ended(served.submit(BODY)["id"])
    url = f"/jobs/{job['id']}/events"
    whole = events_of(served.http.get(url))
    rest = events_of(served.http.get(url, headers={"Last-Event-ID": str(after)}))
    assert rest == [event for event in whole if int(event["id"]) > after]


@pytest.mark.parametrize("after", ["", "x", "-1", "1.5", "٣", "9" * 5000])
def test_a_last_event_that_is_none_is_the_beginning(served: Served, after: str) -> None:
    job = served.ended(served.submit(BODY)["id"])
    url = f"/jobs/{job['id']}/events"
    told = served.http.get(url, headers={"Last-Event-ID": after.encode()})  # type: ignore[dict-item]
    assert numbers(events_of(told))[0] == 1


def test_who_has_heard_everything_need_not_come_back(served: Served) -> None:
    job = served.ended(served.submit(BODY)["id"])
    response = served.http.get(f"/jobs/{job['id']}/events", headers={"Last-Event-ID": "100"})
    assert (response.status_code, response.content) == (204, b"")


def test_a_failed_job_says_so_at_the_end_of_its_events(served: Served) -> None:
    job = served.submit(LOST)
    last = events_of(served.http.get(f"/jobs/{job['id']}/events"))[-1]
    assert (last["event"], last["id"]) == ("failed", "100")
    assert last["data"]["problem"]["type"] == "urn:cow:problem:cannot-ground"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "path", "ends"), [("POST", "/cancel", {"canceled"}), ("DELETE", "", {"canceled", "deleted"})]
)
def test_whoever_follows_hears_of_the_end(served: Served, method: str, path: str, ends: set[str]) -> None:
    job = served.submit(slow(30, seed=21))
    with served.http.stream("GET", f"/jobs/{job['id']}/events") as response, ThreadPoolExecutor(1) as pool:
        served.rendering(job["id"])
        pool.submit(served.http.request, method, f"/jobs/{job['id']}{path}")
        events = events_of(response)
    assert events[-1]["event"] in ends
    assert events[-1]["id"] == "100"
    assert numbers(events) == sorted(numbers(events))
    if method == "POST":
        again = events_of(served.http.get(f"/jobs/{job['id']}/events"))
        assert numbers(again) == numbers(events)


@pytest.mark.slow
def test_silence_is_filled_with_comments(tmp_path_factory: pytest.TempPathFactory) -> None:
    code = (
        "from cow_service.api.routes import jobs; jobs.PING_SECONDS = 1; "
        "from cow_service.cli.main import app; app(['serve'])"
    )
    with Served(tmp_path_factory.mktemp("pings"), code=code, COW_GENERATOR_CONCURRENCY='{"slow": 1}') as one:
        before = one.submit(slow(30, seed=22))
        waits = one.submit(slow(30, seed=23))
        one.rendering(before["id"])
        with one.http.stream("GET", f"/jobs/{waits['id']}/events") as response:
            lines, comments = [], 0
            for line in response.iter_lines():
                lines.append(line)
                comments += line.startswith(":")
                if comments == 2:
                    one.http.post(f"/jobs/{waits['id']}/cancel")
        assert comments >= 2
        assert parsed("\n".join(lines).strip().split("\n\n")[-1])["event"] == "canceled"


# --- cancel and delete ---


@pytest.mark.slow
def test_a_running_job_is_canceled_and_its_place_is_free_at_once(emptied: Served) -> None:
    job = emptied.submit(slow(30, seed=30))
    emptied.rendering(job["id"])
    canceled = emptied.http.post(f"/jobs/{job['id']}/cancel")
    assert canceled.status_code == 200
    assert (canceled.json()["status"], canceled.json()["result"]) == ("canceled", None)
    started = time.monotonic()
    assert emptied.http.post("/simulate", json=slow(0.1, seed=31)).status_code == 200
    assert time.monotonic() - started < 15  # of 30
    assert emptied.job(job["id"]) == canceled.json()


@pytest.mark.slow
def test_a_queued_job_is_canceled_and_never_begins(emptied: Served) -> None:
    first, second, queued = [emptied.submit(slow(30, seed=seed)) for seed in (32, 33, 34)]
    assert queued["status"] == "queued"
    for job in (queued, first, second):
        assert emptied.http.post(f"/jobs/{job['id']}/cancel").json()["status"] == "canceled"
    assert emptied.http.post("/simulate", json=slow(0.1, seed=35)).status_code == 200
    assert 34 not in emptied.clips()


@pytest.mark.slow
def test_canceling_again_changes_nothing(served: Served) -> None:
    job = served.submit(slow(30, seed=36))
    first = served.http.post(f"/jobs/{job['id']}/cancel").json()
    time.sleep(1.1)  # times may be whole seconds
    assert served.http.post(f"/jobs/{job['id']}/cancel").json() == first
    assert served.job(job["id"]) == first


@pytest.mark.parametrize("body", [BODY, LOST])
def test_a_job_that_has_ended_is_not_canceled(served: Served, body: dict[str, Any]) -> None:
    job = served.ended(served.submit(body)["id"])
    assert served.http.post(f"/jobs/{job['id']}/cancel").json() == job
    assert served.job(job["id"]) == job


def test_cancel_by_many_at_the_same_time(served: Served) -> None:
    job = served.submit(slow(30, seed=37))
    with ThreadPoolExecutor(6) as pool:
        calls = [("POST", f"/jobs/{job['id']}/cancel")] * 5 + [("DELETE", f"/jobs/{job['id']}")]
        statuses = [one.status_code for one in pool.map(lambda call: served.http.request(*call), calls)]
    assert set(statuses) <= {200, 204, 404}
    assert 204 in statuses
    problem(served.http.get(f"/jobs/{job['id']}"), 404, "job-not-found")


@pytest.mark.slow
def test_whoever_waits_for_a_canceled_job_is_told(served: Served) -> None:
    key = new_key()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(served.http.post, "/simulate", json=slow(30, seed=38), headers={"Idempotency-Key": key})
        job = eventually(lambda: served.http.get("/jobs", params={"status": "running"}).json()["jobs"])[0]
        served.rendering(job["id"])
        served.http.post(f"/jobs/{job['id']}/cancel")
        problem(waiting.result(), 409, "canceled")
    again = served.http.post("/simulate", json=slow(30, seed=38), headers={"Idempotency-Key": key})
    problem(again, 409, "canceled")


def test_a_deleted_job_is_gone_with_what_only_it_holds(served: Served) -> None:
    mine = data_url(picture(11))
    kept = served.ended(served.submit({**BODY, "image": mine})["id"])["result"]
    other = served.ended(served.submit({**BODY, "image": mine, "frames": {"count": 3}})["id"])["result"]
    assert "grounding" in other["reused"]
    own = {frame["sha256"] for frame in other["frames"]} - {frame["sha256"] for frame in kept["frames"]}
    assert own
    shared = {kept["image"]["sha256"], kept["grounding"]["mask"]["sha256"], kept["overlay"]["sha256"]}
    shared |= {frame["sha256"] for frame in kept["frames"]}
    response = served.http.delete(f"/jobs/{other['id']}")
    assert (response.status_code, response.content) == (204, b"")
    problem(served.http.get(f"/jobs/{other['id']}"), 404, "job-not-found")
    problem(served.http.delete(f"/jobs/{other['id']}"), 404, "job-not-found")
    assert {served.http.get(f"/artifacts/{sha256}").status_code for sha256 in own} == {404}
    assert {served.http.get(f"/artifacts/{sha256}").status_code for sha256 in shared} == {200}


def test_the_job_that_made_what_others_reuse_may_go(served: Served) -> None:
    mine = data_url(picture(12))
    maker = served.ended(served.submit({**BODY, "image": mine})["id"])["result"]
    user = served.ended(served.submit({**BODY, "image": mine})["id"])["result"]
    assert user["reused"] == STAGES
    served.http.delete(f"/jobs/{maker['id']}")
    for artifact in (*user["frames"], user["overlay"], user["grounding"]["mask"], user["image"]):
        assert served.http.get(f"/artifacts/{artifact['sha256']}").status_code == 200
    anew = served.http.post("/simulate", json={**BODY, "image": {"artifact": user["image"]["sha256"]}}).json()
    assert plain(anew) == plain(user)
    for job in (user, anew):
        served.http.delete(f"/jobs/{job['id']}")
    for artifact in (*user["frames"], user["overlay"], user["grounding"]["mask"], user["image"]):
        problem(served.http.get(f"/artifacts/{artifact['sha256']}"), 404, "artifact-not-found")


def test_after_its_job_is_deleted_a_result_is_made_anew(served: Served) -> None:
    body = {**BODY, "image": data_url(picture(13))}
    first = served.ended(served.submit(body)["id"])["result"]
    served.http.delete(f"/jobs/{first['id']}")
    again = served.http.post("/simulate", json=body).json()
    assert again["reused"] == []
    assert plain(again) == plain(first)
    for frame in again["frames"]:
        assert served.http.get(f"/artifacts/{frame['sha256']}").status_code == 200


@pytest.mark.slow
def test_deleting_a_running_job_ends_it(emptied: Served) -> None:
    job = emptied.submit(slow(30, seed=39))
    emptied.rendering(job["id"])
    assert emptied.http.delete(f"/jobs/{job['id']}").status_code == 204
    problem(emptied.http.get(f"/jobs/{job['id']}"), 404, "job-not-found")
    assert emptied.http.post("/simulate", json=slow(0.1, seed=40)).status_code == 200
    assert job["id"] not in ids(emptied.http.get("/jobs"))


# --- Idempotency-Key ---


@pytest.mark.parametrize("key", ["", "a b", "x" * 256, "ä", "a\tb", "\x7f", "ключ"], ids=lambda key: ascii(key)[:20])
def test_keys_that_are_none(served: Served, key: str) -> None:
    headers = {"Idempotency-Key": key.encode()}
    problem(served.http.post("/simulate", json=BODY, headers=headers), 422, "invalid-request")  # type: ignore[arg-type]


@pytest.mark.parametrize("key", ["x", "x" * 255, "!\"#$%&'()*+,-./:;<=>?@[]^_`{|}~"])
def test_the_same_key_and_body_are_the_same_job(served: Served, key: str) -> None:
    headers = {"Idempotency-Key": key}
    first = served.submit(BODY, **headers)
    done = served.ended(first["id"])
    second = served.http.post("/simulate", json=BODY, headers=headers)
    assert second.status_code == 200
    assert second.json() == done["result"]
    assert served.submit(BODY, **headers) == done
    # The same request in other words.
    form = {
        "question": QUESTION,
        "request": json.dumps({k: v for k, v in BODY.items() if k not in ("image", "question")}),
    }
    third = served.http.post("/simulate", data=form, files={"image": ("a.png", IMAGE)}, headers=headers)
    assert third.json() == done["result"]
    assert served.http.delete(f"/jobs/{first['id']}").status_code == 204


def test_a_key_is_for_one_request(served: Served) -> None:
    key = {"Idempotency-Key": new_key()}
    job = served.submit(BODY, **key)
    for path, body, others in (
        ("/simulate", {**BODY, "seed": 1}, {}),
        ("/simulate", {**BODY, "image": data_url(picture(1))}, {}),
        ("/answer", BODY, {}),
        ("/simulate", BODY, FRESH),
    ):
        for prefer in ({}, ASYNC):
            response = served.http.post(path, json=body, headers=key | others | prefer)
            problem(response, 422, "idempotency-key-reused")
    served.ended(job["id"])
    served.http.delete(f"/jobs/{job['id']}")
    free = served.http.post("/simulate", json={**BODY, "seed": 1}, headers=key)
    assert free.status_code == 200
    assert free.json()["generator"]["seed"] == 1


def test_the_same_key_from_many_at_the_same_time(served: Served) -> None:
    key = {"Idempotency-Key": new_key()}

    def send(number: int) -> str:
        if number % 2:
            return served.http.post("/simulate", json=slow(0.3, seed=50), headers=key).json()["id"]
        return served.submit(slow(0.3, seed=50), **key)["id"]

    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(send, range(8)))) == 1
    assert served.clips().count(50) == 1


@pytest.mark.slow
def test_one_key_with_many_bodies_at_the_same_time_is_one_of_them(served: Served) -> None:
    for turn in range(3):
        key = {"Idempotency-Key": new_key()}
        bodies = [{**BODY, "image": data_url(picture(20 + number)), "seed": turn} for number in range(6)]
        with ThreadPoolExecutor(6) as pool:
            answers = list(
                pool.map(lambda body, key=key: served.http.post("/simulate", json=body, headers=key), bodies)
            )
        assert sorted(answer.status_code for answer in answers) == [200] + [422] * 5
        for answer, body in zip(answers, bodies, strict=True):
            if answer.status_code == 200:
                alone = served.http.post("/simulate", json=body, headers=FRESH)
                assert plain(answer.json()) == plain(alone.json())
            else:
                problem(answer, 422, "idempotency-key-reused")


@pytest.mark.slow
def test_a_key_is_free_as_soon_as_its_running_job_is_deleted(served: Served) -> None:
    """The end of the old job does not notify callers who wait for the new one."""
    key = {"Idempotency-Key": new_key()}
    old = served.submit(slow(20, seed=51), **key)
    served.rendering(old["id"])
    assert served.http.delete(f"/jobs/{old['id']}").status_code == 204
    new = served.http.post("/simulate", json=slow(2, seed=52), headers=key)
    assert new.status_code == 200, new.text
    assert new.json()["id"] == old["id"]
    assert new.json()["generator"]["seed"] == 52
    assert served.job(old["id"])["result"] == new.json()


# --- work is done once ---


def test_the_same_request_again_is_not_worked_on(served: Served) -> None:
    first = served.http.post("/simulate", json={**BODY, "image": data_url(picture(30))}).json()
    second = served.http.post("/simulate", json={**BODY, "image": data_url(picture(30))}).json()
    assert (first["reused"], second["reused"]) == ([], STAGES)
    assert plain(first) == plain(second)
    assert first["id"] != second["id"]


def test_another_seed_is_another_clip_only(served: Served) -> None:
    body = slow(0, seed=60, image=data_url(picture(31)), grounding={"point": [91, 80]})
    assert served.http.post("/simulate", json=body).json()["reused"] == []
    other = served.http.post("/simulate", json={**body, "seed": 61}).json()
    assert other["reused"] == STAGES[:3]
    assert other["generator"]["seed"] == 61


def test_a_clip_is_the_same_whether_its_object_was_found_before_or_not(served: Served) -> None:
    mask = data_url(png_bytes(cv2.circle(np.zeros((160, 240, 3), np.uint8), (93, 80), 12, (255, 255, 255), -1)))
    # What a mask says is not what is cut from its box.
    body = {**BODY, "image": data_url(picture(33)), "grounding": {"mask": mask}}
    first = served.http.post("/simulate", json=body).json()
    other = served.http.post("/simulate", json={**body, "seed": 1}).json()  # which this generator ignores
    assert other["reused"] == STAGES[:3]
    assert other["frames"] == first["frames"]
    more = served.http.post("/simulate", json={**body, "num_frames": 6}, headers=FRESH).json()
    again = served.http.post("/simulate", json={**body, "num_frames": 6}).json()
    assert plain(again) == plain(more)


def test_an_answer_takes_what_a_simulation_came_to(served: Served) -> None:
    body = {**BODY, "image": data_url(picture(32)), "grounding": {"point": [92, 80]}}
    simulation = served.http.post("/simulate", json=body).json()
    answer = served.http.post("/answer", json=body).json()
    assert answer["reused"] == STAGES
    assert plain(answer["simulation"]) == plain(simulation)
    again = served.http.post("/answer", json=body).json()
    assert again["reused"] == [*STAGES, "answering"]
    assert again["simulation"]["id"] != answer["simulation"]["id"]


@pytest.mark.parametrize("said", ["no-cache", "No-Store", "max-age=0, no-cache"])
def test_no_cache_takes_nothing_of_others(served: Served, said: str) -> None:
    assert served.http.post("/simulate", json=BODY).status_code == 200
    assert served.http.post("/simulate", json=BODY, headers={"Cache-Control": said}).json()["reused"] == []
    job = served.ended(served.submit(BODY, **{"Cache-Control": said})["id"])
    assert job["result"]["reused"] == []


@pytest.mark.slow
def test_two_of_the_same_at_the_same_time_are_rendered_once(served: Served) -> None:
    jobs = [served.submit(slow(1, seed=62)) for _ in range(3)]
    results = [served.ended(job["id"])["result"] for job in jobs]
    assert served.clips().count(62) == 1
    assert sorted("generation" in result["reused"] for result in results) == [False, True, True]
    assert len({json.dumps(plain(result)) for result in results}) == 1


@pytest.mark.slow
def test_whoever_waits_for_the_same_goes_on_when_the_first_is_canceled(served: Served) -> None:
    first = served.submit(slow(4, seed=63))
    served.rendering(first["id"])
    second = served.submit(slow(4, seed=63))
    served.http.post(f"/jobs/{first['id']}/cancel")
    assert served.ended(second["id"])["status"] == "succeeded"
    assert served.clips().count(63) == 2


# --- how many ---


@pytest.mark.slow
def test_a_full_queue_takes_no_more(emptied: Served) -> None:
    jobs = [emptied.submit(slow(30, seed=seed)) for seed in (70, 71, 72)]
    for headers in (ASYNC, {}, {"Idempotency-Key": new_key()}):
        response = emptied.http.post("/simulate", json=slow(1, seed=73), headers=headers)
        told = problem(response, 503, "queue-full")
        assert "COW_QUEUE_LIMIT" in told["detail"]
        assert int(response.headers["retry-after"]) >= 1
    with socket.create_connection(emptied.host_and_port, timeout=20) as raw:
        raw.sendall(post(b"x" * 100, length=30_000_000))  # the rest of it is never sent
        answer = raw.makefile("rb").read()  # to its end: an unread body would close the connection
    assert answer.startswith(b"HTTP/1.1 503 ")
    assert b"urn:cow:problem:queue-full" in answer
    emptied.http.post(f"/jobs/{jobs[0]['id']}/cancel")
    assert emptied.submit(slow(30, seed=74))["status"] in ("queued", "running")
    assert 73 not in emptied.clips()


@pytest.mark.slow
def test_a_key_finds_its_job_though_the_queue_is_full(emptied: Served) -> None:
    key = {"Idempotency-Key": new_key()}
    job = emptied.submit(slow(30, seed=75), **key)
    for seed in (76, 77):
        emptied.submit(slow(30, seed=seed))
    assert emptied.submit(slow(30, seed=75), **key)["id"] == job["id"]


# --- callers who leave ---


def post(body: bytes, length: int | None = None, **headers: str) -> bytes:
    told = {"Host": "cow", "Content-Type": "application/json", "Content-Length": str(length or len(body)), **headers}
    head = "".join(f"{name}: {value}\r\n" for name, value in told.items())
    return f"POST /simulate HTTP/1.1\r\n{head}\r\n".encode() + body


@pytest.mark.slow
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, "canceled"),
        (FRESH, "canceled"),
        ({"Prefer": "wait=50"}, "running"),
        ({"Idempotency-Key": "left"}, "running"),
    ],
)
def test_a_caller_who_leaves(served: Served, headers: dict[str, str], status: str) -> None:
    known = ids(served.http.get("/jobs", params={"limit": 500}))
    with socket.create_connection(served.host_and_port) as raw:
        raw.sendall(post(json.dumps(slow(30, seed=80)).encode(), **headers))
        job = eventually(lambda: [one for one in ids(served.http.get("/jobs")) if one not in known])[0]
        served.rendering(job)
    if status == "canceled":
        served.until(job, "canceled")
    else:
        time.sleep(1)
        assert served.job(job)["status"] == "running"
        served.http.post(f"/jobs/{job}/cancel")


# --- stops and crashes ---


@pytest.mark.slow
def test_a_stop_waits_for_what_is_nearly_done(tmp_path_factory: pytest.TempPathFactory) -> None:
    with Served(tmp_path_factory.mktemp("nearly"), COW_SHUTDOWN_GRACE="20") as one, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(one.http.post, "/simulate", json=slow(2, seed=90))
        alone = one.submit(slow(2, seed=91))
        one.rendering(alone["id"])
        eventually(lambda: 90 in one.clips())
        one.stop()
        assert waiting.result().status_code == 200
        one.start()
        assert one.job(alone["id"])["status"] == "succeeded"
        assert sorted(one.clips()) == [90, 91]


@pytest.mark.slow
def test_a_stop_hands_back_what_takes_longer_and_it_goes_on(tmp_path_factory: pytest.TempPathFactory) -> None:
    own = {"COW_SHUTDOWN_GRACE": "0.5", "COW_CONCURRENCY": "1", "COW_MLLM_CONCURRENCY": "1"}
    with Served(tmp_path_factory.mktemp("longer"), **own) as one, ThreadPoolExecutor(4) as pool:
        keys = [{"Idempotency-Key": str(seed)} for seed in (92, 93, 94)]
        # One clip is made at a time: those behind the first wait, however short they are.
        bodies = [slow(3.5, seed=92), slow(0.2, seed=93), slow(0.2, seed=94)]
        waiting: list[Future[httpx.Response]] = []
        for body, key in zip(bodies, keys, strict=True):
            waiting.append(pool.submit(one.http.post, "/simulate", json=body, headers=key))
            eventually(lambda: len(one.http.get("/jobs").json()["jobs"]) == len(waiting) and one.clips())
        alone = one.submit(slow(0.2, seed=95))
        heard: list[str] = []
        follower = pool.submit(hear_until_cut, one, alone["id"], heard)
        eventually(lambda: heard)
        started = time.monotonic()
        one.stop()
        assert time.monotonic() - started < 30
        follower.result()
        assert heard[0].startswith("id: 1\nevent: queued\n")
        for answer in (one.result() for one in waiting):
            problem(answer, 503, "shutting-down")
            assert re.fullmatch("/jobs/[0-9a-f-]{36}", answer.headers["location"])
            assert int(answer.headers["retry-after"]) >= 1
        one.start()
        for answer in (one.result() for one in waiting):
            job = one.ended(answer.headers["location"].removeprefix("/jobs/"))
            assert job["status"] == "succeeded", job
        assert one.ended(alone["id"])["status"] == "succeeded"
        for place, key in enumerate(keys):
            again = one.http.post("/simulate", json=bodies[place], headers=key)
            assert again.status_code == 200
            assert again.json()["generator"]["seed"] == 92 + place


def hear_until_cut(served: Served, job_id: str, heard: list[str]) -> None:
    with suppress(httpx.RemoteProtocolError), served.http.stream("GET", f"/jobs/{job_id}/events") as response:
        for part in response.iter_text():
            heard.append(part)


@pytest.mark.slow
def test_after_a_crash_jobs_go_on_where_they_were(tmp_path_factory: pytest.TempPathFactory) -> None:
    with Served(tmp_path_factory.mktemp("crash"), COW_WORKERS="true") as one:
        key = {"Idempotency-Key": "crash"}
        done = one.ended(one.submit({**BODY, "image": data_url(picture(7))})["id"])
        job = one.submit(slow(3, seed=96), **key)
        one.rendering(job["id"])
        heard = events_until(one, job["id"], "grounding")
        assert numbers(heard) == [1, 2, 3]
        before = stage_results(one, job["id"])
        assert {"grounding", "motion"} <= set(before)
        one.kill()
        one.start()
        assert one.job(done["id"]) == done
        rest = events_of(one.http.get(f"/jobs/{job['id']}/events", headers={"Last-Event-ID": "3"}))
        assert (rest[-1]["event"], lasting(rest)[-2]["data"]["stage"]) == ("succeeded", "generation")
        assert numbers(rest) == [*range(4, 3 + len(lasting(rest))), 100]
        after = one.ended(job["id"])
        assert after["status"] == "succeeded"
        assert after["result"]["generator"]["seed"] == 96
        assert after["result"]["reused"] == []
        assert one.clips().count(96) == 2
        results = stage_results(one, job["id"])
        assert {stage: results[stage] for stage in before} == before  # not made again
        assert one.http.post("/simulate", json=slow(3, seed=96), headers=key).json() == after["result"]


def events_until(served: Served, job_id: str, stage: str) -> list[dict[str, Any]]:
    """The numbered events of a job that still runs, up to the one that says that a stage is done."""
    found: list[dict[str, Any]] = []
    with served.http.stream("GET", f"/jobs/{job_id}/events") as response:
        text = ""
        for part in response.iter_text():
            text += part
            *blocks, text = text.split("\n\n")
            found += [parsed(block) for block in blocks if not block.startswith(":")]
            if any(event["event"] == "stage" and event["data"]["stage"] == stage for event in found):
                break
    return lasting(found)


def stage_results(served: Served, job_id: str) -> dict[str, float]:
    """When each stage that a job came to was kept."""
    with closing(sqlite3.connect(served.data / "jobs.sqlite3")) as database:
        found = database.execute("SELECT stage, created_at FROM cow_results WHERE job_id = ?", (job_id,))
        return dict(found.fetchall())


@pytest.mark.soak
@pytest.mark.slow
def test_two_servers_on_one_data_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("two")
    with Served(folder) as one, Served(folder, log="second") as two:
        job = one.submit(slow(30, seed=97))
        one.rendering(job["id"])
        assert two.http.post(f"/jobs/{job['id']}/cancel").json()["status"] == "canceled"
        assert one.job(job["id"])["status"] == "canceled"
        assert one.http.post("/simulate", json=slow(0.1, seed=98)).status_code == 200
        left = one.submit(slow(3, seed=99))
        one.rendering(left["id"])
        with two.http.stream("GET", f"/jobs/{left['id']}/events") as response:
            one.kill()
            events = events_of(response)
        assert events[-1]["event"] == "succeeded"
        assert two.job(left["id"])["result"]["generator"]["seed"] == 99
