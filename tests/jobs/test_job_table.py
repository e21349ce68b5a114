"""Jobs in their queues: who takes which, what a process that ended leaves, and which attempt may end a job."""

from __future__ import annotations

import json
import re
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import engines
import pytest
import sqlalchemy as sa
from dbos import DBOS
from engines import running_engine
from job_rows import add_job, take_new_job
from postgres import postgres_server
from pydantic import SecretStr
from waiting import eventually

from cow_service.errors import Canceled, InternalError, InvalidRequest
from cow_service.jobs import webhooks
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.attempts import Dispatcher
from cow_service.jobs.database import Database, StoredResult
from cow_service.jobs.job_table import MAX_STARTS, JobFilters, JobTable
from cow_service.jobs.maintenance import Maintenance
from cow_service.jobs.schema import JOBS
from cow_service.settings import Settings


@pytest.fixture(scope="module")
def postgres() -> Iterator[SecretStr]:
    with postgres_server() as url:
        yield SecretStr(url)


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.slow)])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    url = request.getfixturevalue("postgres") if request.param == "postgres" else None
    database = Database(Settings(data_dir=tmp_path, database_url=url))
    database.create_tables()
    yield database
    with database.transaction() as connection:
        connection.execute(sa.delete(JOBS))
    database.close()


def ids(jobs: list[Any]) -> list[str]:
    return [job.id for job in jobs]


def test_jobs_are_taken_in_their_turns_and_once(database: Database) -> None:
    table = JobTable(database)
    for number in range(3):
        for owner in ("alice", "bob"):
            add_job(database, f"{owner}-{number}", owner)
    add_job(database, "gpu", queue="ati")
    assert sorted(table.waiting_queues()) == ["ati", "light"]
    first = table.take("light", "me", 4, None)
    assert Counter(job.owner for job in first) == {"alice": 2, "bob": 2}
    assert sorted(ids(table.take("light", "other", 9, None))) == ["alice-2", "bob-2"]
    assert table.take("light", "me", 9, None) == []
    assert table.waiting_queues() == ["ati"]
    assert table.executors() == {"me", "other"}
    assert (table.count_open("alice"), table.count_open(None)) == ((7, 3), (7, 1))


LISTS = [
    {"kind": "answer"},
    {"kind": "answer", "status": ["failed"]},
    {"kind": "answer", "status": ["queued", "failed", "failed"]},
    {"kind": "simulate", "status": ["running"]},
    {"status": ["failed", "canceled"]},
    {},
]


def fill(database: Database, count: int) -> None:
    """Jobs of two keys: of a hundred one is an answer that failed, and 19 are simulations that did."""
    add_job(database, "first", "alice")
    columns = [column.name for column in JOBS.columns]
    values = {
        "id": "'job-' || n",
        "owner": "CASE n % 2 WHEN 0 THEN 'alice' ELSE 'bob' END",
        "kind": "CASE n % 100 WHEN 0 THEN 'answer' ELSE 'simulate' END",
        "status": "CASE WHEN n % 100 < 20 THEN 'failed' ELSE 'succeeded' END",
        "created_at": "'2026-01-01T00:00:' || (10 + n % 50) || '.000Z'",  # many have equal times
    }
    query = (
        f"WITH RECURSIVE numbers AS (SELECT 1 AS n UNION ALL SELECT n + 1 FROM numbers WHERE n < {count}) "
        f"INSERT INTO cow_jobs ({', '.join(columns)}) "
        f"SELECT {', '.join(values.get(name, name) for name in columns)} FROM "
        "(SELECT * FROM cow_jobs WHERE id = 'first') f, numbers"
    )
    with database.transaction() as connection:
        connection.execute(sa.text(query.replace(" id,", " f.id,")))


