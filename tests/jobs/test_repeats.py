"""Repeats: what is drawn afresh, what is reused, what that costs, and the gate of `imagine: auto`."""

from __future__ import annotations

import asyncio
import json
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import mllm_server as say
import pytest
from conftest import example
from drawn import ball, floor, png_bytes
from engines import app_for
from job_rows import add_job, open_database
from mllm_server import MllmServer
from refusals import refused
from rich.console import Console
from servers import data_url
from waiting import eventually

from cow_service.cli.batch import print_summary
from cow_service.cli.console import answer_table
from cow_service.client.display import answer_html
from cow_service.jobs.computing import KeyLocks, Outages, StoredStep
from cow_service.pipeline import answer
from cow_service.records import Answer, Stage, Usage
from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = pytest.mark.slow

REPEATS = 12
IMAGE = data_url(png_bytes(ball(floor(96, 64), (30, 40), 8, (210, 20, 20))))
QUESTION = "If the red ball rolls to the right, will it leave the table? (A) Yes (B) No (C) Not sure"
BODY: dict[str, Any] = {
    "image": IMAGE,
    "question": QUESTION,
    "num_frames": 5,
    "video": False,
    "ensemble": 0,
    "frames": {"count": 1, "max_side": 32},
}
GIVEN = {"grounding": {"bbox": [22, 32, 38, 48], "object": "red ball"}, "motion": {"direction": [1, 0]}}
BALL = {"object": "red ball", "others": [], "kind": "linear", "sentence": "The red ball rolls."}
PLACE = {"label": "red ball", "bbox_2d": [229, 500, 396, 750], "cue": "text", "direction": [300, 625, 900, 625]}
SIMULATED = ["grounding", "motion", "trajectory", "generation"]
COST = Usage(calls=1, input_tokens=100, output_tokens=10)  # of each call, as the server says


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


