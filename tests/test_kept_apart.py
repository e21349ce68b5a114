"""A job's trajectory is in the database once, and its result is whole all the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import sqlalchemy as sa
from drawn import ball, floor, png_bytes
from engines import app_for, running_engine
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel
from servers import data_url

from cow_service.jobs import state
from cow_service.jobs.database import Database
from cow_service.jobs.kept_apart import key_in, whole, without
from cow_service.jobs.packing import inflated, unpacked
from cow_service.jobs.tables import RESULTS, TRAJECTORIES
from cow_service.records import Simulation
from cow_service.service import Service
from cow_service.settings import Settings

KEY, OTHER = "a1" * 32, "b2" * 32
BODY: dict[str, Any] = {
    "image": data_url(png_bytes(ball(floor(96, 64), (30, 40), 8, (210, 20, 20)))),
    # What a question says is a JSON string, in which the mark cannot be taken for the mark.
    "question": 'If the red ball rolls to the right, is it "trajectory":"kept apart: ' + 64 * "0" + '" or not?',
    "grounding": {"bbox": [22, 32, 38, 48], "object": "red ball"},
    "motion": {"direction": [1, 0]},
    "num_frames": 17,
    "video": False,
}


class Part(BaseModel):
    """Stands for a trajectory."""

    text: str


class Said(BaseModel):
    """Stands for a result."""

    before: str
    trajectory: Part
    value: Part


def test_a_trajectory_is_kept_once_and_belongs_to_the_job_that_computed_it(tmp_path: Path) -> None:
    with Service(Settings(data_dir=tmp_path)) as service, TestClient(app_for(service)) as client:
        database = running_engine().database
        sent = client.post("/simulate", json=BODY)
        one = sent.json()
        stored = client.get(f"/jobs/{one['id']}").json()["result"]
        assert stored == one, "the same when it is read from the database"
        states = Simulation.model_validate(one).trajectory.model_dump_json(include={"paths"})[1:-1]
        assert [states in text for text in texts_of(database, one["id"])] == [True, False, False, False, False]
        found = state.find(one["id"], running_engine().active)
        assert found is not None
        assert key_in(found.result or "", "trajectory"), "nor is it in the outcome"
        other = client.post("/simulate", json=BODY | {"frames": {"count": 2}}).json()
        assert other["reused"] == ["grounding", "motion", "trajectory"]
        client.delete(f"/jobs/{one['id']}")
        assert texts_of(database, one["id"]) == []
        assert client.get(f"/jobs/{other['id']}").json()["result"] == other, "no part of it was another job's"
        again = client.post("/simulate", json=BODY).json()
        assert "trajectory" not in again["reused"]
        assert again["trajectory"] == one["trajectory"]


def texts_of(database: Database, job: str) -> list[str]:
    """The trajectory of a job, and the results of its stages, as they are kept."""
    with database.engine.connect() as connection:
        own = connection.execute(sa.select(TRAJECTORIES.c.trajectory).where(TRAJECTORIES.c.job_id == job)).scalars()
        rows = connection.execute(sa.select(RESULTS.c.result).where(RESULTS.c.job_id == job)).scalars()
        return [inflated(each) for each in own] + [unpacked(row) for row in rows]


@given(st.text(), st.sampled_from(["trajectory", "value"]), st.text())
def test_a_text_is_whole_again(before: str, name: str, inside: str) -> None:
    record = Said(before=before, trajectory=Part(text=inside), value=Part(text=inside))
    text, part = record.model_dump_json(), getattr(record, name).model_dump_json()
    assert key_in(text, name) is None
    short = without(text, name, part, KEY)
    assert key_in(short, name) == KEY
    assert whole(short, name, part, KEY) == text


def test_each_stage_key_has_a_trajectory_of_its_own(tmp_path: Path) -> None:
    """A job that is computed again from an earlier stage on, or by two processes, may come to two."""
    database = Database(Settings(data_dir=tmp_path))
    database.create_tables()
    for key, text in ((KEY, '{"paths":[1]}'), (OTHER, '{"paths":[2]}')):
        marked = without(f'{{"value":{text}}}', "value", text, key)
        database.store_result(key, "job", "trajectory", marked, [], text)
    found = [database.find_result(key) for key in (KEY, OTHER)]
    assert found == [("job", '{"value":{"paths":[1]}}'), ("job", '{"value":{"paths":[2]}}')]
    database.close()
