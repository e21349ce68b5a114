"""Batches: questions by id, a folder that survives kills, and what comes of each question, by both clients."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import threading
import time
from collections.abc import Callable
from contextlib import aclosing, closing
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused
from sdk import JOB, SIMULATION, Connect, address, client, connect, hurried, served, told
from servers import BODY, IMAGE, QUESTION, Served
from waiting import eventually

from cow_service.client import AsyncClient, Client, errors
from cow_service.client.batches import OutageTimer, Question, questions
from cow_service.client.journal import Journal
from cow_service.client.progress import BatchProgress, describe_load, progress_shown
from cow_service.records import ProcessInfo, QueueInfo, WorkerInfo, WorkerLoad, Workers

__all__ = ["address", "client", "connect", "hurried", "served"]  # fixtures

GIVEN = {name: value for name, value in BODY.items() if name not in ("image", "question")}


def asked(count: int, **others: Any) -> list[dict[str, Any]]:
    """Questions that differ in their seeds, which take milliseconds each."""
    return [{"id": f"q{n}", "image": IMAGE, "question": QUESTION, **GIVEN, "seed": n, **others} for n in range(count)]


def lines_of(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]


def job_count(http: httpx.Client) -> int:
    count, cursor = 0, None
    while True:
        page = http.get("/jobs", params={"limit": 500, **({"cursor": cursor} if cursor else {})}).json()
        count += len(page["jobs"])
        if (cursor := page["next"]) is None:
            return count


# Questions


def test_ids_are_given_or_made_of_what_is_asked() -> None:
    items = [{"image": "a.png", "question": "?"}, ("a.png", "?"), {"id": 7, "image": "b.png", "question": "?"}]
    ids = [question.id for question in questions(items)]
    assert ids[1] == f"{ids[0]}-2"
    assert ids[2] == "7"
    again = [question.id for question in questions([items[2], items[0]])]
    assert again == [ids[2], ids[0]], "an id must not hang on the order"


def test_what_decides_is_in_the_fingerprint() -> None:
    def fingerprint(item: dict[str, Any], **defaults: Any) -> str:
        return next(questions([item], defaults)).fingerprint

    base = {"image": "a.png", "question": "?"}
    assert fingerprint(base) == fingerprint({**base, "meta": 5, "id": "x"})
    different = [base, {**base, "image": "b.png"}, {**base, "question": "!"}, {**base, "seed": 1}]
    assert len({fingerprint(item) for item in different} | {fingerprint(base, votes=3)}) == 5
    grey = np.zeros((20, 20), np.uint8)
    assert fingerprint({**base, "image": grey}) != fingerprint({**base, "image": grey + 1})


NO_QUESTIONS: list[tuple[str, dict[str, Any]]] = [
    ("/0/image", {"question": "?"}),
    ("/0/question", {"image": "a.png", "question": 5}),
    ("/0/id", {"id": "", "image": "a.png", "question": "?"}),
    ("/0/id", {"id": "x" * 201, "image": "a.png", "question": "?"}),
    # What cannot be written down is refused before it is asked.
    ("/0/id", {"image": "a.png", "question": "?", "id": "\ud800"}),
    ("/0/question", {"image": "a.png", "question": "\ud800"}),
    ("/0/meta", {"image": "a.png", "question": "?", "meta": object()}),
    ("/motion/law", {"image": "a.png", "question": "?", "law": "contact", "motion": {"law": "ballistic"}}),
]


def test_questions_that_are_none_and_defaults_that_are_not_of_the_request_alone() -> None:
    for pointer, item in NO_QUESTIONS:
        with refused("invalid-request", pointer):
            list(questions([item]))
    with refused("invalid-request", "/1/id"):
        list(questions([{"id": "x" * 200, "image": "a.png", "question": "?"}] * 2))
    nothing: list[Any] = ["a.png"]
    for items, defaults in ((nothing, None), ([], {"image": "a.png", "question": "?"})):
        with refused("invalid-request"):
            list(questions(items, defaults))


@given(st.text(min_size=1, max_size=200))
def test_every_id_has_a_folder_inside(own: str) -> None:
    name = next(questions([{"id": own, "image": "a.png", "question": "?"}])).folder
    assert Path("items", name).parts == ("items", name)
    assert name not in (".", "..")


def test_questions_are_taken_as_they_are_and_completed(tmp_path: Path) -> None:
    own = Question("scene/1", "a.png", "?", {"votes": 3})
    (asked,) = questions([own], {"votes": 5, "seed": 2})
    assert asked.options == {"votes": 3, "seed": 2}
    assert asked.fingerprint != own.fingerprint
    assert asked.folder not in ("", Question("scene:1", "a.png", "?").folder)
    (asked,) = questions([("a.png", "?")], {"law": "contact", "motion": {"kind": "fall"}})
    assert asked.options == {"motion": {"kind": "fall", "law": "contact"}}
    # The same, from wherever its file is looked at.
    here, there = (next(questions([("a.png", "?")], None, folder)) for folder in (tmp_path, Path("elsewhere")))
    assert here.image != there.image
    assert (here.id, here.fingerprint) == (there.id, there.fingerprint)


# The folder


def line(status: str = "succeeded") -> dict[str, Any]:
    return {"status": status, "seconds": 0.1, "result": {}}


def a_question(own: str = "q", question: str = "?") -> Question:
    return Question(own, "a.png", question)


def test_a_half_written_line_is_cut_off_and_asked_again_under_the_same_key(tmp_path: Path) -> None:
    with closing(Journal(tmp_path, "answer")) as journal:
        journal.append(a_question("first"), line())
        key = journal.key(a_question("second"), b"body")
        journal.append(a_question("second"), line())
    results = tmp_path / "results.jsonl"
    whole = results.read_bytes()
    with closing(Journal(tmp_path / "other", "answer")) as other:
        keys = {key, other.key(a_question("second"), b"body"), other.key(a_question("third"), b"body")}
        keys |= {other.key(a_question("second"), b"other"), other.key(a_question("second"), b"body", fresh=True)}
        assert len(keys) == 5
    for cut in range(whole.index(b"\n") + 1, len(whole)):
        results.write_bytes(whole[:cut])
        with closing(Journal(tmp_path, "answer")) as journal:
            assert journal.has(a_question("first"))
            assert not journal.has(a_question("second"))
            assert journal.key(a_question("second"), b"body") == key
            journal.append(a_question("second"), line())
        assert results.read_bytes() == whole


def test_a_line_is_what_came_and_a_folder_may_be_let_go_in_another_thread(tmp_path: Path) -> None:
    (question,) = questions([{"id": "q", "image": "a.png", "question": "?", "meta": {"truth": np.int64(3)}}])
    journal = Journal(tmp_path, "answer")
    journal.append(question, line())
    (kept,) = lines_of(tmp_path)
    assert kept == {"id": "q", **line(), "meta": {"truth": 3}, "attempt": 0, "fingerprint": question.fingerprint}
    thread = threading.Thread(target=journal.close)
    thread.start()
    thread.join()
    journal.append(question, line())  # the batch has ended
    assert lines_of(tmp_path) == [kept]
    Journal(tmp_path, "answer").close()


def test_a_failure_is_asked_again_under_another_key_and_only_when_told(tmp_path: Path) -> None:
    with closing(Journal(tmp_path, "answer")) as journal:
        keys = [journal.key(a_question("bad"), b"")]
        journal.append(a_question("good"), line())
        journal.append(a_question("bad"), line("failed"))
    with closing(Journal(tmp_path, "answer")) as journal:
        assert journal.has(a_question("bad"))
    for _ in range(2):
        with closing(Journal(tmp_path, "answer", retry_failed=True)) as journal:
            assert not journal.has(a_question("bad"))
            assert journal.has(a_question("good"))
            keys.append(journal.key(a_question("bad"), b""))
        with closing(Journal(tmp_path, "answer")) as journal:  # killed before it had an outcome: no other key
            assert journal.key(a_question("bad"), b"") == keys[-1]
            journal.append(a_question("bad"), line("failed"))
    assert len(set(keys)) == 3
    assert [entry["id"] for entry in lines_of(tmp_path)] == ["good", "bad"]


def test_a_full_disk_leaves_whole_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, room = os.write, [20]

    def little(descriptor: int, data: bytes) -> int:
        if not room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(descriptor, data[: room.pop()])

    with closing(Journal(tmp_path, "answer")) as journal:
        monkeypatch.setattr("cow_service.client.journal.os.write", little)
        with pytest.raises(OSError, match="No space"):
            journal.append(a_question("first"), line())
        monkeypatch.undo()
        assert not journal.has(a_question("first"))
        journal.append(a_question("second"), line())
    assert [entry["id"] for entry in lines_of(tmp_path)] == ["second"]


def test_a_folder_is_for_one_batch_at_a_time_and_of_one_kind(tmp_path: Path) -> None:
    with closing(Journal(tmp_path, "answer")) as journal:
        journal.append(a_question(), line())
        with refused("invalid-request"):  # in use
            Journal(tmp_path, "answer")
        with refused("invalid-request"):
            journal.has(a_question(question="other"))
    with refused("invalid-request"):
        Journal(tmp_path, "simulate")
    (tmp_path / "results.jsonl").write_bytes(b"{}x\n")
    with refused("invalid-request"):
        Journal(tmp_path, "answer")
    (tmp_path / "results.jsonl").unlink()
    Journal(tmp_path, "answer").close()
    (tmp_path / "batch.json").write_text("{}")
    with refused("invalid-request"):
        Journal(tmp_path, "answer")


# Both clients


@pytest.mark.slow
def test_outcomes_of_both_clients_are_the_same(address: str) -> None:
    items = [*asked(4), {**asked(5)[4], "question": "hello", "grounding": None, "imagine": "always"}]
    items.append({"id": "missing", "image": "/nowhere/image.png", "question": QUESTION})
    items.append({"id": "none", "image": b"no image", "question": QUESTION})

    def plain(outcome: Any) -> Any:
        return outcome.id, outcome.result and outcome.result.answer, outcome.error and outcome.error.code

    with Client(address) as client:
        came = {plain(outcome) for outcome in client.map(items, concurrency=3)}

    async def others() -> set[Any]:
        async with AsyncClient(address) as client:
            return {plain(outcome) async for outcome in client.map(items, concurrency=3)}

    assert asyncio.run(others()) == came
    assert len(came) == 7
    assert {error for _, _, error in came if error} == {"image-unreadable", "image-type-unsupported"}


@pytest.mark.slow
def test_a_second_call_finds_everything(served: Served, client: Client, tmp_path: Path) -> None:
    items = [*asked(6, meta={"truth": "Yes"}), {"id": "gone", "image": "/nowhere.png", "question": QUESTION}]
    out = tmp_path / "out"
    first = {o.id: o for o in client.map(items, out=out, kind="simulate", save=True)}
    before = job_count(served.http)
    again = {o.id: o for o in client.map(items, out=out, kind="simulate")}
    assert list(client.map(items, out=out, kind="simulate", only_new=True)) == []
    assert job_count(served.http) == before
    assert [again[f"q{n}"].result.model_dump() for n in range(6)] == [
        first[f"q{n}"].result.model_dump() for n in range(6)
    ]
    assert again["gone"].error.code == first["gone"].error.code == "image-unreadable"
    lines = {entry["id"]: entry for entry in lines_of(out)}
    assert lines.keys() == first.keys()
    assert (lines["q0"]["meta"], lines["q0"]["folder"]) == ({"truth": "Yes"}, "items/q0")
    assert "folder" not in lines["gone"]
    assert sorted(path.name for path in (out / "items").iterdir()) == [f"q{n}" for n in range(6)]
    assert (out / "items" / "q0" / "overlay.jpg").read_bytes().startswith(b"\xff\xd8")


@pytest.mark.slow
def test_a_batch_that_is_left_ends_its_jobs_unless_its_folder_finds_them_again(
    served: Served, address: str, tmp_path: Path
) -> None:
    slow = {"generator": "slow", "generator_options": {"seconds": 60.0}, "num_frames": 80, "frames": {"count": 40}}
    gone = {"id": "gone", "image": "/nowhere.png", "question": QUESTION}  # fails here, and at once
    items = [gone, *asked(2, **slow)]

    def newest() -> set[str]:
        return {job["status"] for job in served.http.get("/jobs").json()["jobs"][:2]}

    def begun() -> bool:
        return newest() <= {"queued", "running"}

    with Client(address, timeout=4) as client:
        outcomes = client.map(items, kind="simulate")
        next(outcomes)
        eventually(begun)
        outcomes.close()  # as `break` and the end of the function do
        eventually(lambda: newest() == {"canceled"})

    async def left(**how: Any) -> int:
        async with AsyncClient(address) as client, aclosing(client.map(items, kind="simulate", **how)) as outcomes:
            async for _ in outcomes:
                await asyncio.to_thread(eventually, begun)
                break
        return job_count(served.http)

    asyncio.run(left())
    eventually(lambda: newest() == {"canceled"})
    count = asyncio.run(left(out=tmp_path))
    assert asyncio.run(left(out=tmp_path, retry_failed=True)) == count
    assert begun()
    for job in served.http.get("/jobs").json()["jobs"][:2]:
        served.http.post(f"/jobs/{job['id']}/cancel").raise_for_status()


def test_arguments_that_do_not_fit() -> None:
    with Client("http://127.0.0.1:1") as client:
        for wrong in ({"concurrency": 0}, {"save": True}, {"retry_failed": True}):
            with pytest.raises(ValueError, match=next(iter(wrong))):
                list(client.map([], **wrong))


# A server that is scripted


def answering(answer: Callable[[httpx.Request], httpx.Response]) -> httpx.Client:
    return httpx.Client(transport=httpx.MockTransport(answer))


def refusal(code: str, status: int) -> httpx.Response:
    reply = told(code, status)
    return httpx.Response(status, json=reply.body, headers=reply.headers | {"retry-after": "0"})


def test_what_all_questions_would_meet_ends_the_batch(connect: Connect, tmp_path: Path) -> None:
    with answering(lambda _: refusal("not-found", 404)) as http, refused("not-found"):
        list(connect("http://x", http_client=http).map(asked(3), out=tmp_path))
    assert lines_of(tmp_path) == [], "no question failed: the batch did"


class Crowded:
    """A server that answers a limited number of requests at once, and refuses others as a full queue does."""

    def __init__(self, accepts: int) -> None:
        self.accepts = accepts
        self.at_once = self.most_at_once = self.refused = 0
        self.nine = threading.Event()  # that many were there at once

    def begin(self) -> bool:
        if accepted := self.at_once < self.accepts:
            self.at_once += 1
        self.refused += not accepted
        self.most_at_once = max(self.most_at_once, self.at_once)
        if self.most_at_once > 8:
            self.nine.set()
        return accepted

    def end(self, accepted: bool) -> httpx.Response:
        self.at_once -= accepted
        return httpx.Response(200, json=SIMULATION) if accepted else refusal("queue-full", 503)


@pytest.mark.parametrize("blocking", [True, False])
def test_as_many_questions_are_asked_at_once_as_the_server_takes(connect: Connect, blocking: bool) -> None:
    crowded, items, turn = Crowded(20), asked(200), threading.Lock()

    def answer(_: httpx.Request) -> httpx.Response:
        with turn:
            accepted = crowded.begin()
        if accepted:  # all wait for the ninth, which comes only after some were answered
            crowded.nine.wait(1)
        with turn:
            return crowded.end(accepted)

    async def awaited_answer(_: httpx.Request) -> httpx.Response:
        if accepted := crowded.begin():
            await asyncio.to_thread(crowded.nine.wait, 1)
        return crowded.end(accepted)

    async def awaited() -> int:
        transport = httpx.MockTransport(awaited_answer)
        async with httpx.AsyncClient(transport=transport) as http, AsyncClient("http://x", http_client=http) as client:
            return sum([outcome.succeeded async for outcome in client.map(items, kind="simulate")])

    if blocking:
        with answering(answer) as http:
            outcomes = connect("http://x", http_client=http).map(iter(items), kind="simulate")
            assert sum(outcome.succeeded for outcome in outcomes) == len(items)
    else:
        assert asyncio.run(awaited()) == len(items)
    assert crowded.most_at_once > 8, "it begins with so many, and tries more"
    assert crowded.refused < len(items) / 4


def test_what_limits_a_batch_is_shown(
    connect: Connect, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cow_service.client.progress.LOOK_SECONDS", 0.0)
    monkeypatch.setattr("cow_service.client.progress.LINE_SECONDS", 0.0)
    workers = load(mllm_calls=5, mllm_limit=6, mllm_waiting=3).model_dump()

    def answer(request: httpx.Request) -> httpx.Response:
        return httpx.Response(200, json=workers if request.url.path == "/workers" else SIMULATION)

    with answering(answer) as http:
        list(connect("http://x", http_client=http).map(asked(2), kind="simulate", progress=True))
    assert "; limited by the server's MLLM: 8 calls wait for it, of 6 at once" in capsys.readouterr().err


def test_an_outage_is_shown_while_it_lasts(hurried: Connect, capsys: pytest.CaptureFixture[str]) -> None:
    replies = iter([refusal("queue-full", 503)] * 2)
    with answering(lambda _: next(replies, None) or httpx.Response(200, json=SIMULATION)) as http:
        list(hurried("http://x", http_client=http, retries=0).map(asked(1), kind="simulate", progress=True))
    assert hurried.slept == [2.0, 2.0]
    waiting, over = capsys.readouterr().err.splitlines()
    assert waiting.endswith("; waiting for the server (queue-full)")
    assert over.startswith("0/1 done")
    assert ";" not in over


def load(queued: int = 0, **load: int) -> Workers:
    queue = QueueInfo(name="light", queued=queued, running=0, capacity=1, jobs_per_minute=0)
    none = {"cpu_waiting": 0, "mllm_calls": 0, "mllm_limit": 0, "mllm_waiting": 0}
    worker = WorkerInfo(name="w", queue=None, memory_mb=1, jobs_done=0, load=WorkerLoad(**none | load))
    about = {"executor_id": "x", "seen_at": "", "role": "all", "version": "1", "workflow_version": "1"}
    return Workers(processes=(ProcessInfo(**about, workers=(worker,)),), queues=(queue,))


def test_what_most_jobs_wait_for() -> None:
    assert describe_load(load()) == ""
    for words, waiting in {
        "server: 3 jobs are queued": load(queued=3),
        "CPU: 4 jobs wait for it": load(queued=3, cpu_waiting=4, mllm_calls=3),
        "MLLM: 9 calls wait for it, of 8 at once": load(cpu_waiting=9, mllm_calls=8, mllm_limit=8, mllm_waiting=1),
    }.items():
        assert words in describe_load(waiting)


@pytest.mark.parametrize("cancel", [200, 404])
def test_a_question_that_takes_too_long_fails_alone_and_looks_are_words_of_the_server(
    hurried: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cancel: int
) -> None:
    heard: list[int] = []
    monkeypatch.setattr(OutageTimer, "reset", lambda _: heard.append(1))

    def plain(outcome: Any) -> Any:
        return outcome.id, outcome.error.code, outcome.error.job_id

    def running(request: httpx.Request) -> httpx.Response:  # for ever
        if request.url.path.endswith("/cancel") and cancel != 200:
            return refusal("job-not-found", cancel)
        return httpx.Response(202 if request.method == "POST" else 200, json=JOB)

    with answering(running) as http:
        client = hurried("http://x", http_client=http)
        came = [plain(o) for o in client.map(asked(2), kind="simulate", timeout=0.5, out=tmp_path)]
        assert len(heard) > 8, "only the end of each question was heard"
        again = [plain(o) for o in client.map(asked(2), kind="simulate", timeout=0.5, out=tmp_path)]
    assert sorted(came) == sorted(again) == [("q0", "wait-timeout", "j-1"), ("q1", "wait-timeout", "j-1")]


def test_pictures_that_cannot_be_saved_lose_no_answer(connect: Connect, tmp_path: Path) -> None:
    def answer(request: httpx.Request) -> httpx.Response:
        is_picture = "/artifacts/" in request.url.path
        return httpx.Response(200, content=b"damaged") if is_picture else httpx.Response(200, json=SIMULATION)

    with answering(answer) as http:
        batch = connect("http://x", http_client=http).map(asked(1), kind="simulate", out=tmp_path, save=True)
        (outcome,) = batch
    assert outcome.succeeded
    assert outcome.unsaved.code == "bad-response"
    (kept,) = lines_of(tmp_path)
    assert (kept["status"], kept["unsaved"]) == ("succeeded", outcome.unsaved.detail)


# Patience and progress


def test_patience_with_a_server_that_takes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    told: list[str | None] = []
    timer = OutageTimer(on_change=lambda error: told.append(error and error.code))
    assert timer.pause_after(errors.CannotGround("no")) is None
    with refused("server-unreachable"):
        OutageTimer().pause_after(errors.ServerUnreachable("there never was one"))
    for kind in (errors.QueueFull, errors.ShuttingDown, errors.StorageUnavailable, errors.RateLimited):
        assert OutageTimer().pause_after(kind("not now")) == 2.0
    assert timer.pause_after(errors.ServerUnreachable("it is away for a moment")) == 2.0
    assert told == [None, "server-unreachable"]
    for status, passes in ((299, None), (300, False), (499, False), (500, True)):
        proxy = errors.BadResponse("a page")
        proxy.status = status
        if passes is False:
            with refused("bad-response"):
                timer.pause_after(proxy)
        else:
            assert timer.pause_after(proxy) == (2.0 if passes else None)
    with refused("unauthorized"):
        timer.pause_after(errors.Unauthorized("no key"))
    now += 300
    assert timer.pause_after(errors.QueueFull("full")) == 2.0
    now += 1
    with refused("queue-full"):
        timer.pause_after(errors.QueueFull("full for too long"))


def test_progress_in_words(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    now = 1010.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    progress = BatchProgress(100, began=now - 10, looked_at=now)
    for _ in range(50):
        progress.count(True, earlier=True)
    for _ in range(20):
        progress.count(True)
    progress.count(False)
    assert str(progress) == "71/100 done, 1 failed, 126/min, 0:00:14 left"
    assert str(BatchProgress(None)) == "0 done, 0 failed, 0/min"
    assert not progress.is_look_due()
    with progress_shown(progress, True) as show:
        now += 10
        assert [progress.is_look_due(), progress.is_look_due()] == [True, False]
        show()
        assert capsys.readouterr().err == ""
        now += 20
        show()
        assert capsys.readouterr().err == "71/100 done, 1 failed, 31.5/min, 0:00:55 left\n"
        progress.note = "waiting"
        show()
        assert capsys.readouterr().err.endswith("; waiting\n")
        show()
        assert capsys.readouterr().err == ""
    with progress_shown(progress, False) as show:
        now += 100
        show()
    assert capsys.readouterr().err == ""
