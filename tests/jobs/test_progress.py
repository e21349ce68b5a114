"""The stages are declared once, and progress never goes back, whichever of them a run has."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise, product
from types import SimpleNamespace
from typing import Any, get_args
from unittest.mock import MagicMock

import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st

from cow_service import pipeline
from cow_service.errors import CannotGround
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.subscriptions import JobEvent, follow
from cow_service.records import SIMULATION_STAGES, STAGES, TERMINAL, Job, Stage, share_done
from cow_service.records.stages import ReadingStage
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.stages.keys import KEY_FIELDS, RESULT_TYPES

Told = list[tuple[Stage | None, float]]
REPORTED = (0.0, 0.4, 1.0)
IN_ORDER = [stage for stage, traits in STAGES.items() if not traits.is_beside]


def test_every_stage_is_declared_once() -> None:
    assert set(get_args(Stage)) == STAGES.keys() == KEY_FIELDS.keys() == RESULT_TYPES.keys()
    assert {stage for stage in STAGES if KEY_FIELDS[stage].backend == "reader"} == set(get_args(ReadingStage))
    assert sum(traits.share for traits in STAGES.values()) == pytest.approx(1)


def test_the_page_has_the_same_stages() -> None:
    text = (ROOT / "cow_service" / "web" / "app" / "words.js").read_text()
    named = re.search(r"export const STAGES = \{(.*?)\n\}", text, re.DOTALL)
    listed = re.search(r"export const SIMULATE_STAGES = \[(.*?)\]", text)
    assert named is not None
    assert listed is not None
    assert re.findall(r"^ +(\w+):", named[1], re.MULTILINE) == IN_ORDER
    assert re.findall(r"\w+", listed[1]) == [stage for stage in SIMULATION_STAGES if stage != "depth"]


class Rehearsal(MagicMock):
    """Stands in for a run: its stages report what they would, come to nothing, and one of them may fail."""

    def rehearse(self, request: Any, has_depth: bool, fails_at: Stage | None) -> Told:
        self.request, self.wants_depth, self.fails_at = request, has_depth, fails_at
        self.told: Told = []
        (pipeline.answer if isinstance(request, AnswerRequest) else pipeline.simulate)(self)
        return self.told

    def stage(self, name: Stage, *_: Any) -> Any:
        self.told += [(name, done) for done in REPORTED[: 2 if name == self.fails_at else None]]
        if name == self.fails_at:
            raise CannotGround("nothing there")
        return MagicMock()

    @contextmanager
    def beside(self, name: Stage, *_: Any) -> Iterator[Any]:
        self.told.append((None, 0.0))
        yield MagicMock


@pytest.fixture
def orders(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Told]]:
    """What is reported in every order that a run can take, and of which kind of job."""
    for name in ("Simulation", "Answer", "reading_of", "narrate", "Problem"):
        monkeypatch.setattr(pipeline, name, MagicMock())
    asked = {"image": {"artifact": "0" * 64}, "question": "?"}
    found: list[tuple[str, Told]] = []
    for has_depth, fails_at in product((False, True), (None, *SIMULATION_STAGES)):
        if fails_at is None:
            told = Rehearsal().rehearse(SimulateRequest.model_validate(asked), has_depth, None)
            found.append(("simulate", told))
        for imagine, imagined, baseline in product(("always", "auto", "never"), (False, True), (False, True)):
            monkeypatch.setattr(pipeline, "gate_of", lambda *_, imagined=imagined: SimpleNamespace(imagined=imagined))
            request = AnswerRequest.model_validate({**asked, "imagine": imagine, "baseline": baseline})
            found.append(("answer", Rehearsal().rehearse(request, has_depth, fails_at)))
    return found


def test_progress_goes_on_in_every_order_that_a_run_can_take(orders: list[tuple[str, Told]]) -> None:
    seen = {tuple(dict.fromkeys(stage for stage, _ in told if stage)) for _, told in orders}
    assert {stage for order in seen for stage in order} == set(IN_ORDER)
    assert len(seen) > 12
    for kind, told in orders:
        shares = [share_done(kind, stage, done) for stage, done in told if stage is not None]
        assert all(0 <= before <= after <= 1 for before, after in pairwise(shares)), (kind, told)
        assert told[-1][1] < 1 or told[-1][0] == "gating" or shares[-1] == 1
        jobs = ActiveJobs()
        active = jobs.begin("job", kind, "run")  # type: ignore[arg-type]
        for stage, done in told:
            jobs.progress("job", active, stage, done)
        assert active.at == [each for each in told if each[0] is not None][-1], "what was reported last"


@given(st.lists(st.tuples(st.sampled_from([None, *STAGES]), st.floats(0, 1))), st.sampled_from(["simulate", "answer"]))
def test_what_is_reported_out_of_order_takes_nothing_back(told: Told, kind: Any) -> None:
    jobs, shares = ActiveJobs(), [0.0]
    active = jobs.begin("job", kind, "run")
    for stage, done in told:
        jobs.progress("job", active, stage, done)
        shares += [worker.progress for worker in jobs.describe(["job"])]
    assert shares == sorted(shares)


def test_a_stage_that_is_stored_late_takes_nothing_back(monkeypatch: pytest.MonkeyPatch) -> None:
    job = Job(id="job", kind="simulate", status="running", progress=0, created_at="", generator="cutout")

    def at(status: Any, stage: Any, progress: float) -> Job:
        return job.model_copy(update={"status": status, "stage": stage, "progress": progress})

    generating = JobEvent("progress", None, at("running", "generation", 0.5))
    stored = JobEvent("stage", 3, at("running", "grounding", 0.1))
    again = JobEvent("progress", None, at("running", "grounding", 0.0))  # another process has the job now
    done = at("succeeded", None, 1.0)
    states = iter([(job, [generating]), (job, [stored, again]), (done, [JobEvent("succeeded", 100, done)])])
    monkeypatch.setattr("cow_service.jobs.subscriptions.state_of", lambda *_: next(states))
    monkeypatch.setattr("cow_service.jobs.subscriptions.POLL_SECONDS", 0.0)

    async def heard() -> list[JobEvent]:
        engine: Any = SimpleNamespace(active=ActiveJobs())
        return [event async for event in follow(engine, "job", 0)]

    events = asyncio.run(heard())
    assert [(event.name, event.job and event.job.progress) for event in events] == [
        ("progress", 0.5), ("stage", 0.5), ("succeeded", 1.0),
    ]  # fmt: skip
    assert events[-1].job is not None
    assert events[-1].job.status in TERMINAL
