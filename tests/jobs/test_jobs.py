"""Durable jobs and the HTTP contract around them, asked of real servers that are stopped, killed and started again."""

from __future__ import annotations

import json
import re
import socket
import sqlite3
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from datetime import datetime, timedelta, timezone
from typing import Any
from uuid import uuid4

import cv2
import httpx
import numpy as np
import pytest
from callers import as_caller, new_keys
from drawn import png_bytes
from servers import (
    ASYNC,
    BODY,
    IMAGE,
    QUESTION,
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
ENDLESS = 40.0  # seconds that no test waits for; it can be ended after each fortieth of them
SETTINGS, KEYS = new_keys("main", "many")
PINGING = """
from cow_service.api.routes import jobs
jobs.PING_SECONDS = 1
from cow_service.cli.main import app
app(["serve"])
"""


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server for all who ask and change nothing, each with a key."""
    with Served(tmp_path_factory.mktemp("served"), COW_CONCURRENCY="4", **SETTINGS) as one:
        yield one


@pytest.fixture(scope="module")
def served(shared: Served) -> Iterator[Served]:
    with as_caller(shared, KEYS["main"]) as one:
        yield one


@pytest.fixture(scope="module")
def tight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """One clip at a time, two jobs at hand, three in all; a comment after each second of silence."""
    own = {
        "COW_CONCURRENCY": "1",
        "COW_MLLM_CONCURRENCY": "1",
        "COW_GENERATOR_CONCURRENCY": '{"slow": 1}',
        "COW_QUEUE_LIMIT": "3",
        "COW_SHUTDOWN_GRACE": "0.5",
    }
    with Served(tmp_path_factory.mktemp("tight"), code=PINGING, **own) as one:
        yield one


@pytest.fixture
def emptied(tight: Served) -> Iterator[Served]:
    """The tight server, and afterwards none of its jobs is open."""
    yield tight
    for job in open_jobs(tight):
        tight.http.post(f"/jobs/{job}/cancel")


def ids(page: httpx.Response) -> list[str]:
    assert page.status_code == 200, page.text
    return [job.id for job in JobPage.model_validate(page.json()).jobs]


def cancel(served: Served, job: dict[str, Any]) -> dict[str, Any]:
    response = served.http.post(f"/jobs/{job['id']}/cancel")
    assert response.status_code == 200, response.text
    return response.json()


# --- Prefer ---


def test_a_job_is_accepted_and_ends(served: Served) -> None:
    response = served.http.post("/simulate", json=BODY, headers=ASYNC | FRESH)
    assert response.status_code == 202
    job = Job.model_validate(response.json())
    assert response.headers["location"] == f"/jobs/{job.id}"
    assert int(response.headers["retry-after"]) >= 1
    assert response.headers["preference-applied"] == "respond-async"
    assert (job.kind, job.generator, job.problem) == ("simulate", "cutout", None)
    done = served.ended(job.id)
    assert (done["status"], done["progress"], done["stage"]) == ("succeeded", 1, None)
    assert done["result"]["id"] == job.id
    assert done["result"]["created_at"] == done["created_at"] == job.created_at <= done["finished_at"]
    waited = served.http.post("/simulate", json=BODY, headers=FRESH | {"Prefer": "respond-async, wait=50"})
    assert waited.status_code == 200
    assert plain(waited.json()) == plain(done["result"])
    Simulation.model_validate(waited.json())
    assert cancel(served, done) == served.job(job.id) == done, "it has ended"


def test_a_caller_who_waits_too_short_gets_the_job(served: Served) -> None:
    response = served.http.post("/simulate", json=slow(ENDLESS, seed=1), headers={"Prefer": "wait=1"})
    assert response.status_code == 202
    assert response.headers["preference-applied"] == "wait=1"
    assert response.headers["location"] == f"/jobs/{response.json()['id']}"
    assert served.rendering(response.json()["id"])["status"] == "running"
    assert cancel(served, response.json())["status"] == "canceled"


@pytest.mark.parametrize(
    ("prefer", "applied"),
    [
        (["wait=0"], "wait=0"),
        (["handling=strict, respond-async"], "respond-async"),
        (['wait="0"'], "wait=0"),
        (["respond-async; x=1, wait=0", "wait=100, respond-async"], "respond-async, wait=0"),
        *((["wait=" + seconds], None) for seconds in ("", "soon", "-1", "1.5", "٣")),
        *(([none], None) for none in ("=", ",;,", "respondasync", "a" * 5000)),
    ],
    ids=["no wait", "beside another", "quoted", "the first of a name counts", *(["no number"] * 5), *(["none"] * 4)],
)
def test_a_caller_who_does_not_wait(served: Served, prefer: list[str], applied: str | None) -> None:
    response = served.http.post("/simulate", json=BODY, headers=[(b"Prefer", one.encode()) for one in prefer])
    assert response.status_code == (200 if applied is None else 202)
    assert response.headers.get("preference-applied") == applied
    assert applied is None or served.ended(response.json()["id"])["status"] == "succeeded"


# --- a job's way ---


def test_a_failed_job_keeps_its_problem(served: Served) -> None:
    told = problem(served.http.post("/simulate", json=LOST), 422, "cannot-ground")
    job = served.ended(served.submit(LOST)["id"])
    Job.model_validate(job)
    assert (job["status"], job["result"], job["problem"]) == ("failed", None, told)
    assert cancel(served, job) == job
    last = events_of(served.http.get(f"/jobs/{job['id']}/events"))[-1]
    assert (last["event"], last["id"], last["data"]["problem"]) == ("failed", "100", told)
    listed = served.http.get("/jobs", params={"status": "failed"}).json()["jobs"]
    assert [one["problem"] for one in listed if one["id"] == job["id"]] == [told]
    key = {"Idempotency-Key": "lost"}
    first, again = (served.http.post("/simulate", json=LOST, headers=key) for _ in range(2))
    assert problem(first, 422, "cannot-ground") == problem(again, 422, "cannot-ground") == told
    assert [one.headers.get("idempotent-replayed") for one in (first, again)] == [None, "true"]


def test_what_can_be_told_at_once_makes_no_job(served: Served) -> None:
    before = served.http.get("/jobs", params={"limit": 500}).json()
    bad = {**BODY, "generator_options": {"clean_cues": "perhaps"}}
    problem(served.http.post("/simulate", json=bad, headers=ASYNC), 422, "invalid-request")
    gone = {**BODY, "image": {"artifact": "0" * 64}}
    problem(served.http.post("/simulate", json=gone, headers=ASYNC), 404, "artifact-not-found")
    assert served.http.get("/jobs", params={"limit": 500}).json() == before


def test_there_is_no_such_job(served: Served) -> None:
    for method, path in (("GET", ""), ("GET", "/request"), ("GET", "/events"), ("POST", "/cancel"), ("DELETE", "")):
        problem(served.http.request(method, f"/jobs/{uuid4()}{path}"), 404, "job-not-found")
        for name in ("a" * 65, f"{uuid4()}.webhook.1"):
            problem(served.http.request(method, f"/jobs/{name}{path}"), 422, "invalid-request")


def test_the_request_of_a_job_can_be_sent_again(served: Served) -> None:
    mask = np.zeros((160, 240), np.uint8)
    mask[60:98, 170:205] = 255
    cube = {"object": "blue cube", "role": "obstacle"}
    body = {**BODY, "objects": [{**cube, "mask": data_url(png_bytes(mask))}], "priority": "low", "question": "?" * 300}
    job = served.ended(served.submit(body)["id"])
    assert (job["question"], job["image"]) == (body["question"], job["result"]["image"]["sha256"])
    assert job["given"] == ["grounding", "motion", "objects"]
    listed = served.http.get("/jobs", params={"limit": 1}).json()["jobs"][0]
    assert listed == job | {"question": "?" * 199 + "…", "result": None}
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
def many(shared: Served) -> Iterator[tuple[Served, list[dict[str, Any]]]]:
    """A caller with a job of every sort, twice, and these, oldest first."""
    bodies = {"/simulate": [BODY, LOST, slow(ENDLESS)], "/answer": [{**BODY, "question": f"{QUESTION} A) Yes B) No"}]}
    with as_caller(shared, KEYS["many"]) as one:
        made = [one.submit(body, path=path) for _ in range(2) for path, some in bodies.items() for body in some]
        for job in made[2::4]:
            cancel(one, job)
        yield one, [one.ended(job["id"]) for job in made]


def test_jobs_are_listed_newest_first_as_they_are(many: tuple[Served, list[dict[str, Any]]]) -> None:
    served, made = many
    listed = [{**job, "result": None} for job in reversed(made)]
    assert [job["status"] for job in made[:4]] == ["succeeded", "failed", "canceled", "succeeded"]
    assert served.http.get("/jobs").json() == {"jobs": listed, "next": None}
    page = served.http.get("/jobs", params={"limit": 5}).json()
    rest = served.http.get("/jobs", params={"limit": 5, "cursor": page["next"]}).json()
    assert (page["jobs"], rest) == (listed[:5], {"jobs": listed[5:], "next": None})
    for asked, wanted in (
        ({"status": ["failed", "canceled"]}, [6, 5, 2, 1]),
        ({"kind": "answer"}, [7, 3]),
        ({"kind": "simulate", "status": "succeeded"}, [4, 0]),
        ({"created_after": in_tokyo(made[4]), "created_before": in_tokyo(made[6])}, [6, 5, 4]),
    ):
        assert ids(served.http.get("/jobs", params=asked)) == [made[place]["id"] for place in wanted]


def in_tokyo(job: dict[str, Any]) -> str:
    return datetime.fromisoformat(job["created_at"]).astimezone(timezone(timedelta(hours=9))).isoformat()


def test_bad_questions(served: Served) -> None:
    for asked in (
        {"status": ["queued", ""]},
        {"kind": "dream"},
        {"limit": 0},
        {"limit": 501},
        {"created_after": "yesterday"},
        {"created_before": "2026-01-01T00:00:00"},  # where?
        {"cursor": "x" * 40_001},
        {"cursor": "W10"},  # []
    ):
        problem(served.http.get("/jobs", params=asked), 422, "invalid-request")


# --- events ---


def numbers(events: list[dict[str, Any]]) -> list[int]:
    return [int(event["id"]) for event in events if "id" in event]


def lasting(events: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Without progress, which is reported once."""
    return [event for event in events if "id" in event]


@pytest.mark.slow
def test_the_events_of_a_job(served: Served) -> None:
    job = served.submit(slow(3, seed=20, image=data_url(picture(5))))
    url = f"/jobs/{job['id']}/events"
    events = events_of(served.http.get(url))
    told = [(event["event"], event["data"]["stage"]) for event in lasting(events)]
    stages = [("stage", "grounding"), ("stage", "generation")]
    assert told == [("queued", None), ("running", None), *stages, ("succeeded", None)]
    assert numbers(events) == [1, 2, 3, 4, 100]
    progress = [event["data"]["progress"] for event in events if event["event"] == "progress"]
    assert progress
    assert progress == sorted(progress)
    for event in events:
        Job.model_validate(event["data"])
        assert (event["data"]["id"], event["data"]["result"]) == (job["id"], None)
        assert (event["data"]["finished_at"] is None) == (event["event"] != "succeeded")
    again = events_of(served.http.get(url))
    assert [(event["event"], event["data"]["stage"]) for event in again] == told
    for after in (0, 1, 3, 4, 99):  # the last that was heard
        rest = events_of(served.http.get(url, headers={"Last-Event-ID": str(after)}))
        assert rest == [event for event in again if int(event["id"]) > after]
    for none in ("", "x", "-1", "1.5", "٣", "9" * 5000):
        rest = events_of(served.http.get(url, headers=[(b"Last-Event-ID", none.encode())]))
        assert numbers(rest)[0] == 1
    heard_all = served.http.get(url, headers={"Last-Event-ID": "100"})
    assert (heard_all.status_code, heard_all.content) == (204, b""), "nobody need come back"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "path", "ends"), [("POST", "/cancel", {"canceled"}), ("DELETE", "", {"canceled", "deleted"})]
)
def test_whoever_follows_hears_of_the_end(served: Served, method: str, path: str, ends: set[str]) -> None:
    job = served.submit(slow(ENDLESS, seed=21))
    with served.http.stream("GET", f"/jobs/{job['id']}/events") as response, ThreadPoolExecutor(1) as pool:
        served.rendering(job["id"])
        pool.submit(served.http.request, method, f"/jobs/{job['id']}{path}")
        events = events_of(response)
    assert events[-1]["event"] in ends
    assert numbers(events) == [*sorted(numbers(events)[:-1]), 100]
    if method == "POST":
        assert numbers(events_of(served.http.get(f"/jobs/{job['id']}/events"))) == numbers(events)


