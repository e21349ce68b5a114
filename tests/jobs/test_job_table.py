"""Jobs in their queues: who takes which, what a process that ended leaves, and which attempt may end a job."""

from __future__ import annotations

import json
import re
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import sqlalchemy as sa
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from job_rows import add_job, open_database, take_new_job, url_of
from postgres import PostgresServer, postgres
from pydantic import SecretStr
from refusals import refused
from sqlalchemy.exc import SQLAlchemyError
from waiting import TIME_LIMIT, eventually

from cow_service.errors import Canceled, InternalError
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.computing import Computer, EngineParts, JobOutcome, Work
from cow_service.jobs.database import Database, StoredResult
from cow_service.jobs.job_table import MAX_DEATHS, MAX_LISTED, VERSION, JobFilters, JobSpec, JobTable
from cow_service.jobs.loop import JobLoop
from cow_service.jobs.schema import CALLS, JOBS, packed
from cow_service.observability.metrics import Metrics
from cow_service.settings import Settings


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    with postgres() as server:
        yield server


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.slow)])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    url = SecretStr(request.getfixturevalue("server").url) if request.param == "postgres" else None
    with closing(open_database(tmp_path, url)) as database:
        yield database
        with database.transaction() as connection:
            connection.execute(sa.delete(JOBS))


GIVEN_SPEC = {
    "kind": "simulate",
    "request": {"image": {"artifact": "0" * 64}, "question": "?"},
    "reader": "embedded",
    "generator": "cutout",
    "created_at": "2026-01-01T00:00:00.000Z",
}


def delete(database: Database, job: str) -> None:
    """As callers do, who cancel what they delete."""
    JobTable(database).cancel(job)
    JobTable(database).delete([job])


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
    {"kind": "answer", "status": ["queued", "failed", "failed"]},
    {"kind": "answer"},
    {"kind": "simulate", "status": ["running"]},
    {"status": ["failed", "canceled"]},
    {},
]


