"""Batches: questions by id, a folder that survives kills, outcomes of both clients, and `cow batch` itself."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import aclosing, closing
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from conftest import SCALE, Server
from hypothesis import given
from hypothesis import strategies as st
from servers import BODY, IMAGE, QUESTION, Served
from typer.testing import CliRunner
from waiting import eventually

from cow_service.cli.main import app
from cow_service.client import AsyncClient, Client, errors
from cow_service.client.batches import OutageTimer, Question, questions
from cow_service.client.journal import Journal
from cow_service.client.progress import BatchProgress, describe_load
from cow_service.records import ProcessInfo, QueueInfo, WorkerInfo, WorkerLoad, Workers

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "-m", "cow_service.cli.main", "batch"]
GIVEN = {name: value for name, value in BODY.items() if name not in ("image", "question")}


def asked(count: int, **others: Any) -> list[dict[str, Any]]:
    """Questions that differ in their seeds, which take milliseconds each."""
    return [{"id": f"q{n}", "image": IMAGE, "question": QUESTION, **GIVEN, "seed": n, **others} for n in range(count)]


def written(folder: Path, items: list[dict[str, Any]]) -> Path:
    """A file of questions, and the picture that they name in the same folder."""
    (folder / "ball.png").write_bytes(IMAGE)
    path = folder / "questions.jsonl"
    path.write_text("".join(json.dumps({**item, "image": "ball.png"}) + "\n" for item in items))
    return path


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
    assert fingerprint({**base, "image": b"x"}) == fingerprint({**base, "image": b"x"})


@pytest.mark.parametrize(
    ("items", "says"),
    [
        ([{"question": "?"}], "Question 1: `image`"),
        ([{"image": "a.png"}], "Question 1: `question`"),
        ([{"image": "a.png", "question": 5}], "must be a text, got int"),
        ([{"id": "", "image": "a.png", "question": "?"}], "0 characters"),
        ([{"id": "x", "image": "a.png", "question": "?"}] * 2, "Question 2: `id` 'x' stands before"),
    ],
)
def test_questions_that_are_none(items: list[Any], says: str) -> None:
    with pytest.raises(errors.InvalidRequest, match=says):
        list(questions(items))


@given(st.text(min_size=1, max_size=200))
def test_every_id_has_a_folder_inside(own: str) -> None:
    name = next(questions([{"id": own, "image": "a.png", "question": "?"}])).folder
    assert Path("items", name).parts == ("items", name)
    assert name not in (".", "..")


def test_questions_are_taken_as_they_are_and_completed() -> None:
    own = Question("scene/1", "a.png", "?", {"votes": 3})
    (asked,) = questions([own], {"votes": 5, "seed": 2})
    assert asked.options == {"votes": 3, "seed": 2}
    assert asked.fingerprint != own.fingerprint
    assert own.fingerprint != Question("scene/1", "a.png", "!", {"votes": 3}).fingerprint
    assert asked.folder not in ("", Question("scene:1", "a.png", "?").folder)


def test_a_question_is_the_same_from_wherever_its_file_is_looked_at(tmp_path: Path) -> None:
    item = {"image": "a.png", "question": "?"}
    here, there = (next(questions([item], None, folder)) for folder in (tmp_path, Path("elsewhere")))
    assert here.image != there.image
    assert (here.id, here.fingerprint) == (there.id, there.fingerprint)


@pytest.mark.parametrize(
    ("item", "name"),
    [({"id": "\ud800"}, "id"), ({"question": "\ud800"}, "question"), ({"meta": object()}, "meta")],
)
def test_what_cannot_be_written_down_is_refused_before_it_is_asked(item: dict[str, Any], name: str) -> None:
    with pytest.raises(errors.InvalidRequest, match=f"Question 1: `{name}` cannot be written"):
        list(questions([{"image": "a.png", "question": "?", **item}]))


def test_defaults_are_of_the_request_alone() -> None:
    with pytest.raises(errors.InvalidRequest, match="`image` and `question`"):
        list(questions([], {"image": "a.png", "question": "?"}))


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
    for cut in range(whole.index(b"\n") + 1, len(whole)):
        results.write_bytes(whole[:cut])
        with closing(Journal(tmp_path, "answer")) as journal:
            assert journal.has(a_question("first"))
            assert not journal.has(a_question("second"))
            assert journal.key(a_question("second"), b"body") == key
            journal.append(a_question("second"), line())
        assert results.read_bytes() == whole


def test_keys_differ_by_batch_question_and_body(tmp_path: Path) -> None:
    with closing(Journal(tmp_path / "a", "answer")) as a, closing(Journal(tmp_path / "b", "answer")) as b:
        keys = {a.key(a_question(), b"x"), b.key(a_question(), b"x"), a.key(a_question("r"), b"x")}
        assert len(keys | {a.key(a_question(), b"y"), a.key(a_question(), b"x", fresh=True)}) == 5


def test_what_goes_with_a_question_may_be_numpys(tmp_path: Path) -> None:
    (question,) = questions([{"image": "a.png", "question": "?", "meta": {"truth": np.int64(3)}}])
    with closing(Journal(tmp_path, "answer")) as journal:
        journal.append(question, line())
    assert lines_of(tmp_path)[0]["meta"] == {"truth": 3}


def test_a_folder_may_be_let_go_in_another_thread(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "answer")
    closing = threading.Thread(target=journal.close)
    closing.start()
    closing.join()
    Journal(tmp_path, "answer").close()


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "batch.json").write_text("{}")
    with pytest.raises(errors.InvalidRequest, match="not that of a batch"):
        Journal(tmp_path, "answer")


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
        journal.append(a_question("first"), line())
        monkeypatch.setattr("cow_service.client.journal.os.write", little)
        with pytest.raises(OSError, match="No space"):
            journal.append(a_question("second"), line())
        monkeypatch.undo()
        assert not journal.has(a_question("second"))
        journal.append(a_question("third"), line())
    assert [entry["id"] for entry in lines_of(tmp_path)] == ["first", "third"]


def test_a_folder_is_for_one_batch_at_a_time_and_of_one_kind(tmp_path: Path) -> None:
    with closing(Journal(tmp_path, "answer")) as journal:
        journal.append(a_question(), line())
        with pytest.raises(errors.InvalidRequest, match="in use"):
            Journal(tmp_path, "answer")
        with pytest.raises(errors.InvalidRequest, match="another question with the id 'q'"):
            journal.has(a_question(question="other"))
    with pytest.raises(errors.InvalidRequest, match="of kind 'answer'"):
        Journal(tmp_path, "simulate")
    (tmp_path / "results.jsonl").write_bytes(b"{}x\n")
    with pytest.raises(errors.InvalidRequest, match="damaged in line 1"):
        Journal(tmp_path, "answer")
    (tmp_path / "results.jsonl").unlink()
    Journal(tmp_path, "answer").close()


# Both clients


def test_outcomes_of_both_clients_are_the_same(server: Server) -> None:
    items = [*asked(4), {**asked(5)[4], "question": "hello", "grounding": None, "imagine": "always"}]
    items.append({"id": "missing", "image": "/nowhere/image.png", "question": QUESTION})
    items.append({"id": "none", "image": b"no image", "question": QUESTION})

    def plain(outcome: Any) -> Any:
        return outcome.id, outcome.result and outcome.result.answer, outcome.error and (outcome.error.code)

    with Client(server.address) as client:
        came = {plain(outcome) for outcome in client.map(items, concurrency=3)}

    async def others() -> set[Any]:
        async with AsyncClient(server.address) as client:
            return {plain(outcome) async for outcome in client.map(items, concurrency=3)}

    assert asyncio.run(others()) == came
    assert len(came) == 7
    assert {error for _, _, error in came if error} == {"image-unreadable", "image-type-unsupported"}


def test_a_second_call_finds_everything(server: Server, http: httpx.Client, tmp_path: Path) -> None:
    items = asked(6, meta={"truth": "Yes"})
    out = tmp_path / "out"
    with Client(server.address) as client:
        first = {
            o.id: o.result.model_dump() for o in client.map(items, out=out, kind="simulate", save=True) if o.result
        }
        before = job_count(http)
        again = {o.id: o.result.model_dump() for o in client.map(items, out=out, kind="simulate") if o.result}
        assert list(client.map(items, out=out, kind="simulate", only_new=True)) == []
        assert job_count(http) == before
    assert again == first
    assert len(first) == 6
    assert {entry["meta"]["truth"] for entry in lines_of(out)} == {"Yes"}
    assert sorted(path.name for path in (out / "items").iterdir()) == [f"q{n}" for n in range(6)]
    assert (out / "items" / "q0" / "overlay.jpg").read_bytes().startswith(b"\xff\xd8")


@pytest.mark.soak
@pytest.mark.slow
def test_an_async_batch_that_is_canceled_leaves_its_jobs_to_the_next(tmp_path: Path) -> None:
    items = asked(4, generator="slow", generator_options={"seconds": 2.0}, num_frames=80)
    with Served(tmp_path) as served:
        address = str(served.http.base_url)

        async def canceled() -> None:
            async with AsyncClient(address) as client:
                async with asyncio.timeout(1.5):
                    async for _ in client.map(items, kind="simulate", out=tmp_path / "out"):
                        pass

        with pytest.raises(TimeoutError):
            asyncio.run(canceled())
        with Client(address) as client:
            assert all(o.succeeded for o in client.map(items, kind="simulate", out=tmp_path / "out"))
        assert sorted(served.clips()) == [0, 1, 2, 3], "a job was begun twice"
        assert job_count(served.http) == 4


def test_arguments_that_do_not_fit(tmp_path: Path) -> None:
    with Client("http://127.0.0.1:1") as client:
        for wrong in ({"concurrency": 0}, {"save": True}, {"retry_failed": True}):
            with pytest.raises(ValueError, match=next(iter(wrong))):
                list(client.map([], **wrong))


def test_what_all_questions_would_meet_ends_the_batch(server: Server, tmp_path: Path) -> None:
    with Client(server.address + "/elsewhere") as client, pytest.raises(errors.NotFound):
        list(client.map(asked(3), out=tmp_path))
    assert lines_of(tmp_path) == [], "no question failed: the batch did"


@pytest.mark.parametrize(
    "kind", [errors.QueueFull, errors.ShuttingDown, errors.StorageUnavailable, errors.RateLimited, errors.BodyTooSlow]
)
def test_what_passes_is_no_failure_of_a_question(kind: type[errors.CowError]) -> None:
    assert OutageTimer(60).pause_after(kind("not now")) is not None


class Crowded:
    """A server that answers a limited number of requests at once, and refuses others as a full queue does."""

    def __init__(self, accepts: int, answer: dict[str, Any]) -> None:
        self.accepts, self.answer = accepts, answer
        self.at_once = self.most_at_once = self.refused = 0
        self._lock = threading.Lock()

    def begin(self) -> bool:
        with self._lock:
            if accepted := self.at_once < self.accepts:
                self.at_once += 1
            self.refused += not accepted
            self.most_at_once = max(self.most_at_once, self.at_once)
            return accepted

    def end(self, accepted: bool) -> httpx.Response:
        if accepted:
            with self._lock:
                self.at_once -= 1
            return httpx.Response(200, json=self.answer)
        problem = {"type": "urn:cow:problem:queue-full", "title": "", "status": 503, "detail": "full"}
        headers = {"content-type": "application/problem+json", "retry-after": "0"}
        return httpx.Response(503, json=problem, headers=headers)

    def blocking(self, request: httpx.Request) -> httpx.Response:
        if accepted := self.begin():
            time.sleep(0.02)
        return self.end(accepted)

    async def awaited(self, request: httpx.Request) -> httpx.Response:
        if accepted := self.begin():
            await asyncio.sleep(0.02)
        return self.end(accepted)


@pytest.mark.parametrize("blocking", [True, False])
def test_as_many_questions_are_asked_at_once_as_the_server_takes(server: Server, blocking: bool) -> None:
    with Client(server.address) as client:
        (first,) = client.map(asked(1))
    crowded, many = Crowded(20, first.result.model_dump(mode="json")), 400

    async def awaited() -> int:
        transport = httpx.MockTransport(crowded.awaited)
        async with httpx.AsyncClient(transport=transport) as http, AsyncClient("http://x", http_client=http) as client:
            return sum([outcome.succeeded async for outcome in client.map(asked(many))])

    if blocking:
        http = httpx.Client(transport=httpx.MockTransport(crowded.blocking))
        with http, Client("http://x", http_client=http) as client:
            assert sum(outcome.succeeded for outcome in client.map(asked(many))) == many
    else:
        assert asyncio.run(awaited()) == many
    assert crowded.most_at_once > 12
    assert crowded.refused < 0.1 * many  # replies this quick leave little time to hear of a refusal


def test_what_limits_a_batch_is_shown(
    server: Server, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cow_service.client.progress.LOOK_SECONDS", 0.0)
    monkeypatch.setattr("cow_service.client.progress.LINE_SECONDS", 0.0)
    told = httpx.get(server.address + "/workers").json()
    worker = {"name": "w", "queue": None, "memory_mb": 1, "jobs_done": 0}
    worker["load"] = {"cpu_waiting": 2, "mllm_calls": 5, "mllm_limit": 6, "mllm_waiting": 3}
    process = {"executor_id": "x", "seen_at": "", "role": "all", "version": "1", "workflow_version": "1"}
    told["processes"] = [process | {"workers": [worker]}]

    def between(request: httpx.Request) -> httpx.Response:
        if request.url.path == "/workers":
            return httpx.Response(200, json=told)
        return httpx.request(request.method, str(request.url), headers=request.headers, content=request.read())

    http = httpx.Client(transport=httpx.MockTransport(between))
    with http, Client(server.address, http_client=http) as client:
        list(client.map(asked(2), progress=True))
    assert "; limited by the server's MLLM: 8 calls wait for it, of 6 at once" in capsys.readouterr().err


def test_what_most_jobs_wait_for() -> None:
    def limit(queued: int = 0, **load: int) -> str:
        queue = QueueInfo(name="light", queued=queued, running=0, capacity=1, jobs_per_minute=0)
        none = {"cpu_waiting": 0, "mllm_calls": 0, "mllm_limit": 0, "mllm_waiting": 0}
        worker = WorkerInfo(name="w", queue=None, memory_mb=1, jobs_done=0, load=WorkerLoad(**none | load))
        process = ProcessInfo(
            executor_id="x", seen_at="", role="all", version="1", workflow_version="1", workers=(worker,)
        )
        return describe_load(Workers(processes=(process,), queues=(queue,)))

    assert limit() == ""
    assert limit(queued=3) == "limited by the server: 3 jobs are queued"
    assert limit(queued=3, cpu_waiting=4, mllm_calls=3) == "limited by the server's CPU: 4 jobs wait for it"
    assert "MLLM: 9 calls" in limit(cpu_waiting=4, mllm_calls=8, mllm_limit=8, mllm_waiting=1)


def scripted(*, cancel: int = 200) -> Callable[[httpx.Request], httpx.Response]:
    """A server on which every job runs for ever."""
    job = {"id": "j", "kind": "simulate", "status": "running", "progress": 0, "created_at": "now", "generator": "x"}

    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith("/cancel") and cancel != 200:
            problem = {"type": "urn:cow:problem:job-not-found", "title": "", "status": 404, "detail": "gone"}
            return httpx.Response(cancel, json=problem, headers={"content-type": "application/problem+json"})
        return httpx.Response(202 if request.method == "POST" else 200, json=job)

    return answer


@pytest.mark.parametrize("cancel", [200, 404])
def test_a_question_that_takes_too_long_fails_alone(tmp_path: Path, cancel: int) -> None:
    def plain(outcome: Any) -> Any:
        return outcome.id, outcome.error.code, outcome.error.job_id

    http = httpx.Client(transport=httpx.MockTransport(scripted(cancel=cancel)))
    with http, Client("http://x", http_client=http) as client:
        came = [plain(o) for o in client.map(asked(2), kind="simulate", timeout=0.2, out=tmp_path / "a")]
        again = [plain(o) for o in client.map(asked(2), kind="simulate", timeout=0.2, out=tmp_path / "a")]

    async def others() -> list[Any]:
        transport = httpx.MockTransport(scripted(cancel=cancel))
        async with httpx.AsyncClient(transport=transport) as http, AsyncClient("http://x", http_client=http) as client:
            return [plain(o) async for o in client.map(asked(2), kind="simulate", timeout=0.2)]

    assert sorted(came) == sorted(again) == sorted(asyncio.run(others()))
    assert sorted(came) == [("q0", "wait-timeout", "j"), ("q1", "wait-timeout", "j")]


def test_looks_at_jobs_are_words_of_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[int] = []
    monkeypatch.setattr(OutageTimer, "reset", lambda _: heard.append(1))
    http = httpx.Client(transport=httpx.MockTransport(scripted()))
    with http, Client("http://x", http_client=http) as client:
        list(client.map(asked(1), kind="simulate", timeout=0.5))
    assert len(heard) > 2, "only the end of the question was heard"


@pytest.mark.soak
@pytest.mark.slow
def test_a_batch_without_a_folder_that_is_left_ends_its_jobs(tmp_path: Path) -> None:
    quick = {**asked(1)[0], "id": "quick", "seed": 99}
    items = [quick, *asked(3, generator="slow", generator_options={"seconds": 20.0}, num_frames=80)]
    with Served(tmp_path) as served:
        address = str(served.http.base_url)

        def ended() -> bool:
            jobs = served.http.get("/jobs").json()["jobs"]
            return len(jobs) >= 2 and all(job["status"] in ("succeeded", "canceled") for job in jobs)

        with Client(address, timeout=4) as client:
            outcomes = client.map(items, kind="simulate", concurrency=4)
            next(outcomes)
            outcomes.close()  # as `break` and the end of the function do
            eventually(ended)

        async def left() -> None:
            async with (
                AsyncClient(address, timeout=4) as client,
                aclosing(client.map(items, kind="simulate", concurrency=4, fresh=True)) as outcomes,
            ):
                async for _ in outcomes:
                    break

        asyncio.run(left())
        eventually(ended)


def test_pictures_that_cannot_be_saved_lose_no_answer(tmp_path: Path, server: Server) -> None:
    def broken(request: httpx.Request) -> httpx.Response:
        if "/artifacts/" in request.url.path:
            return httpx.Response(200, content=b"damaged")
        return http.send(
            http.build_request(request.method, request.url, headers=request.headers, content=request.read())
        )

    between = httpx.Client(transport=httpx.MockTransport(broken))
    with httpx.Client() as http, between, Client(server.address, http_client=between) as client:
        (outcome,) = client.map(asked(1), kind="simulate", out=tmp_path, save=True)
    assert outcome.succeeded
    assert outcome.unsaved.code == "bad-response"
    (kept,) = lines_of(tmp_path)
    assert kept["status"] == "succeeded"
    assert "damaged" in kept["unsaved"]


def test_the_callers_iterator_is_used_where_it_lives(server: Server) -> None:
    def items() -> Iterator[dict[str, Any]]:
        for item in asked(12):
            assert threading.current_thread() is threading.main_thread()
            yield item

    with Client(server.address) as client:
        assert sum(o.succeeded for o in client.map(items(), kind="simulate", concurrency=2)) == 12


def test_patience_with_a_server_that_takes_nothing() -> None:
    assert OutageTimer(60).pause_after(errors.CannotGround("no")) is None
    with pytest.raises(errors.QueueFull):
        OutageTimer(-1).pause_after(errors.QueueFull("full"))
    told: list[str | None] = []
    timer = OutageTimer(60, lambda error: told.append(error and error.code))
    with pytest.raises(errors.ServerUnreachable):
        timer.pause_after(errors.ServerUnreachable("there never was one"))
    timer.reset()
    assert timer.pause_after(errors.ServerUnreachable("it is away for a moment")) is not None
    assert told == [None, "server-unreachable"]
    with pytest.raises(errors.Unauthorized):
        OutageTimer(60).pause_after(errors.Unauthorized("no key"))


def test_progress_in_words() -> None:
    progress = BatchProgress(100, began=time.monotonic() - 10)
    for _ in range(50):
        progress.count(True, earlier=True)
    for _ in range(20):
        progress.count(True)
    progress.count(False)
    assert str(progress) == "71/100 done, 1 failed, 126/min, 0:00:14 left"


# The command


def run(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    own = {name: value for name, value in os.environ.items() if not name.startswith("COW_")} | environment
    return subprocess.run([*COMMAND, *map(str, arguments)], env=own, capture_output=True, text=True, check=False)


def test_the_command_tells_by_its_exit_code(server: Server, tmp_path: Path) -> None:
    out = tmp_path / "out"
    path = written(tmp_path, asked(5))
    result = run(path, "-o", out, COW_BASE_URL=server.address)
    assert result.returncode == 0, result.stderr
    assert result.stdout == f"5 succeeded, 0 failed: {out / 'results.jsonl'}\n"
    assert len(lines_of(out)) == 5

    wrong = {"id": "red", "image": "ball.png", "question": "hello", "video": False, "num_frames": 5}
    path.write_text(
        path.read_text() + json.dumps(wrong) + "\n" + json.dumps({**wrong, "id": "gone", "image": "no.png"})
    )
    for _ in range(2):
        result = run(path, "-o", out, "--url", server.address, "--kind", "answer")
        assert result.returncode == 3
        assert "image-unreadable 1" in result.stderr
        assert "gone: image-unreadable: " in result.stderr
    assert len(lines_of(out)) == 7
    (tmp_path / "no.png").write_bytes(IMAGE)
    result = run(path, "-o", out, "--url", server.address, "--retry-failed")
    assert result.returncode == 0, result.stderr
    assert len(lines_of(out)) == 7


@pytest.mark.parametrize(
    ("text", "options", "says"),
    [
        ("", (), "holds no questions"),
        ("{", (), "questions.jsonl, line 1: it is not JSON"),
        ("\n[]", (), "line 2: it must be an object, got list"),
        ('{"image": "a.png", "question": "?", "votes": 99}', (), "line 1: /votes: "),
        ('{"question": "?"}\n\n{"image": "a.png"}', (), "line 3: `question` is missing"),
        ('{"image": "a.png", "question": "?", "vote": 1}', (), "/vote: there is no such field"),
        ('{"image": "a.png", "question": "?"}', ("--request", '{"num_frames": 1}'), "/num_frames"),
        ('{"image": "a.png", "question": "?"}', ("--request", "[]"), "--request must be an object"),
        ('{"image": "a.png", "question": "?", "baseline": true}', ("--kind", "simulate"), "/baseline"),
    ],
)
def test_a_file_that_cannot_be_asked_is_refused_before_anything_is_sent(
    tmp_path: Path, text: str, options: tuple[str, ...], says: str
) -> None:
    path = tmp_path / "questions.jsonl"
    path.write_text(text)
    result = CliRunner().invoke(
        app, ["batch", str(path), "-o", str(tmp_path / "out"), "--url", "http://127.0.0.1:1", *options]
    )
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert says in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--url", "127.0.0.1:8000"), "must begin with http://"),
        (("--url", "http://127.0.0.1:1"), "server-unreachable"),
        (("--out", "questions.jsonl"), "Cannot write to 'questions.jsonl'"),
    ],
)
def test_what_keeps_a_batch_from_beginning_is_told_at_once(
    server: Server, tmp_path: Path, options: tuple[str, ...], says: str
) -> None:
    path = written(tmp_path, asked(20))
    began = time.monotonic()
    command = [*COMMAND, str(path), "--out", str(tmp_path / "out"), "--url", server.address, *options]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert says in result.stderr
    assert "Traceback" not in result.stderr
    assert time.monotonic() - began < 20


@pytest.mark.slow
def test_an_interrupt_ends_at_once_and_loses_nothing(tmp_path: Path) -> None:
    items = asked(3, generator="slow", generator_options={"seconds": 2.0}, num_frames=80)
    path, out = written(tmp_path, items), tmp_path / "out"
    with Served(tmp_path) as served:
        command = [*COMMAND, str(path), "-o", str(out), "--url", str(served.http.base_url)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            eventually(lambda: job_count(served.http) == 3)
            process.send_signal(signal.SIGINT)
            began = time.monotonic()
            _, said = process.communicate(timeout=20)
        assert process.returncode == 130
        assert "Run the same command again to resume." in said
        assert "Traceback" not in said
        assert time.monotonic() - began < 3, "it waited for jobs"
        result = run(path, "-o", out, "--url", str(served.http.base_url))
        assert result.returncode == 0, result.stderr
        assert sorted(served.clips()) == [0, 1, 2]
        assert job_count(served.http) == 3


@pytest.fixture
def fast(tmp_path: Path) -> Iterator[Served]:
    with Served(tmp_path) as served:
        yield served


@pytest.mark.soak
@pytest.mark.slow
@pytest.mark.scaled
@pytest.mark.timeout(600)
def test_a_long_batch_that_is_killed_three_times(fast: Served, tmp_path: Path) -> None:
    """60 results (1,000 in `make soak`), none twice, and the server was asked for no finished one again."""
    many = 60 if SCALE == 1 else 100 * SCALE
    # Most are answered from the image alone: what is looked at is who is asked how often.
    items = [{**item, "imagine": "never" if n % 10 else "always"} for n, item in enumerate(asked(many))]
    path, out = written(tmp_path, items), tmp_path / "out"
    concurrency = 8
    how = ("-o", str(out), "--url", str(fast.http.base_url), "--concurrency", str(concurrency))
    draw = random.Random()
    # One in each of three parts; the last leaves room, as more results come while a process is being killed.
    moments = [draw.randrange(part * many // 10, (part + 1) * many // 10) for part in (1, 3, 5)]
    print("killed at", moments)  # pytest shows it when the test fails

    def count() -> int:
        results = out / "results.jsonl"
        return results.read_bytes().count(b"\n") if results.exists() else 0

    for moment in moments:
        with subprocess.Popen([*COMMAND, str(path), *how], stderr=subprocess.PIPE) as process:
            eventually(lambda: count() >= moment or process.poll() is not None)  # noqa: B023
            assert process.poll() is None, process.stderr and process.stderr.read()
            process.kill()
    finished = count()
    result = run(path, *how)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(f"{many} succeeded ({many - many // 10} without a simulation), 0 failed")
    outcomes = lines_of(out)
    assert [entry["status"] for entry in outcomes] == ["succeeded"] * many
    assert {entry["id"] for entry in outcomes} == {f"q{n}" for n in range(many)}
    assert finished < many
    # The server's own count: one job a question, and no more requests than questions and those cut off in the middle.
    assert job_count(fast.http) == many
    metrics = fast.http.get("/metrics").text.splitlines()
    posts = sum(float(m.split()[-1]) for m in metrics if m.startswith("cow_http_requests_total") and '"/answer"' in m)
    print("requests", posts)
    assert many <= posts <= many + 3 * concurrency