@pytest.mark.slow
def test_silence_is_filled_with_comments(emptied: Served) -> None:
    emptied.rendering(emptied.submit(slow(ENDLESS, seed=22))["id"])
    waits = emptied.submit(slow(ENDLESS, seed=23))
    with emptied.http.stream("GET", f"/jobs/{waits['id']}/events") as response:
        lines, comments = [], 0
        for line in response.iter_lines():
            lines.append(line)
            comments += line.startswith(":")
            if comments == 2:
                cancel(emptied, waits)
    assert comments >= 2
    assert parsed("\n".join(lines).strip().split("\n\n")[-1])["event"] == "canceled"


# --- cancel and delete ---


@pytest.mark.slow
def test_the_place_of_a_job_that_is_ended_is_free_at_once(emptied: Served) -> None:
    job = emptied.submit(slow(ENDLESS, seed=30))
    emptied.rendering(job["id"])
    behind = [emptied.submit(slow(ENDLESS, seed=seed)) for seed in (31, 32)]
    assert [behind[1][name] for name in ("status", "stage", "progress")] == ["queued", None, 0]
    assert [cancel(emptied, each)["status"] for each in behind] == ["canceled"] * 2
    canceled = cancel(emptied, job)
    assert (canceled["status"], canceled["result"]) == ("canceled", None)
    assert emptied.http.post("/simulate", json=slow(0.1, seed=33)).status_code == 200
    assert emptied.clips()[-2:] == [30, 33], "those in between never began"
    assert cancel(emptied, job) == emptied.job(job["id"]) == canceled, "canceling again changes nothing"
    deleted = emptied.submit(slow(ENDLESS, seed=34))
    emptied.rendering(deleted["id"])
    assert emptied.http.delete(f"/jobs/{deleted['id']}").status_code == 204
    problem(emptied.http.get(f"/jobs/{deleted['id']}"), 404, "job-not-found")
    assert emptied.http.post("/simulate", json=slow(0.1, seed=35)).status_code == 200
    assert deleted["id"] not in ids(emptied.http.get("/jobs"))