def fill(database: Database, count: int) -> None:
    """Jobs of two keys: of a hundred, ten are alice's, one is an answer that failed, 19 are simulations that did."""
    add_job(database, "first", "alice")
    columns = [column.name for column in JOBS.columns]
    values = {
        "id": "'job-' || n",
        "owner": "CASE n % 10 WHEN 0 THEN 'alice' ELSE 'bob' END",
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
def test_lists_have_what_is_wanted_once(database: Database, owner: str | None) -> None:
    fill(database, 600)
    rows = database.read(sa.select(JOBS.c.id, JOBS.c.owner, JOBS.c.kind, JOBS.c.status, JOBS.c.created_at))
    newest = sorted(rows, key=lambda row: (row.created_at, row.id), reverse=True)
    table = JobTable(database)
    for wanted in LISTS:
        expected = [
            row.id
            for row in newest
            if row.owner == (owner or row.owner)
            and row.kind == wanted.get("kind", row.kind)
            and row.status in wanted.get("status", [row.status])
        ]
        page = table.page(owner, JobFilters(limit=25, **wanted), {})
        listed = ids(page.jobs)
        while page.next is not None:
            assert len(page.jobs) == 25
            page = table.page(owner, JobFilters(limit=25, cursor=page.next, **wanted), {})
            listed += ids(page.jobs)
        assert listed == expected


def test_times_are_included_to_the_millisecond(database: Database) -> None:
    for number in range(4):
        add_job(database, str(number), created_at=f"2026-01-01T00:00:00.00{number}Z")

    def found(**times: str) -> str:
        return "".join(ids(JobTable(database).page(None, JobFilters.model_validate(times), {}).jobs))

    day = "2026-01-01T00:00:00"
    assert found(created_after=f"{day}.001Z", created_before=f"{day}.002Z") == "21"
    assert found(created_after="2026-01-01T09:00:00.002+09:00") == "32"
    assert (found(created_after=f"{day}.001001Z"), found(created_before=f"{day}.001999Z")) == ("32", "10")
    for moment in ("0001-01-01T00:00:00+14:00", "1969-12-31T23:59:59Z", "9999-12-31T23:59:59-14:00"):
        ends = (found(created_after=moment), found(created_before=moment))
        assert ends == (("3210", "") if moment < "2000" else ("", "3210"))


SHARED_FIXTURE = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@SHARED_FIXTURE
@given(data=st.data(), limit=st.integers(1, 6), count=st.integers(1, 12))
def test_jobs_that_come_and_go_between_pages_hide_no_others(
    database: Database, data: st.DataObject, limit: int, count: int
) -> None:
    """Nor do those of the same millisecond."""
    table = JobTable(database)
    table.delete([row.id for row in database.read(sa.select(JOBS.c.id))])
    names = [f"{number:02}" for number in range(count)]
    for number, name in enumerate(names):
        add_job(database, name, created_at=f"2026-01-01T00:00:00.{number // 3:03}Z")
    listed: list[str] = []
    left, cursor, later = {*names}, None, 0
    while True:
        page = table.page(None, JobFilters(limit=limit, cursor=cursor), {})
        assert len(page.jobs) == limit or page.next is None
        listed += ids(page.jobs)
        if (cursor := page.next) is None:
            break
        gone = data.draw(st.sets(st.sampled_from(sorted(left)), max_size=2)) if left else set[str]()
        table.delete(sorted(gone))
        left -= gone
        add_job(database, f"later-{(later := later + 1)}", created_at="2026-01-01T00:00:01.000Z")
    assert left <= {*listed}
    assert listed == sorted({*listed}, reverse=True)


@SHARED_FIXTURE
@given(st.text(st.characters(codec="utf-8"), min_size=1, max_size=60))
@example("W10")  # []
@example("WzEsMl0")  # [1,2]
@example("WzFlMzAwLFtdXQ")  # [1e300,[]]
@example("W05hTixbXV0")  # [NaN,[]]
@example("é")
def test_what_is_no_cursor_is_refused(database: Database, cursor: str) -> None:
    with refused("invalid-request", "/cursor"):
        JobTable(database).page(None, JobFilters.model_construct(cursor=cursor), {})


@pytest.mark.parametrize("owner", [None, "alice"])
def test_no_list_looks_at_other_jobs(database: Database, owner: str | None) -> None:
    """Each is answered from ranges of an index that hold nothing else."""
    fill(database, 20_000)
    if database.is_shared:
        with database.engine.connect() as connection:
            connection.execution_options(isolation_level="AUTOCOMMIT").exec_driver_sql("VACUUM ANALYZE cow_jobs")
    asked: list[tuple[str, Any]] = []
    sa.event.listen(database.engine, "before_cursor_execute", lambda *event: asked.append(event[2:4]))
    for wanted in LISTS:
        asked.clear()
        JobTable(database).page(owner, JobFilters(**wanted), {})
        ((statement, values),) = tuple(asked)
        with database.engine.connect() as connection:
            if database.is_shared:
                (plan,) = connection.exec_driver_sql(f"EXPLAIN (ANALYZE, FORMAT JSON) {statement}", values).scalars()
                used = re.findall(r'"(?:Index|Relation) Name": "(cow_jobs\w*)"', json.dumps(plan))
                assert used.count("cow_jobs") * 2 == len(used), "a table is read without an index"
                removed = re.findall(r'"Rows Removed by Filter": (\d+)', json.dumps(plan))
                assert sum(map(int, removed)) <= 1, wanted  # of a status that one job has any index is as good
                continue
            steps = [row[3] for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", values)]
            used = [name for step in steps for name in re.findall(r"cow_jobs\w*", step)]
            assert not [step for step in steps if re.match(r"SCAN cow_jobs(?! USING)", step)]
            of_kind = {"cow_jobs_of_kind", "cow_jobs_of_owner_and_kind"}
            allowed = of_kind if wanted else {"cow_jobs_of_time", "cow_jobs_of_owner"}
            assert set() < {*used} - {"cow_jobs"} <= allowed


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
    assert table.begin(old, "grounding", 0.0)
    assert table.recover(["frozen"]) == ["job"]
    found = table.find("job", None)
    assert found is not None
    assert (found.job.status, found.job.position) == ("queued", 0)
    (new,) = table.take("light", "me", 1, None)
    assert not table.begin(old, "grounding", 0.0)
    assert not table.succeed(old, '{"by":"old"}', None, ())
    table.release("job", old.run, "it was frozen")
    assert table.begin(new, "grounding", 0.0)
    assert table.succeed(new, '{"by":"new"}', None, ())
    assert table.succeed(new, '{"by":"new"}', None, ()), "a repeated try whose first commit was not heard of"
    assert not table.fail(new, InternalError("late"))
    assert not table.cancel("job")
    assert table.recover(["me", "frozen"]) == []
    assert ids(table.page(None, JobFilters(status=("succeeded",)), {}).jobs) == ["job"]


def test_a_queued_job_says_how_long_it_will_wait(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the pace of the last ends; that of an idle queue, whose callers are slow, is not known."""
    clock = [1e9]
    monkeypatch.setattr("cow_service.jobs.job_table.time", SimpleNamespace(time=lambda: clock[0]))
    table = JobTable(database)

    def place(job: str) -> tuple[int | None, float | None]:
        found = table.find(job, None)
        assert found is not None
        return found.job.position, found.job.expected_wait

    for number in range(4):
        job = take_new_job(database, f"ended-{number}", "me")
        assert table.begin(job, "grounding", 0.0)
        assert table.succeed(job, "{}", None, ())
        clock[0] += 10
    assert table.ended_lately() == {"light": 4}
    add_job(database, "first")
    assert place("first") == (0, None), "nobody works, and nothing is ahead of it"
    add_job(database, "second")
    assert place("second") == (1, 20.0)
    (first,) = table.take("light", "me", 1, None)
    assert table.begin(first, "grounding", 0.0)
    assert place("second") == (0, 10.0)
    clock[0] += 285  # three of the ends are more than five minutes ago
    assert table.ended_lately() == {"light": 1}
    assert place("second") == (0, None)
    counts = {(one.state, one.jobs, one.workflow_version) for one in table.open_counts()}
    assert counts == {("running", 1, VERSION), ("queued", 1, VERSION)}


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
    delete(database, "job")
    with pytest.raises(Canceled) as held:
        database.find_result("key", "job", [StoredResult("key", "grounding", "{}", ("a" * 64,))])
    with closing(open_database(tmp_path, url_of(database))) as another_process:
        assert add_job(another_process, "another job")
    assert held


def test_a_job_of_the_same_id_is_not_ended_by_the_attempt_of_a_deleted_one(database: Database) -> None:
    table = JobTable(database)
    old = take_new_job(database, "job", "me")
    assert not add_job(database, "job"), "the id is taken"
    delete(database, "job")
    new = take_new_job(database, "job", "me")
    assert not table.succeed(old, "{}", None, ())
    assert table.taken_by("me") == {"job": new.run}


def test_a_job_that_ends_its_process_each_time_fails(database: Database) -> None:
    table = JobTable(database)
    add_job(database, "killer", webhook="https://call.test")
    for _ in range(MAX_DEATHS):
        table.take("light", "me", 1, None)
        assert table.recover(["me"]) == ["killer"]
    assert not database.read(sa.select(CALLS))
    table.take("light", "me", 1, None)
    assert table.recover(["me"]) == []
    found = table.find("killer", None)
    assert found is not None
    assert (found.job.status, type(found.error)) == ("failed", InternalError)
    assert [(row.job_id, row.url) for row in database.read(sa.select(CALLS))] == [("killer", "https://call.test")]


def test_what_only_seemed_an_end_and_what_was_given_back_count_for_nothing(
    database: Database, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "cow_service")
    table = JobTable(database)
    add_job(database, "job")
    for number in range(2 * MAX_DEATHS):
        (frozen,) = table.take("light", "frozen", 1, None)
        assert table.recover(["frozen"]) == ["job"]
        (taken,) = table.take("light", "me", 1, None)
        assert not table.release("job", frozen.run, "it woke up"), "another process has it"
        assert table.release("job", taken.run, f"stop {number}")
    assert "job job goes back to its queue: its process has ended (number 1)" in caplog.text
    assert "job job goes back to its queue: stop 1" in caplog.text


def test_a_job_that_cannot_be_read_fails_and_holds_up_nobody(database: Database) -> None:
    table = JobTable(database)
    for name in ("bad", "of a later version", "good"):
        add_job(database, name)
    spec = {**json.loads(JobSpec.model_validate(GIVEN_SPEC).model_dump_json()), "new": 1}
    with database.transaction() as connection:
        for name, kept in (("bad", b"?"), ("of a later version", packed(json.dumps(spec)))):
            connection.execute(sa.update(JOBS).where(JOBS.c.id == name).values(spec=kept))
    assert ids(table.take("light", "me", 9, None)) == ["of a later version", "good"]
    found = table.find("bad", None)
    assert found is not None
    assert (found.job.status, type(found.error)) == ("failed", InternalError)


def test_only_what_has_ended_is_deleted(database: Database) -> None:
    """Another job may have the same id by now: its idempotency key was used again."""
    table = JobTable(database)
    add_job(database, "job")
    assert table.delete(["job"]) == set()
    assert table.find("job", None) is not None
    assert table.cancel("job")
    table.delete(["job"])
    assert table.find("job", None) is None


def test_what_cannot_be_stored_is_no_outage(database: Database) -> None:
    if not database.is_shared:
        pytest.skip("SQLite keeps every text")
    job = take_new_job(database, "job", "me")
    with pytest.raises(SQLAlchemyError):
        JobTable(database).succeed(job, "{}", None, (), answer="nul \0")


def test_long_answers_are_listed_in_short(database: Database) -> None:
    for length in (MAX_LISTED, MAX_LISTED + 1):
        job = take_new_job(database, f"job-{length}", "me")
        assert JobTable(database).succeed(job, "{}", None, (), answer="x" * length)
    shown = {job.id: job.answer for job in JobTable(database).page(None, JobFilters(), {}).jobs}
    assert shown == {"job-200": "x" * 200, "job-201": "x" * 199 + "…"}


class Places(Computer):
    """Computes nothing, at so many places."""

    def __init__(self, places: int) -> None:
        self.places = places
        self.computed: list[str] = []
        self.may_end = threading.Event()

    def capacity(self, queue: str) -> int:
        return self.places

    def compute(self, work: Work) -> JobOutcome:
        self.computed.append(work.job.id)
        self.may_end.wait(TIME_LIMIT)
        raise Canceled("It was interrupted.")


@contextmanager
def looping(database: Database, computer: Computer) -> Iterator[tuple[JobLoop, ActiveJobs]]:
    service: Any = SimpleNamespace(settings=Settings(), metrics=Metrics())
    parts = EngineParts(service, database, JobTable(database), ActiveJobs(), "me")
    loop = JobLoop(parts, computer)
    loop.start()
    yield loop, parts.active
    loop.stop()
    loop.wait(TIME_LIMIT)


def test_no_more_jobs_are_taken_than_there_are_places(database: Database) -> None:
    computer, table = Places(0), JobTable(database)
    for number in range(5):
        add_job(database, str(number))
    with looping(database, computer) as (loop, _):
        computer.places = 3
        loop.wake()
        eventually(lambda: len(computer.computed) == 3)
        add_job(database, "late")
        loop.wake()
        assert sorted(table.taken_by("me")) == sorted(computer.computed) == ["0", "1", "2"]
        computer.places = 0
        computer.may_end.set()
        eventually(lambda: not table.taken_by("me"))
    assert len(table.open_counts()) == 1, "all are back in the queue"


def test_a_job_whose_outcome_cannot_be_stored_fails(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    computer = Places(1)
    odd = JobOutcome("half of a pair: \ud800", None, {}, set(), "")
    monkeypatch.setattr(computer, "compute", lambda work: odd)
    add_job(database, "job")
    with looping(database, computer):
        found = eventually(lambda: one if (one := JobTable(database).find("job", None)) and one.error else None)
    assert isinstance(found.error, InternalError)


def test_a_job_that_the_system_gives_no_thread_for_leaves_its_place(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = threading.Thread.start

    def fail(thread: threading.Thread) -> None:
        if thread.name.startswith("job-"):
            raise RuntimeError("can't start new thread")
        start(thread)

    add_job(database, "job")
    computer = Places(1)
    monkeypatch.setattr(threading.Thread, "start", fail)
    with looping(database, computer) as (loop, active):
        eventually(lambda: JobTable(database).taken_by("me"))
        eventually(lambda: not active.runs())
        monkeypatch.undo()
        add_job(database, "next")
        loop.wake()
        eventually(lambda: computer.computed == ["next"])
        computer.may_end.set()
    assert [*JobTable(database).taken_by("me")] == ["job"], "the ticker finds it, and gives it back"
