"""What one question costs, in counts that do not vary as times do: `data/counts.json` holds them.

A change that raises a count has to change that table, where a reader of the change sees it. One that lowers a count
lowers the table, too, or the next change could take it back unseen.
"""

from __future__ import annotations

import base64
import gc
import json
import math
import sqlite3
import subprocess
import sys
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import BuiltinFunctionType
from typing import Any

import cv2
import numpy as np
import pytest
import rapier3d
from conftest import DATA, example
from fastapi.testclient import TestClient
from sqlalchemy import event
from waiting import TIME_LIMIT

from cow_service.api.app import create_app
from cow_service.jobs.engine import JobEngine
from cow_service.pipeline import simulate
from cow_service.requests import ImageArtifact, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

TABLE: dict[str, float] = json.loads((DATA / "counts.json").read_text())
# What depends on versions of libraries is held less exactly.
TOLERANCE = {"artifact_bytes": 0.02, "row_bytes": 0.02, "modules_of_a_server": 0.05}
BY_THE_CLOCK = ("cow-ticker", "cow-clean-up", "cow-jobs")
AT_THE_START = "asyncio-portal"  # the thread of the event loop
BALL = example("ball-and-mug")
HALF = math.prod(BALL.meta["image_size"]) / 2


def hold(**counts: float) -> None:
    """Fails where a count is not what the table says."""
    off = {
        name: {"now": count, "table": TABLE[name]}
        for name, count in counts.items()
        if abs(count - TABLE[name]) > TABLE[name] * TOLERANCE.get(name, 0)
    }
    assert not off, f"Other counts than in tests/data/counts.json: change the table, and say why. {off}"


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    monkeypatch.setattr("cow_service.api.submission.POLL_SECONDS", TIME_LIMIT)  # no look by the clock
    engine = JobEngine(Service(Settings(data_dir=tmp_path, warmup=False, concurrency=1)))
    with TestClient(create_app(engine)) as client:
        yield client


def ask(client: TestClient) -> dict[str, Any]:
    image = "data:image/jpeg;base64," + base64.b64encode(BALL.image).decode()
    answer = client.post("/simulate", json={"image": image, "question": BALL.meta["question"]})
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.fixture
def statements(client: TestClient) -> Counter[str]:
    """How often each kind of statement is sent while a question is answered, but by the clock and as it starts."""
    said: Counter[str] = Counter()

    def note(statement: str) -> None:
        if not threading.current_thread().name.startswith((*BY_THE_CLOCK, AT_THE_START)):
            said[statement.split(maxsplit=1)[0].upper()] += 1

    def trace(connection: sqlite3.Connection, *_: object) -> None:
        connection.set_trace_callback(note)

    event.listen(client.app.state.engine.database.engine, "checkout", trace)  # type: ignore[attr-defined]
    return said


def test_a_question_in_the_database(client: TestClient, tmp_path: Path, statements: Counter[str]) -> None:
    ask(client)
    tables = ("cow_jobs", "cow_results", "cow_trajectories_of_jobs", "cow_references", "cow_stages_of_jobs")
    with sqlite3.connect(tmp_path / "jobs.sqlite3") as database:
        rows = [row for table in tables for row in database.execute(f"SELECT * FROM {table}")]
    kept = sum(path.stat().st_size for path in (tmp_path / "artifacts").rglob("*") if path.is_file())
    size = sum(len(value) if isinstance(value, str | bytes) else 8 for row in rows for value in row)
    hold(statements=sum(statements.values()), commits=statements["COMMIT"], row_bytes=size, artifact_bytes=kept)


def test_a_question_in_the_engine_and_in_pictures(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    counted: Counter[str] = Counter()
    steps = rapier3d.PhysicsWorld.step

    def step(world: rapier3d.PhysicsWorld) -> None:
        counted["engine_steps"] += 1
        steps(world)

    monkeypatch.setattr(rapier3d.PhysicsWorld, "step", step)
    for name, function in vars(cv2).items():
        if name[0].islower() and isinstance(function, BuiltinFunctionType):
            monkeypatch.setattr(cv2, name, passing(function, counted))
    simulation = ask(client)
    hold(worlds=simulation["trajectory"]["ensemble"], **counted)


def passing(function: Callable[..., Any], counted: Counter[str]) -> Callable[..., Any]:
    """The function, which counts its calls with an array of at least half the picture."""

    def call(*arguments: Any, **named: Any) -> Any:
        areas = [math.prod(each.shape[:2]) for each in arguments if isinstance(each, np.ndarray)]
        counted["whole_passes"] += max(areas, default=0) >= HALF
        return function(*arguments, **named)

    return call


def test_pixels_of_a_question_are_given_back_at_once(service: Service) -> None:
    """A circle of references would hold a photograph, and all that was measured in it, until garbage is collected."""
    image = ImageArtifact(artifact=service.keep_image(BALL.image).sha256)
    request = SimulateRequest(image=image, question=BALL.meta["question"], video=False)
    gc.disable()
    try:
        run = service.prepare(request)
        simulate(run)
        alive = weakref.ref(run), weakref.ref(run.sight.look())
        del run
        assert [each() for each in alive] == [None, None]
    finally:
        gc.enable()


@pytest.mark.slow
def test_modules_of_a_server() -> None:
    code = "import sys, cow_service.server, cow_service.api.app; print(len(sys.modules))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    hold(modules_of_a_server=int(told.stdout))