@pytest.mark.slow
def test_whoever_waits_for_a_canceled_job_is_told(served: Served) -> None:
    key = {"Idempotency-Key": "canceled"}
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(served.http.post, "/simulate", json=slow(ENDLESS, seed=39), headers=key)
        job = eventually(lambda: served.http.get("/jobs", params={"status": "running"}).json()["jobs"])[0]
        served.rendering(job["id"])
        cancel(served, job)
        problem(waiting.result(), 409, "canceled")
    problem(served.http.post("/simulate", json=slow(ENDLESS, seed=39), headers=key), 409, "canceled")


def shown(result: dict[str, Any]) -> set[str]:
    """The artifacts of a result."""
    return {
        one["sha256"] for one in (*result["frames"], result["overlay"], result["grounding"]["mask"], result["image"])
    }


def found(served: Served, artifacts: set[str]) -> set[int]:
    """The statuses with which some artifacts are answered."""
    return {served.http.get(f"/artifacts/{sha256}").status_code for sha256 in artifacts}


def test_the_job_that_made_what_others_reuse_may_go(served: Served) -> None:
    body = {**BODY, "image": data_url(picture(12))}
    maker = served.http.post("/simulate", json=body).json()
    user = served.http.post("/simulate", json=body).json()
    assert user["reused"] == STAGES
    served.http.delete(f"/jobs/{maker['id']}")
    assert found(served, shown(user)) == {200}
    again = served.http.post("/simulate", json={**body, "image": {"artifact": user["image"]["sha256"]}}).json()
    assert plain(again) == plain(user)
    for job in (user, again):
        served.http.delete(f"/jobs/{job['id']}")
    assert found(served, shown(user)) == {404}
    anew = served.http.post("/simulate", json=body).json()
    assert (anew["reused"], plain(anew)) == ([], plain(maker))
    assert found(served, shown(anew)) == {200}