@pytest.fixture(scope="module")
def service(mllm: MllmServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    data = tmp_path_factory.mktemp("data")
    with Service(Settings(data_dir=data, mllm="qwen3-vl-8b", mllm_base_url=mllm.address, mllm_timeout=5)) as made:
        yield made


def draws(mllm: MllmServer, chances: dict[int, float], seed: int = 1) -> None:
    """Has the server answer A with a chance that the number of pictures decides, else B; it grounds, too."""
    chance = random.Random(seed)

    def reply(handler: Any) -> None:
        prompt, pictures = say.text_of(handler.body), len(say.images_of(handler.body))
        said: dict[str, Any] = BALL if "sets in motion" in prompt else PLACE
        if "`answer`" in prompt:
            said = {"reasoning": "", "answer": "A" if chance.random() < chances[pictures] else "B"}
        handler.send(200, say.completion(json.dumps(said)))

    mllm.say(reply)


def answers(mllm: MllmServer, alone: list[str], looking: str = "A") -> None:
    """Has the server give these answers from the image alone, one after the other, and another one after looking."""
    rest = list(alone)

    def reply(handler: Any) -> None:
        with mllm.lock:
            said = rest.pop(0) if len(say.images_of(handler.body)) == 1 else looking
        handler.send(200, say.completion(said if said.startswith("?") else json.dumps({"answer": said})))

    mllm.say(reply)


def asked(service: Service, times: int = 1, at_once: int = 4, headers: dict[str, str] | None = None, **body: Any):
    """The answers to one request that is sent again and again, some of them at the same time."""

    app = app_for(service)

    async def calls() -> list[dict[str, Any]]:
        transport, slots = httpx.ASGITransport(app), asyncio.Semaphore(at_once)
        async with httpx.AsyncClient(transport=transport, base_url="http://cow", timeout=60, headers=headers) as client:

            async def call() -> dict[str, Any]:
                async with slots:
                    response = await client.post("/answer", json=BODY | body)
                    assert response.status_code == 200, response.text
                    return response.json()

            return await asyncio.gather(*(call() for _ in range(times)))

    return asyncio.run(calls())


def gated(service: Service, **body: Any) -> Answer:
    """The answer without a job, of which the gate decides whether anything is imagined."""
    body = {"imagine": "auto", **body}
    return service.answer(AnswerRequest.model_validate(BODY | GIVEN | body))


@pytest.mark.parametrize("imagine", ["always", "never"])
def test_each_repeat_draws_its_own_answer(imagine: str, service: Service, mllm: MllmServer) -> None:
    draws(mllm, {1: 0.35, 2: 0.7})
    found = asked(service, REPEATS, imagine=imagine)
    assert {each["answer"] for each in found} == {"A", "B"}
    # One request imagined, the first one; the others used that, and each still drew its own answer. Of quick
    # stages those that run at the same moment do not wait for each other.
    reused = Counter(stage for each in found for stage in each["reused"])
    assert reused.keys() == set(SIMULATED if imagine == "always" else [])
    assert {reused[stage] for stage in ("grounding", "generation") if reused} <= {REPEATS - 1}
    costs = Counter((each["usage"]["calls"], each["usage_total"]["calls"]) for each in found)
    assert costs == ({(1, 3): REPEATS - 1, (3, 3): 1} if reused else {(1, 1): REPEATS})
    assert len(mllm.asked) == sum(each["usage"]["calls"] for each in found)
    looked = [call for call in mllm.asked if "`answer`" in say.text_of(call)]
    assert len(looked) == REPEATS
    assert len({json.dumps(call, sort_keys=True) for call in looked}) == 1
    assert "seed" not in looked[0]


def test_usage_is_what_it_cost_and_the_total_what_it_would_have_cost(service: Service, mllm: MllmServer) -> None:
    draws(mllm, {1: 1, 2: 1})
    body = {"question": QUESTION.replace("leave", "fall off"), "votes": 2, "baseline": True}
    first, again = (Answer.model_validate(each) for each in asked(service, 2, at_once=1, **body))
    (fresh,) = (Answer.model_validate(each) for each in asked(service, headers={"Cache-Control": "no-cache"}, **body))
    assert first.simulation is not None
    assert again.simulation is not None
    assert (first.simulation.usage.calls, first.simulation.usage_total.calls) == (2, 2)
    assert (again.simulation.usage, again.simulation.usage_total) == (Usage(), COST + COST)
    assert first.usage == first.usage_total == sum([COST] * 6, Usage())
    assert (again.usage, again.usage_total) == (sum([COST] * 4, Usage()), first.usage)
    assert (fresh.usage, fresh.usage_total, fresh.reused) == (first.usage, first.usage, ())
    old = json.loads(first.model_dump_json(exclude={"usage_total": True, "simulation": {"usage_total"}, "gate": True}))
    assert Answer.model_validate(old).usage_total == first.usage


@pytest.mark.parametrize(
    ("alone", "given", "reason", "agreement", "final"),
    [
        ("AAA", {}, "agreed", 1, ("A", {"A": 3})),
        ("AAB", {}, "disagreed", 2 / 3, ("B", {"B": 2})),
        ("AAB", {"imagine_threshold": 0.66}, "agreed", 2 / 3, ("A", {"A": 2, "B": 1})),
        ("CCC", {}, "not-sure", 1, ("B", {"B": 2})),
        ("A", {"imagine_votes": 1}, "agreed", 1, ("A", {"A": 1})),
    ],
)
def test_the_gate(
    alone: str, given: dict[str, Any], reason: str, agreement: float, final: Any, service: Service, mllm: MllmServer
) -> None:
    answers(mllm, list(alone), looking="B")
    found = gated(service, votes=2, baseline=True, **given)
    imagined = reason != "agreed"
    assert found.gate is not None
    assert (found.gate.reason, found.gate.imagined, found.gate.asked) == (reason, imagined, len(alone))
    assert found.gate.agreement == pytest.approx(agreement)
    assert (found.simulation is not None) is imagined
    assert (found.answer, found.votes) == final
    assert found.baseline is not None
    assert (found.baseline.votes, found.baseline.answer) == (found.gate.votes, found.gate.answer)
    assert found.usage.calls == len(mllm.asked) == len(alone) + 2 * imagined  # no baseline besides
    assert found.reader.stages == (("gating", "answering") if imagined else ("gating",))
    assert not found.warnings
    if found.simulation is not None:
        assert found.simulation.usage == Usage()
        assert set(found.simulation.timings) == set(SIMULATED)


def test_votes_that_cannot_be_read_agree_with_nothing(service: Service, mllm: MllmServer) -> None:
    answers(mllm, ["A", *"???????"], looking="B")  # each is asked for three times
    gate = gated(service, imagine_votes=2, imagine_threshold=0.6).gate
    assert gate is not None
    assert (gate.reason, gate.votes, gate.agreement) == ("disagreed", {"A": 1}, 0.5)
    answers(mllm, ["?"] * 6, looking="B")
    found = gated(service, imagine_votes=2)
    assert found.gate is not None
    assert (found.gate.reason, found.gate.answer, found.gate.votes, found.gate.agreement) == ("unreadable", None, {}, 0)
    assert (found.answer, found.usage.calls) == ("B", 7)


def test_where_imagining_fails_the_answer_of_the_gate_is_taken(service: Service, mllm: MllmServer) -> None:
    answers(mllm, ["A", "B", "A"])
    found = gated(service, grounding={"point": [90, 5]})  # where no outline can be seen
    assert found.gate is not None
    assert (found.gate.imagined, found.simulation) == (True, None)
    assert found.simulation_problem is not None
    assert (found.answer, found.votes, len(mllm.asked)) == ("A", {"A": 2, "B": 1}, 3)
    assert len(found.warnings) == 1


def test_a_model_that_cannot_be_asked_is_an_error_at_the_gate(service: Service, mllm: MllmServer) -> None:
    for status, code in ((400, "mllm-refused"), (404, "mllm-unavailable")):
        mllm.say(say.status(status))
        with refused(code):
            gated(service)


def test_the_embedded_reader_is_asked_once_before_it_looks(tmp_path: Path) -> None:
    """Without looking it is never sure, so that it imagines; its answers are rules, and are shared."""
    scene = example("ball-and-mug")
    with Service(Settings(data_dir=tmp_path)) as embedded:
        body = {"image": data_url(scene.image), "question": scene.meta["question"], "num_frames": 81, "ensemble": 20}
        first, again = asked(embedded, 2, at_once=1, **body, imagine="auto", baseline=True)
    assert first["gate"] == {
        "answer": "C", "votes": {"C": 1}, "asked": 1, "agreement": 1, "threshold": 1, "imagined": True,
        "reason": "not-sure",
    }  # fmt: skip
    assert (first["answer"], first["baseline"]["answer"], first["warnings"]) == ("A", "C", [])
    assert again["reused"] == ["gating", *SIMULATED, "answering"]
    assert {each["answer"] for each in (first, again)} == {"A"}


def test_what_the_gate_saw_and_what_it_cost_is_shown_everywhere(
    service: Service, mllm: MllmServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from cow_service.mcp.results import answer_text

    answers(mllm, list("AAA"))
    found = gated(service)
    reused = found.model_copy(update={"usage_total": found.usage + COST})
    Console(width=200).print(answer_table(reused))
    printed = capsys.readouterr().out
    assert all("A 3 of 3" in told for told in (answer_html(found, lambda _: None), answer_text(found, ""), printed))
    assert all(count in printed for count in ("3 calls", "300 tokens", "4 calls", "400 tokens"))
    results = [{"id": str(n), "status": "succeeded", "result": one.model_dump(mode="json")}
               for n, one in enumerate((found, reused))]  # fmt: skip
    (tmp_path / "results.jsonl").write_text("".join(json.dumps(one) + "\n" for one in results))
    assert print_summary(tmp_path) == 0
    summary = capsys.readouterr().out
    assert all(count in summary for count in ("6 calls", "600 tokens", "7 calls", "700 tokens"))


@pytest.mark.parametrize(("ends_in", "drawn_again"), [("generation", False), ("answering", True)])
def test_a_job_that_goes_on_after_a_crash_draws_nothing_again(
    ends_in: Stage, drawn_again: bool, service: Service, mllm: MllmServer, tmp_path: Path
) -> None:
    """What was stored before the crash is taken; only an answer that was never delivered is drawn again."""
    answers(mllm, list("ABA"), looking="B")
    request = AnswerRequest.model_validate(BODY | GIVEN | {"imagine": "auto"})
    with closing(open_database(tmp_path)) as database:
        for job in ("one", "two"):
            add_job(database, job)
        looked_for, locks, outages = service.metrics.stage_cache, KeyLocks(), Outages(0, lambda: None)
        step = StoredStep("one", None, False, database, service.artifacts, looked_for, locks.held, outages)

        def crash(stage: Stage | None, done: float) -> None:
            if stage == ends_in and done == float(drawn_again):  # as it begins, or ends and nothing is stored yet
                raise KeyboardInterrupt

        def crashing(stage: Stage, key: Any, compute: Any) -> Any:
            return step(stage, key, lambda: (compute(), crash(stage, 1.0))[0])

        with pytest.raises(KeyboardInterrupt):
            answer(service.prepare(request, crash, step=crashing, run_id="one"))
        before = len(mllm.asked)
        assert before == 3 + drawn_again
        found = answer(service.prepare(request, step=step, run_id="one"))
        assert len(mllm.asked) == before + 1
        assert (found.answer, found.reused) == ("B", ())
        assert found.gate is not None
        assert found.gate.votes == {"A": 2, "B": 1}
        assert found.usage == found.usage_total == sum([COST] * 4, Usage())
        again = answer(service.prepare(request, step=step, run_id="one"))
        assert (again.answer, len(mllm.asked)) == ("B", before + 1)
        answers(mllm, list("AAA"))
        others = answer(service.prepare(request, step=replace(step, job_id="two"), run_id="two"))
        assert (others.answer, others.gate and others.gate.votes, others.reused) == ("A", {"A": 3}, ())


def test_a_baseline_that_came_before_a_crash_is_not_asked_for_again(
    service: Service, mllm: MllmServer, tmp_path: Path
) -> None:
    answers(mllm, ["A"], looking="B")
    request = AnswerRequest.model_validate(BODY | GIVEN | {"baseline": True})
    with closing(open_database(tmp_path)) as database:
        add_job(database, "one")
        looked_for, locks, outages = service.metrics.stage_cache, KeyLocks(), Outages(0, lambda: None)
        step = StoredStep("one", None, False, database, service.artifacts, looked_for, locks.held, outages)

        def crash(stage: Stage | None, _done: float) -> None:
            if stage == "generation":
                eventually(lambda: "baseline" in step.stages)
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            answer(service.prepare(request, crash, step=step, run_id="one"))
        assert len(mllm.asked) == 1
        for _ in range(2):
            found = answer(service.prepare(request, step=step, run_id="one"))
            assert (found.answer, found.baseline and found.baseline.answer, found.reused) == ("B", "A", ())
            assert found.usage == found.usage_total == COST + COST
            assert len(mllm.asked) == 2
