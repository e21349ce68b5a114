"""What is kept of a job: its trajectory once, JSON exact and small; its result is whole all the same."""

from __future__ import annotations

import json
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from drawn import ball, floor, png_bytes
from engines import app_for, running_engine
from fastapi.testclient import TestClient
from job_rows import add_job, open_database
from servers import data_url

from cow_service.jobs.database import Database, StoredResult
from cow_service.jobs.schema import JOBS, RESULTS, TRAJECTORIES, unpacked
from cow_service.records import Simulation
from cow_service.service import Service
from cow_service.settings import Settings

BODY: dict[str, Any] = {
    "image": data_url(png_bytes(ball(floor(96, 64), (30, 40), 8, (210, 20, 20)))),
    "question": "If the red ball rolls to the right, does it stop?",
    "grounding": {"bbox": [22, 32, 38, 48], "object": "red ball"},
    "motion": {"direction": [1, 0]},
    "num_frames": 17,
    "video": False,
}


def test_a_trajectory_is_kept_once_and_belongs_to_the_job_that_computed_it(tmp_path: Path) -> None:
    with Service(Settings(data_dir=tmp_path)) as service, TestClient(app_for(service)) as client:
        database = running_engine().database
        sent = client.post("/simulate", json=BODY)
        one = sent.json()
        stored = client.get(f"/jobs/{one['id']}").json()["result"]
        assert stored == one, "the same when it is read from the database"
        paths = json.loads(Simulation.model_validate(one).trajectory.model_dump_json())["paths"]
        assert [has(paths, value) for value in values_of(database, one["id"])] == [True] + 5 * [False]
        other = client.post("/simulate", json=BODY | {"frames": {"count": 2}}).json()
        assert other["reused"] == ["grounding", "motion", "trajectory"]
        client.delete(f"/jobs/{one['id']}")
        assert values_of(database, one["id"]) == []
        assert client.get(f"/jobs/{other['id']}").json()["result"] == other, "no part of it was another job's"
        again = client.post("/simulate", json=BODY).json()
        assert "trajectory" not in again["reused"]
        assert again["trajectory"] == one["trajectory"]


def values_of(database: Database, job: str) -> list[Any]:
    """The trajectory of a job, and the results of its stages and its own, as they are kept."""
    own = database.read(sa.select(TRAJECTORIES.c.trajectory).where(TRAJECTORIES.c.job_id == job))
    stages = database.read(sa.select(RESULTS.c.result).where(RESULTS.c.job_id == job))
    results = database.read(sa.select(JOBS.c.result).where(JOBS.c.id == job))
    return [unpacked(row[0]) for row in (*own, *stages, *results)]


def has(part: Any, value: Any) -> bool:
    """Whether JSON values have a part."""
    if part == value:
        return True
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return any(has(part, each) for each in parts)


def test_each_stage_key_has_a_trajectory_of_its_own(tmp_path: Path) -> None:
    """A job that is computed again from an earlier stage on, or by two processes, may come to two."""
    with closing(open_database(tmp_path)) as database:
        add_job(database, "job")
        paths = {"a1" * 32: 1, "b2" * 32: 2}
        for key, number in paths.items():
            database.store_results("job", [StoredResult(key, "trajectory", "{}", (), f'{{"paths":[{number}]}}')])
        found = {key: database.find_result(key) for key in paths}
    assert found == {key: ("job", {"value": {"paths": [number]}}) for key, number in paths.items()}


def test_what_earlier_versions_packed_is_read(tmp_path: Path) -> None:
    """They kept second differences in place of long lists of numbers."""
    kept = {"points": {"~rows": [[2750, 10, 0], [2250, 5, -1]], "~decimals": 1}, "other": [1.5]}
    points = [[275.0, 225.0], [551.0, 450.5], [827.0, 675.9]]
    assert unpacked(zlib.compress(json.dumps(kept).encode())) == {"points": points, "other": [1.5]}