# --- Idempotency-Key ---


def test_the_same_key_and_body_are_the_same_job(served: Served) -> None:
    for key in ("", "a b", "x" * 256, "ä", "a\tb", "\x7f"):
        none = [(b"Idempotency-Key", key.encode())]
        problem(served.http.post("/simulate", json=BODY, headers=none), 422, "invalid-request")
    for key in ("x" * 255, "!\"#$%&'()*+,-./:;<=>?@[]^_`{|}~"):
        headers = {"Idempotency-Key": key}
        done = served.ended(served.submit(BODY, **headers)["id"])
        second = served.http.post("/simulate", json=BODY, headers=headers)
        assert (second.status_code, second.json()) == (200, done["result"])
        assert served.submit(BODY, **headers) == done
    # The same request in other words.
    rest = {name: value for name, value in BODY.items() if name not in ("image", "question")}
    form = {"question": QUESTION, "request": json.dumps(rest)}
    third = served.http.post("/simulate", data=form, files={"image": ("a.png", IMAGE)}, headers=headers)
    assert third.json() == done["result"]


def test_a_key_is_for_one_request(served: Served) -> None:
    key = {"Idempotency-Key": "one"}
    job = served.submit(BODY, **key)
    for path, body, others in (
        ("/simulate", {**BODY, "seed": 1}, {}),
        ("/simulate", {**BODY, "image": data_url(picture(1))}, ASYNC),
        ("/answer", BODY, {}),
        ("/simulate", BODY, FRESH),
    ):
        problem(served.http.post(path, json=body, headers=key | others), 422, "idempotency-key-reused")
    served.ended(job["id"])
    served.http.delete(f"/jobs/{job['id']}")
    free = served.http.post("/simulate", json={**BODY, "seed": 1}, headers=key)
    assert (free.status_code, free.json()["generator"]["seed"]) == (200, 1)


