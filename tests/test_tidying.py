"""What is kept stays small, is found by its state, and is tidied by one process at a time."""

from __future__ import annotations

import json
from pathlib import Path

import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st

from cow_service.errors import InvalidRequest
from cow_service.jobs.database import Database
from cow_service.jobs.migration import migrate
from cow_service.jobs.packing import LEAST, packed, unpacked
from cow_service.jobs.serializer import JsonSerializer
from cow_service.jobs.tidying import give_turn_back, takes_turn, without_job
from cow_service.settings import Settings


@given(st.text(), st.integers(0, 3))
def test_a_text_comes_back_as_it_was(text: str, times: int) -> None:
    long = text * (LEAST * times // max(1, len(text)) + 1)
    assert unpacked(packed(long)) == long
    assert unpacked(text) == text or text.startswith("deflated:"), "an earlier version did not pack"


def test_long_results_are_kept_small_and_short_ones_as_they_are() -> None:
    serializer, path = JsonSerializer(), json.dumps([[0.125 * i, 0.5 * i] for i in range(2000)])
    kept = serializer.serialize(path)
    assert len(kept) < len(path) / 2
    assert serializer.deserialize(kept) == path
    assert serializer.deserialize(json.dumps(path)) == path, "as an earlier version wrote it"
    assert serializer.serialize({"a": 1}) == '{"a":1}'
    error = serializer.deserialize(serializer.serialize(InvalidRequest("x" * LEAST)))
    assert isinstance(error, InvalidRequest)


def test_one_process_tidies_at_a_time(tmp_path: Path) -> None:
    migrate(Settings(data_dir=tmp_path))
    one, other = (Database(Settings(data_dir=tmp_path)) for _ in range(2))
    assert takes_turn(one, "jobs", 600)
    assert not takes_turn(other, "jobs", 600)
    assert not takes_turn(one, "jobs", 600)
    assert takes_turn(other, "artifacts", 600), "that is another turn"
    assert takes_turn(other, "jobs", 0), "the turn is over"
    assert not takes_turn(one, "artifacts", 600)
    give_turn_back(other, "artifacts")
    assert takes_turn(one, "artifacts", 600), "its work was not done"
    assert not takes_turn(one, "jobs", 600)
    one.close()
    other.close()


def test_what_belongs_to_no_job_is_found(tmp_path: Path) -> None:
    migrate(Settings(data_dir=tmp_path))
    database = Database(Settings(data_dir=tmp_path))
    database.add_references("gone", ["0" * 64])
    database.store_result("1" * 64, "lost", "motion", "{}", [])
    assert without_job(database) == ["gone", "lost"]
    with database.engine.begin() as connection:
        columns = "workflow_uuid, status, name, created_at, updated_at, priority"
        connection.execute(
            sa.text(f"INSERT INTO workflow_status ({columns}) VALUES ('lost', 'SUCCESS', 'simulate', 0, 0, 0)")
        )
    assert without_job(database) == ["gone"]
    database.close()


def test_lists_of_a_status_look_at_no_other_jobs(tmp_path: Path) -> None:
    migrate(Settings(data_dir=tmp_path))
    database = Database(Settings(data_dir=tmp_path))
    with database.engine.connect() as connection:
        for wanted in ("status IN ('ERROR', 'CANCELLED')", "authenticated_user = 'x'"):
            query = f"SELECT name FROM workflow_status WHERE {wanted} AND name IN ('simulate', 'answer') "
            steps = connection.execute(sa.text(f"EXPLAIN QUERY PLAN {query} ORDER BY created_at DESC LIMIT 50"))
            assert any("SEARCH" in row[3] and "cow_jobs_of" in row[3] for row in steps), wanted
    database.close()
