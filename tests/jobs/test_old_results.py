"""Results that an older version stored can still be read: from the job database, by the SDK, and as records."""

from __future__ import annotations

import json
import sqlite3
import zlib
from contextlib import closing
from pathlib import Path
from uuid import uuid4

from conftest import DATA
from servers import BODY, Served

from cow_service.client import Client
from cow_service.jobs.job_table import JobSpec
from cow_service.records import Answer, Simulation

OLD = (DATA / "answer_of_format_2.json").read_text()  # its trajectory is its only path


def test_an_answer_with_an_old_simulation_is_read() -> None:
    answer, old = Answer.model_validate_json(OLD), json.loads(OLD)["simulation"]["trajectory"]
    assert answer.simulation is not None
    trajectory = answer.simulation.trajectory
    assert (trajectory.law, trajectory.bodies, trajectory.outcome) == ("ballistic", (), None)
    assert json.loads(trajectory.path.model_dump_json())["points"] == old["points"]
    assert trajectory.num_frames == 7
    again = Simulation.model_validate_json(answer.simulation.model_dump_json())
    assert again == answer.simulation


def test_the_jobs_of_an_older_version_are_read(tmp_path: Path) -> None:
    simulated = json.dumps(json.loads(OLD)["simulation"], separators=(",", ":"))
    with Served(tmp_path) as served, Client(str(served.http.base_url)) as client:
        for kind, result in (("simulate", simulated), ("answer", OLD.strip())):
            job = served.http.post(f"/{kind}", json=BODY, headers={"Prefer": "respond-async"}).json()["id"]
            client.job(job).wait(60)
            _store(served, job, result)
            found = served.http.get(f"/jobs/{job}").json()["result"]
            told = found["simulation"] if kind == "answer" else found
            assert set(told["trajectory"]) >= {"law", "paths", "outcome"}
            assert "points" not in told["trajectory"]
            read = client.job(job).wait(60)
            simulation = read.simulation if isinstance(read, Answer) else read
            assert simulation is not None
            assert simulation.trajectory.path.points[0] == (275.5, 225.5)
            assert "yellow ball" in repr(simulation)


def test_the_spec_of_an_older_version_is_read() -> None:
    request = {"image": {"artifact": "0" * 64}, "question": "?", "motion": {"direction": [1, 0]}}
    spec = JobSpec(kind="simulate", request=request, reader="embedded", generator="cutout", created_at=str(uuid4()))
    asked = spec.parsed()
    assert (asked.law, asked.ensemble, spec.attached) == ("contact", 50, [])
    assert asked.stated_motion is not None
    assert asked.stated_motion.stated_kind == "linear"


def _store(served: Served, job: str, result: str) -> None:
    """Puts a result into the database of a server, as the version that made it wrote it."""
    stored = zlib.compress(result.encode())
    with closing(sqlite3.connect(served.data / "jobs.sqlite3")) as database, database:
        change = "UPDATE cow_jobs SET result = ?, format = 2, trajectory_key = NULL WHERE id = ?"
        assert database.execute(change, (stored, job)).rowcount == 1