@pytest.mark.slow
def test_the_same_key_from_many_at_the_same_time_is_one_job(served: Served) -> None:
    key = {"Idempotency-Key": "many"}
    bodies = [slow(0.3, seed=seed) for seed in (50, 53)] * 4

    def send(number: int) -> httpx.Response:
        others = ASYNC if number > 3 else {}
        return served.http.post("/simulate", json=bodies[number], headers=key | others)

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(send, range(8)))
    taken = [place for place, answer in enumerate(answers) if answer.is_success]
    assert taken in ([0, 2, 4, 6], [1, 3, 5, 7]), "the request that came first"
    assert len({answers[place].json()["id"] for place in taken}) == 1
    for refused in (answer for answer in answers if not answer.is_success):
        problem(refused, 422, "idempotency-key-reused")
    assert sum(seed in (50, 53) for seed in served.clips()) == 1


@pytest.mark.slow
def test_a_key_is_free_as_soon_as_its_running_job_is_deleted(served: Served) -> None:
    """It is canceled. Its end does not notify callers who wait for the new one."""

    def canceled() -> float:
        told = re.search(
            r'^cow_jobs_total{kind="simulate",outcome="canceled"} (\S+)', served.http.get("/metrics").text, re.M
        )
        return float(told[1]) if told else 0.0

    before, key = canceled(), {"Idempotency-Key": "free"}
    old = served.submit(slow(ENDLESS, seed=51), **key)
    served.rendering(old["id"])
    assert served.http.delete(f"/jobs/{old['id']}").status_code == 204
    assert canceled() == before + 1
    new = served.http.post("/simulate", json=slow(2, seed=52), headers=key)
    assert new.status_code == 200, new.text
    assert (new.json()["id"], new.json()["generator"]["seed"]) == (old["id"], 52)
    assert served.job(old["id"])["result"] == new.json()


# --- work is done once ---


def test_the_same_request_again_is_not_worked_on(served: Served) -> None:
    body = {**BODY, "image": data_url(picture(30))}
    first, second = (served.http.post("/simulate", json=body).json() for _ in range(2))
    assert (first["reused"], second["reused"]) == ([], STAGES)
    assert plain(first) == plain(second)
    assert first["id"] != second["id"]
    for said in ("No-Store", "max-age=0, no-cache"):
        job = served.ended(served.submit(body, **{"Cache-Control": said})["id"])
        assert job["result"]["reused"] == [], said


def test_a_clip_is_the_same_whether_its_object_was_found_before_or_not(served: Served) -> None:
    mask = data_url(png_bytes(cv2.circle(np.zeros((160, 240, 3), np.uint8), (93, 80), 12, (255, 255, 255), -1)))
    # What a mask says is not what is cut from its box.
    body = {**BODY, "image": data_url(picture(33)), "grounding": {"mask": mask}}
    first = served.http.post("/simulate", json=body).json()
    other = served.http.post("/simulate", json={**body, "seed": 1}).json()  # another clip, which is like the first
    assert (other["reused"], other["frames"]) == (STAGES[:3], first["frames"])
    more = served.http.post("/simulate", json={**body, "num_frames": 6}, headers=FRESH).json()
    assert plain(served.http.post("/simulate", json={**body, "num_frames": 6}).json()) == plain(more)