@pytest.mark.parametrize("owner", [None, "alice"])
@pytest.mark.parametrize("wanted", LISTS, ids=str)
def test_lists_have_what_is_wanted_once(database: Database, owner: str | None, wanted: dict[str, Any]) -> None:
    fill(database, 600)
    rows = database.read(sa.select(JOBS.c.id, JOBS.c.owner, JOBS.c.kind, JOBS.c.status, JOBS.c.created_at))
    expected = [
        row.id
        for row in sorted(rows, key=lambda row: (row.created_at, row.id), reverse=True)
        if row.owner == (owner or row.owner)
        and row.kind == wanted.get("kind", row.kind)
        and row.status in wanted.get("status", [row.status])
    ]
    table, found, cursor = JobTable(database), [], None
    while found == [] or cursor is not None:
        page = table.page(owner, JobFilters(limit=100, cursor=cursor, **wanted), {})
        found += ids([*page.jobs])
        cursor = page.next
        if not page.jobs:
            break
    assert found == expected


@pytest.mark.parametrize("owner", [None, "alice"])
@pytest.mark.parametrize("wanted", LISTS, ids=str)
def test_no_list_looks_at_other_jobs(database: Database, owner: str | None, wanted: dict[str, Any]) -> None:
    """Each is answered from ranges of an index that hold nothing else."""
    fill(database, 20_000)
    asked: list[tuple[str, Any]] = []

    def note(_connection: Any, _cursor: Any, statement: str, values: Any, *_: Any) -> None:
        asked.append((statement, values))

    sa.event.listen(database.engine, "before_cursor_execute", note)
    JobTable(database).page(owner, JobFilters(**wanted), {})
    sa.event.remove(database.engine, "before_cursor_execute", note)
    ((statement, values),) = asked
    with database.engine.connect() as connection:
        if database.file is None:
            connection.exec_driver_sql("ANALYZE cow_jobs")
            (plan,) = connection.exec_driver_sql(f"EXPLAIN (ANALYZE, FORMAT JSON) {statement}", values).scalars()
            used = re.findall(r'"(?:Index|Relation) Name": "(cow_jobs\w*)"', json.dumps(plan))
            assert used.count("cow_jobs") * 2 == len(used), "a table is read without an index"
            removed = re.findall(r'"Rows Removed by Filter": (\d+)', json.dumps(plan))
            assert sum(map(int, removed)) <= 1, "of a status that one job has any index is as good"
        else:
            steps = [row[3] for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", values)]
            used = [name for step in steps for name in re.findall(r"cow_jobs\w*", step)]
            assert not [step for step in steps if re.match(r"SCAN cow_jobs(?! USING)", step)]
            of_kind, plain = (
                {"cow_jobs_of_kind", "cow_jobs_of_owner_and_kind"},
                {"cow_jobs_of_time", "cow_jobs_of_owner"},
            )
            assert set() < {*used} - {"cow_jobs"} <= (of_kind if wanted else plain)


def test_no_owner_has_more_taken_jobs_than_they_may_have(database: Database) -> None:
    table = JobTable(database)
    for owner in ("alice", "bob", None):
        for number in range(3):
            add_job(database, f"{owner}-{number}", owner)
    taken = table.take("light", "me", 9, 1)
    assert Counter(job.owner for job in taken) == {"alice": 1, "bob": 1, None: 3}
    assert table.take("light", "other", 9, 1) == []
    alice = next(job for job in taken if job.owner == "alice")
    assert table.cancel(alice.id)
    assert ids(table.take("light", "other", 9, 1)) == ["alice-1"]


def test_many_who_take_at_the_same_time_take_each_job_once(database: Database) -> None:
    table = JobTable(database)
    for number in range(60):
        add_job(database, str(number), "alice")

    def take(executor: int) -> list[str]:
        return [job.id for _ in range(10) for job in table.take("light", str(executor), 2, None)]

    with ThreadPoolExecutor(8) as pool:
        taken = [job for some in pool.map(take, range(8)) for job in some]
    assert sorted(taken, key=int) == [str(number) for number in range(60)]


def test_only_the_latest_attempt_ends_a_job_and_what_has_ended_stays(database: Database) -> None:
    table = JobTable(database)
    add_job(database, "job")
    (old,) = table.take("light", "frozen", 1, None)
    assert table.begin(old)
    assert table.recover(["frozen"]) == ["job"]
    found = table.find("job", None)
    assert found is not None
    assert (found.job.status, found.job.position) == ("queued", 0)
    (new,) = table.take("light", "me", 1, None)
    assert not table.begin(old)
    assert not table.succeed(old, '{"by":"old"}', None, ())
    table.release("job", old.run)
    assert table.begin(new)
    assert table.succeed(new, '{"by":"new"}', None, ())
    assert table.succeed(new, '{"by":"new"}', None, ()), "a repeated try whose first commit was not heard of"
    assert not table.fail(new, InternalError("late"))
    assert not table.cancel("job")
    assert table.recover(["me", "frozen"]) == []
    assert ids(table.page(None, JobFilters(status=("succeeded",)), {}).jobs) == ["job"]


def test_callers_that_are_slow_do_not_make_a_queue_slow(database: Database) -> None:
    table = JobTable(database)

    def waits(job: str) -> float | None:
        add_job(database, job)
        found = table.find(job, None)
        assert found is not None
        return found.job.expected_wait

    for job in ("first", "second"):
        add_job(database, job)
        (taken,) = table.take("light", "me", 1, None)
        assert table.begin(taken)
        assert table.succeed(taken, "{}", None, ())
    assert waits("third") is None, "how long it takes is not known: nobody works, and nothing is ahead of it"
    table.take("light", "me", 1, None)
    assert waits("fourth") is not None


def test_a_job_that_lost_a_stage_in_a_crash_of_the_database_does_not_succeed_without_it(database: Database) -> None:
    table = JobTable(database)
    job = take_new_job(database, "job", "me")
    database.store_results("job", [StoredResult("key", "grounding", "{}", ("a" * 64,))])
    assert not table.succeed(job, "{}", None, ("grounding", "generation"))
    assert table.taken_by("me") == {"job": job.run}
    database.store_results("job", [StoredResult("another key", "generation", "{}", ("b" * 64,))])
    assert table.succeed(job, "{}", None, ("grounding", "generation"))


def test_results_of_a_deleted_job_lock_nobody_out(database: Database, tmp_path: Path) -> None:
    """Not even while the error is kept, whose traceback holds the failed statement."""
    take_new_job(database, "job", "me")
    JobTable(database).delete(["job"])
    with pytest.raises(Canceled) as held:
        database.find_result("key", "job", [StoredResult("key", "grounding", "{}", ("a" * 64,))])
    with closing(Database(Settings(data_dir=tmp_path, database_url=SecretStr(database.url)))) as another_process:
        assert add_job(another_process, "another job")
    assert held


def test_after_jobs_connections_are_closed(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    active = ActiveJobs()
    parts: Any = SimpleNamespace(active=active, database=database, jobs=JobTable(database), executor="me")
    calls: Any = SimpleNamespace(busy_executors=set)
    tidying = Maintenance(parts, calls, SimpleNamespace(), lambda jobs, since: None, lambda: None)  # type: ignore[arg-type]
    monkeypatch.setattr("cow_service.jobs.active.QUIET_SECONDS", 0.5)
    held = [database.engine.connect() for _ in range(5)]
    for one in held:
        one.close()
    tidying._close_idle_connections()
    assert database.engine.pool.checkedin() == 5  # type: ignore[attr-defined]
    eventually(lambda: active.is_quiet)
    tidying._close_idle_connections()
    assert database.engine.pool.checkedin() == 0  # type: ignore[attr-defined]
    database.check()


def test_a_job_of_the_same_id_is_not_ended_by_the_attempt_of_a_deleted_one(database: Database) -> None:
    table = JobTable(database)
    old = take_new_job(database, "job", "me")
    assert not add_job(database, "job"), "the id is taken"
    table.delete(["job"])
    new = take_new_job(database, "job", "me")
    assert not table.succeed(old, "{}", None, ())
    assert table.taken_by("me") == {"job": new.run}


def test_a_job_that_ends_its_process_each_time_fails(database: Database) -> None:
    ended: list[str] = []
    table = JobTable(database, lambda connection, job_id, url: ended.append(url))
    add_job(database, "killer", webhook="https://call.test")
    for _ in range(MAX_STARTS):
        assert ended == []
        assert ids(table.take("light", "me", 1, None)) == ["killer"]
        table.recover(["me"])
    found = table.find("killer", None)
    assert found is not None
    assert (found.job.status, ended) == ("failed", ["https://call.test"])
    assert isinstance(found.error, InternalError)
    assert "ended repeatedly" in found.error.detail


def test_pages_show_each_job_once(database: Database) -> None:
    table = JobTable(database)
    for number in range(25):  # some at the same time
        add_job(database, f"{number:02}", created_at=f"2026-01-01T00:00:00.{number // 3:03}Z")
    shown: list[str] = []
    cursor = None
    while True:
        page = table.page(None, JobFilters(limit=4, cursor=cursor), {})
        shown += ids(list(page.jobs))
        cursor = page.next
        if cursor is None:
            break
    assert shown == [f"{number:02}" for number in range(24, -1, -1)]
    for wrong in ("", "x", "W10", "WzEsMl0", "é"):
        with pytest.raises(InvalidRequest, match="cursor"):
            table.page(None, JobFilters.model_construct(cursor=wrong), {})


@pytest.mark.parametrize("capacity", [0, 3])
def test_no_more_jobs_are_taken_than_there_are_places(capacity: int) -> None:
    waiting, started, told = list("abcdefgh"), [], threading.Event()

    def take(queue: str, executor: str, number: int, limit: int | None) -> list[str]:
        taken = waiting[:number]
        del waiting[:number]
        return taken

    jobs = SimpleNamespace(waiting_queues=lambda: ["light"], take=take)
    settings = SimpleNamespace(running_limit_per_key=None)
    service, database = SimpleNamespace(settings=settings), SimpleNamespace(file=None)
    parts: Any = SimpleNamespace(executor="me", jobs=jobs, service=service, database=database, active=ActiveJobs())
    dispatcher = Dispatcher(parts, lambda queue: capacity, started.append, told.set)
    dispatcher.start()
    eventually(lambda: len(started) == capacity)
    if capacity:
        assert dispatcher.free_places("light") == 0
        dispatcher.give_place_back("light")
        eventually(lambda: len(started) == capacity + 1)
    assert not told.is_set(), "jobs that were not new here are told by those who took them in"
    dispatcher.wake("light")
    assert told.wait(30), "others may have a place for a new job"
    dispatcher.stop()
    assert dispatcher.free_places("light") == dispatcher.free_places("other") == 0
    assert len(waiting) + len(started) == 8


def test_calls_of_webhooks_that_a_process_left_are_made_by_another() -> None:
    """By the public interface of DBOS: what was left pending goes back to its queue, and nothing else is touched."""
    engine = running_engine()
    hooks = engines.webhooks()
    table = sa.Table("workflow_status", sa.MetaData(), autoload_with=engine.database.engine)
    left = {name: f"left-{name}" for name in (webhooks.WORKFLOW, "job")}
    with engine.database.transaction() as connection:
        for name, workflow in left.items():
            connection.execute(
                sa.insert(table).values(
                    workflow_uuid=workflow, status="PENDING", name=name, executor_id="ended", application_version="none"
                )
            )
    assert "ended" in hooks.busy_executors()
    hooks.recover(["ended"])
    webhook = DBOS.get_workflow_status(left[webhooks.WORKFLOW])
    assert webhook is not None
    assert (webhook.status, webhook.queue_name) == ("ENQUEUED", webhooks.QUEUE)
    assert DBOS.get_workflow_status(left["job"]) is None
    hooks.client.delete_workflows([left[webhooks.WORKFLOW]])
