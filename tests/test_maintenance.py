"""What is kept stays small, is found by its state, and is cleaned up by one process at a time."""

from __future__ import annotations

import json
from pathlib import Path

import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st
from job_rows import add_job

from cow_service.jobs.database import Database, StoredResult
from cow_service.jobs.job_table import JobTable
from cow_service.jobs.packing import packed, unpacked
from cow_service.settings import Settings


@given(st.recursive(st.none() | st.booleans() | st.text() | st.floats(-1e9, 1e9), st.lists))
def test_values_come_back_as_they_were(value: object) -> None:
    assert unpacked(packed(json.dumps(value))) == value


def test_long_results_are_kept_small() -> None:
    path = json.dumps([[0.125 * i, 0.5 * i] for i in range(2000)])
    assert len(packed(path)) < len(path) / 3


def test_one_process_cleans_up_at_a_time(tmp_path: Path) -> None:
    one, other = (Database(Settings(data_dir=tmp_path)) for _ in range(2))
    one.create_tables()
    assert one.take_turn("jobs", 600)
    assert not other.take_turn("jobs", 600)
    assert not one.take_turn("jobs", 600)
    assert other.take_turn("artifacts", 600), "that is another turn"
    assert other.take_turn("jobs", 0), "the turn is over"
    assert not one.take_turn("artifacts", 600)
    other.give_turn_back("artifacts")
    assert one.take_turn("artifacts", 600), "its work was not done"
    assert not one.take_turn("jobs", 600)
    one.close()
    other.close()


def test_what_belongs_to_a_job_is_deleted_with_it(tmp_path: Path) -> None:
    database = Database(Settings(data_dir=tmp_path))
    database.create_tables()
    for job, shared in (("one", "5" * 64), ("two", "5" * 64)):
        add_job(database, job)
        stored = StoredResult(job * 4, "trajectory", "{}", (job * 8, shared), '{"value":1}')
        database.store_results(job, [stored])
    assert JobTable(database).delete(["one"]) == {"one" * 8}, "the other artifacts are needed by another job"
    assert database.find_result("one" * 4) is None
    assert database.find_result("two" * 4) == ("two", {"value": {"value": 1}})
    assert database.finished_stages("one") == set()
    with database.engine.connect() as connection:
        for table in ("cow_results", "cow_trajectories_of_jobs", "cow_references", "cow_stages_of_jobs"):
            left = connection.execute(sa.text(f"SELECT DISTINCT job_id FROM {table}")).scalars().all()
            assert left == ["two"], table
    database.close()


def test_lists_of_a_status_look_at_no_other_jobs(tmp_path: Path) -> None:
    database = Database(Settings(data_dir=tmp_path))
    database.create_tables()
    with database.engine.connect() as connection:
        for wanted in ("status IN ('failed', 'canceled')", "owner = 'x'"):
            query = f"SELECT kind FROM cow_jobs WHERE {wanted} AND kind IN ('simulate', 'answer') "
            steps = connection.execute(
                sa.text(f"EXPLAIN QUERY PLAN {query} ORDER BY created_at DESC, id DESC LIMIT 50")
            )
            assert any("SEARCH" in row[3] and "cow_jobs_of" in row[3] for row in steps), wanted
    database.close()