def test_an_answer_takes_what_a_simulation_came_to(served: Served) -> None:
    body = {**BODY, "image": data_url(picture(32)), "grounding": {"point": [92, 80]}}
    simulation = served.http.post("/simulate", json=body).json()
    answer, again = (served.http.post("/answer", json=body).json() for _ in range(2))
    assert (answer["reused"], again["reused"]) == (STAGES, [*STAGES, "answering"])
    assert plain(answer["simulation"]) == plain(simulation)
    assert again["simulation"]["id"] != answer["simulation"]["id"]


@pytest.mark.slow
def test_two_of_the_same_at_the_same_time_are_rendered_once(served: Served) -> None:
    jobs = [served.submit(slow(1, seed=62)) for _ in range(3)]
    results = [served.ended(job["id"])["result"] for job in jobs]
    assert served.clips().count(62) == 1
    assert sorted("generation" in result["reused"] for result in results) == [False, True, True]
    assert len({json.dumps(plain(result)) for result in results}) == 1


@pytest.mark.slow
def test_whoever_waits_for_the_same_goes_on_when_the_first_is_canceled(served: Served) -> None:
    first = served.submit(slow(ENDLESS, seed=63))
    eventually(lambda: 63 in served.clips())
    second = served.submit(slow(ENDLESS, seed=63))
    served.until(second["id"], "running")
    cancel(served, first)
    eventually(lambda: served.clips().count(63) == 2)
    assert served.job(second["id"])["stage"] == "generation"
    cancel(served, second)


# --- how many ---


@pytest.mark.slow
def test_a_full_queue_takes_no_more(emptied: Served) -> None:
    key = {"Idempotency-Key": "full"}
    jobs = [emptied.submit(slow(ENDLESS, seed=70), **key)]
    jobs += [emptied.submit(slow(ENDLESS, seed=seed)) for seed in (71, 72)]
    for headers in (ASYNC, {}, {"Idempotency-Key": "another"}):
        response = emptied.http.post("/simulate", json=slow(1, seed=73), headers=headers)
        assert "COW_QUEUE_LIMIT" in problem(response, 503, "queue-full")["detail"]
        assert int(response.headers["retry-after"]) >= 1
    assert emptied.submit(slow(ENDLESS, seed=70), **key)["id"] == jobs[0]["id"], "a key finds its job all the same"
    with socket.create_connection(emptied.host_and_port) as raw:
        raw.sendall(post(b"x" * 100, length=30_000_000))  # the rest of it is never sent
        answer = raw.makefile("rb").read()  # to its end: an unread body would close the connection
    assert answer.startswith(b"HTTP/1.1 503 ")
    assert b"urn:cow:problem:queue-full" in answer
    cancel(emptied, jobs[0])
    assert emptied.submit(slow(ENDLESS, seed=74))["status"] in ("queued", "running")
    assert 73 not in emptied.clips()


# --- callers who leave ---


def post(body: bytes, length: int | None = None, **headers: str) -> bytes:
    told = {"Host": "cow", "Content-Type": "application/json", "Content-Length": str(length or len(body)), **headers}
    head = "".join(f"{name}: {value}\r\n" for name, value in told.items())
    return f"POST /simulate HTTP/1.1\r\n{head}\r\n".encode() + body


def left(served: Served, seed: int, **headers: str) -> str:
    """The job of a caller who leaves while its clip is made."""
    key = {"Authorization": f"Bearer {KEYS['main']}"}
    with socket.create_connection(served.host_and_port) as raw:
        raw.sendall(post(json.dumps(slow(ENDLESS, seed=seed)).encode(), **headers | key))
        eventually(lambda: seed in served.clips())
        return ids(served.http.get("/jobs"))[0]


@pytest.mark.slow
def test_the_job_of_a_caller_who_leaves_ends_unless_they_can_come_back(served: Served) -> None:
    for seed, stays, ends in ((80, {"Prefer": "wait=50"}, {}), (82, {"Idempotency-Key": "left"}, FRESH)):
        job = left(served, seed, **stays)
        served.until(left(served, seed + 1, **ends), "canceled")  # whose caller left after the other
        assert served.job(job)["status"] == "running"
        cancel(served, {"id": job})


# --- stops and crashes ---


@pytest.mark.slow
def test_a_stop_hands_back_what_takes_longer_and_waits_for_what_is_nearly_done(emptied: Served) -> None:
    keys = [{"Idempotency-Key": str(seed)} for seed in (92, 93)]
    # One clip is made at a time: the one behind the first waits, however short it is.
    bodies = [slow(ENDLESS, seed=92), slow(0.2, seed=93)]
    with ThreadPoolExecutor(4) as pool:
        waiting: list[Future[httpx.Response]] = []
        for body, key in zip(bodies, keys, strict=True):
            waiting.append(pool.submit(emptied.http.post, "/simulate", json=body, headers=key))
            eventually(lambda: len(open_jobs(emptied)) == len(waiting) and 92 in emptied.clips())
        alone = emptied.submit(slow(0.2, seed=95))
        heard: list[str] = []
        follower = pool.submit(hear_until_cut, emptied, alone["id"], heard)
        eventually(lambda: heard)
        emptied.stop()
        follower.result()
        assert heard[0].startswith("id: 1\nevent: queued\n")
        for answer in (one.result() for one in waiting):
            problem(answer, 503, "shutting-down")
            assert re.fullmatch("/jobs/[0-9a-f-]{36}", answer.headers["location"])
            assert int(answer.headers["retry-after"]) >= 1
        first, second = (answer.result().headers["location"].removeprefix("/jobs/") for answer in waiting)
        with Served(emptied.data.parent, log="patient", COW_SHUTDOWN_GRACE="100", COW_CONCURRENCY="1") as patient:
            eventually(lambda: patient.clips().count(92) == 2)  # it goes on
            cancel(patient, {"id": first})
            assert [patient.ended(job)["status"] for job in (second, alone["id"])] == ["succeeded"] * 2
            again = patient.http.post("/simulate", json=bodies[1], headers=keys[1])
            assert (again.status_code, again.json()["generator"]["seed"]) == (200, 93)
            nearly = pool.submit(patient.http.post, "/simulate", json=slow(2, seed=90))
            eventually(lambda: 90 in patient.clips())
            patient.stop()
            assert nearly.result().status_code == 200
    emptied.start()
    assert emptied.job(nearly.result().json()["id"])["status"] == "succeeded"


def open_jobs(served: Served) -> list[str]:
    return ids(served.http.get("/jobs", params={"status": ["queued", "running"]}))


def hear_until_cut(served: Served, job_id: str, heard: list[str]) -> None:
    with suppress(httpx.RemoteProtocolError), served.http.stream("GET", f"/jobs/{job_id}/events") as response:
        for part in response.iter_text():
            heard.append(part)


@pytest.mark.slow
def test_after_a_crash_jobs_go_on_where_they_were(emptied: Served) -> None:
    key = {"Idempotency-Key": "crash"}
    done = emptied.ended(emptied.submit(BODY)["id"])
    body = slow(6, seed=96, image=data_url(picture(7)))
    job = emptied.submit(body, **key)
    eventually(lambda: 96 in emptied.clips())
    before = stage_results(emptied, job["id"])  # what was done is stored before a clip is begun
    assert set(before) == {"grounding", "motion", "trajectory"}
    emptied.kill()
    emptied.start()
    assert emptied.job(done["id"]) == done
    rest = events_of(emptied.http.get(f"/jobs/{job['id']}/events", headers={"Last-Event-ID": "3"}))
    ends = [("stage", "generation"), ("succeeded", None)]
    assert [(event["event"], event["data"]["stage"]) for event in lasting(rest)] == ends
    assert numbers(rest) == [4, 100]
    after = emptied.ended(job["id"])
    assert (after["result"]["generator"]["seed"], after["result"]["reused"]) == (96, [])
    assert emptied.clips().count(96) == 2
    results = stage_results(emptied, job["id"])
    assert {stage: results[stage] for stage in before} == before  # not made again
    assert emptied.http.post("/simulate", json=body, headers=key).json() == after["result"]


def stage_results(served: Served, job_id: str) -> dict[str, float]:
    """When each stage that a job came to was kept."""
    with closing(sqlite3.connect(served.data / "jobs.sqlite3")) as database:
        found = database.execute("SELECT stage, created_at FROM cow_results WHERE job_id = ?", (job_id,))
        return dict(found.fetchall())
