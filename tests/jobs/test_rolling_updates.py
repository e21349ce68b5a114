"""Versions of the job database: two of COW on one, for as long as servers are replaced one by one; who may change it.

The older version is that of `data/schema_1.sql`, whose rows are written here as it wrote them.
"""

from __future__ import annotations

import json
import sqlite3
import time
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from uuid import uuid4

import psycopg
import pytest
import sqlalchemy as sa
from command_line import cow_from_nothing
from conftest import DATA, ROOT
from job_rows import add_job, open_database, url_of
from postgres import postgres
from pydantic import SecretStr
from refusals import refused
from servers import BODY, IMAGE, Served, problem
from waiting import eventually

from cow_service.client import Client
from cow_service.jobs import opening, schema
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import VERSION, JobSpec, JobTable
from cow_service.jobs.schema import METADATA, PROCESSES, SCHEMAS, packed
from cow_service.media.artifacts import DiskArtifacts
from cow_service.records import Answer, Simulation
from cow_service.requests import AnswerRequest
from cow_service.settings import Settings, SettingsError
from cow_service.stages.keys import FORMAT, digest_of
from cow_service.stages.run import now

OLD_TABLES = (DATA / "schema_1.sql").read_text()
OLD_ANSWER = json.loads((DATA / "answer_of_format_2.json").read_text())  # its trajectory is its only path


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.slow)])
def old(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """A database of the older version, without jobs."""
    folder = tmp_path / "data"
    folder.mkdir()
    if request.param == "sqlite":
        with closing(with_old_tables(opening.open_database(Settings(data_dir=folder)))) as database:
            yield database
        return
    settings = {"data_dir": folder}
    with postgres() as server:
        address = SecretStr(server.url)
        with closing(with_old_tables(opening.open_database(Settings(database_url=address, **settings)))) as database:
            yield database


def with_old_tables(database: Database) -> Database:
    text = OLD_TABLES if not database.is_shared else OLD_TABLES.replace("BLOB", "BYTEA")
    statements = "\n".join(line for line in text.splitlines() if not line.startswith("--")).split(";")
    with database.transaction() as connection:
        for statement in filter(None, map(str.strip, statements)):
            connection.execute(sa.text(statement))
    return database


def write_old(database: Database, image: str, kind: str = "simulate", **values: Any) -> str:
    """A job as the older version writes it: it knows no other column than these."""
    job = str(uuid4())
    asked = {name: value for name, value in BODY.items() if name != "image"} | {"image": {"artifact": image}}
    spec = {"kind": kind, "request": asked, "reader": "embedded", "generator": "cutout", "created_at": now()}
    absent = ("ended", "owner", "executor", "run", "webhook", "format", "result", "trajectory_key", "error")
    row = {
        "id": job, "kind": kind, "status": "queued", "created_at": spec["created_at"], "version": "2", "turn": 0,
        "queue": "light", "priority": "normal", "starts": 0, "generator": "cutout", "question": BODY["question"],
        "image": image, "spec": zlib.compress(json.dumps(spec).encode()),
    }  # fmt: skip
    row |= dict.fromkeys(absent) | values
    insert = f"INSERT INTO cow_jobs ({', '.join(row)}) VALUES ({', '.join(f':{name}' for name in row)})"
    with database.transaction() as connection:
        connection.execute(sa.text(insert), row)
        reference = "INSERT INTO cow_references (sha256, job_id) VALUES (:image, :job)"
        connection.execute(sa.text(reference), {"image": image, "job": job})
    return job


def read_old(database: Database, job: str) -> dict[str, Any] | None:
    """The result of a job as the older version reads it."""
    query = (
        "SELECT j.status, j.result, j.format, t.trajectory FROM cow_jobs j LEFT JOIN cow_trajectories_of_jobs t "
        "ON t.job_id = j.id AND t.key = j.trajectory_key WHERE j.id = :job"
    )
    (row,) = database.read(sa.text(query), {"job": job})
    if row.status != "succeeded":
        return None
    result = json.loads(zlib.decompress(row.result))
    return result | {"trajectory": json.loads(zlib.decompress(row.trajectory))} if row.trajectory else result


def tell_of_a_process(database: Database, seconds_ago: float) -> None:
    with database.transaction() as connection:
        connection.execute(sa.delete(PROCESSES))
        connection.execute(sa.insert(PROCESSES).values(executor="old", seen=time.time() - seconds_ago, info="{}"))


@pytest.mark.slow
@pytest.mark.parametrize("old", ["postgres"], indirect=True)
def test_two_versions_share_a_database(old: Database, tmp_path: Path) -> None:
    image = DiskArtifacts(tmp_path / "data" / "artifacts").put(IMAGE, "image/png").sha256
    ended = {"status": "succeeded", "ended": time.time(), "format": 2}
    finished = {
        kind: write_old(old, image, kind, **ended, result=zlib.compress(json.dumps(result).encode()))
        for kind, result in (("simulate", OLD_ANSWER["simulation"]), ("answer", OLD_ANSWER))
    }
    waiting = write_old(old, image)
    tell_of_a_process(old, 0.0)  # the older server runs
    with (
        Served(tmp_path, COW_DATABASE_URL=url_of(old).get_secret_value()) as new,
        Client(str(new.http.base_url)) as client,
    ):
        for kind, job in finished.items():
            result = new.job(job)["result"]
            told = (result["simulation"] if kind == "answer" else result)["trajectory"]
            assert (told["law"], "points" in told) == ("ballistic", False)
            read: Any = client.job(job).wait()
            assert (read.simulation if kind == "answer" else read).trajectory.path.points[0] == (275.5, 225.5)
        assert new.ended(waiting)["status"] == "succeeded"
        assert old.read(sa.select(SCHEMAS.c.version, SCHEMAS.c.oldest_serving)) == [(schema.SCHEMA, 1)]
        # The older server goes on: what it writes is served here, and what is computed here it can read.
        later = write_old(old, image)
        assert new.ended(later)["status"] == "succeeded"
        own = new.submit(BODY)["id"]
        assert eventually(lambda: read_old(old, own))["trajectory"] == new.job(own)["result"]["trajectory"]
        # Work of another workflow version is left to servers that have it, and told of.
        foreign = write_old(old, image, version="1")
        unready = eventually(lambda: None if (answer := new.http.get("/readyz")).is_success else answer)
        assert "version 1" in problem(unready, 503, "not-ready")["detail"]
        told = new.http.get("/workers").json()["unserved"]
        assert told == [{"queue": "light", "workflow_version": "1", "jobs": 1, "reason": "version"}]
        assert 'cow_queue_unserved{queue="light",reason="version"} 1.0' in new.http.get("/metrics").text
        assert new.job(foreign)["status"] == "queued"


def test_workers_leave_jobs_of_later_versions_and_take_those_of_older_ones(old: Database) -> None:
    """A worker would fail a job whose request has a field that it does not know."""
    old.prepare(migrate=True)
    known, later = (write_old(old, "0" * 64, version=version) for version in ("2", "4"))
    assert [job.id for job in JobTable(old).take("light", "me", 9, None)] == [known]
    add_job(old, "own")
    own, *_ = old.read(sa.text("SELECT version FROM cow_jobs WHERE id = 'own'"))
    assert own.version == VERSION != "2", "an older worker leaves it, too"
    found = JobTable(old).find(later, None)
    assert found is not None
    assert found.job.status == "queued"


def test_what_requests_may_say_belongs_to_a_version() -> None:
    """If requests may say more than those of the last release: raise `VERSION`, once. Then update the digest."""
    in_words = ("description", "title", "default")  # do not decide whether a request is valid
    schema = json.dumps(AnswerRequest.model_json_schema())
    bare = json.loads(schema, object_hook=lambda it: {k: v for k, v in it.items() if k not in in_words})
    assert (VERSION, digest_of(bare)[:8]) == ("3", "25ffa6c4")


def test_results_and_requests_of_an_older_version_are_read() -> None:
    answer = Answer.model_validate(OLD_ANSWER)
    assert answer.simulation is not None
    trajectory = answer.simulation.trajectory
    assert (trajectory.law, trajectory.bodies, trajectory.outcome) == ("ballistic", (), None)
    assert json.loads(trajectory.path.model_dump_json())["points"] == OLD_ANSWER["simulation"]["trajectory"]["points"]
    assert trajectory.num_frames == 7
    assert Simulation.model_validate_json(answer.simulation.model_dump_json()) == answer.simulation
    request = {"image": {"artifact": "0" * 64}, "question": "?", "motion": {"direction": [1, 0]}}
    spec = JobSpec(kind="simulate", request=request, reader="embedded", generator="cutout", created_at="")
    asked = spec.parsed()
    assert (asked.law, asked.ensemble, spec.attached) == ("contact", 50, [])
    assert asked.whole_motion is not None
    assert asked.whole_motion.stated_kind == "linear"


def test_tables_only_gain_what_older_servers_do_not_notice(tmp_path: Path) -> None:
    """Else `OLDEST_SERVING` is to be raised, and what follows from it."""
    assert schema.OLDEST_SERVING == 1
    with closing(sqlite3.connect(tmp_path / "old")) as database:
        database.executescript(OLD_TABLES)
    there = sa.inspect(sa.create_engine(f"sqlite:///{tmp_path / 'old'}"))
    for name in there.get_table_names():
        known = {column["name"]: column for column in there.get_columns(name)}
        table = METADATA.tables[name]
        assert known.keys() <= {column.name for column in table.columns}
        for column in table.columns:
            was = known.get(column.name)
            assert column.nullable if was is None else column.nullable == was["nullable"], column
            assert was is None or str(column.type) == str(was["type"]), column


def indexes_of(database: Database) -> dict[str, bool]:
    """Those of the table of jobs, and whether they are used."""
    if not database.is_shared:
        return {str(one["name"]): True for one in sa.inspect(database.engine).get_indexes("cow_jobs")}
    joined = "pg_index JOIN pg_class ON pg_class.oid = indexrelid"
    query = f"SELECT relname, indisvalid FROM {joined} WHERE relname ~ '^cow_jobs_[^p]'"
    return {row.relname: row.indisvalid for row in database.read(sa.text(query))}


def test_columns_and_indexes_that_an_older_version_lacks_are_added(old: Database) -> None:
    wanted = {str(index.name): True for index in schema.JOBS.indexes}
    assert indexes_of(old).items() < wanted.items()
    write_old(old, "0" * 64)
    assert old.schema() == 1
    with refused("storage-unavailable"):
        old.prepare(migrate=False)
    old.prepare(migrate=True)
    assert old.read(sa.text("SELECT answer FROM cow_jobs")) == [(None,)]
    assert (old.schema(), indexes_of(old)) == (schema.SCHEMA, wanted)
    old.prepare(migrate=False)
    if old.is_shared:  # the making of one was interrupted
        with old.transaction() as connection:
            broken = "UPDATE pg_index SET indisvalid = false WHERE indexrelid = 'cow_jobs_of_kind'::regclass"
            connection.execute(sa.text(broken))
        assert indexes_of(old) != wanted
        old.create_tables()
        assert indexes_of(old) == wanted


@pytest.mark.parametrize("old", [pytest.param("postgres", marks=pytest.mark.slow)], indirect=True)
def test_an_index_that_must_wait_for_too_long_keeps_no_server_from_starting(old: Database, tmp_path: Path) -> None:
    with old.transaction() as connection:  # a new column has to wait for a backup, and the server with it
        connection.execute(sa.text("ALTER TABLE cow_jobs ADD COLUMN answer TEXT, ADD COLUMN given TEXT"))
    with old.engine.connect() as backup:
        backup.execution_options(isolation_level="REPEATABLE READ").execute(sa.text("SELECT * FROM cow_jobs"))
        with closing(opening.open_database(Settings(data_dir=tmp_path, database_url=url_of(old)))) as other:

            @sa.event.listens_for(other.engine, "connect")
            def hurry(connection: Any, _: object) -> None:
                connection.execute("SET lock_timeout = '100ms'")
                connection.commit()

            other.create_tables()
        assert old.schema() == schema.SCHEMA
        assert not all(indexes_of(old).values())
    old.create_tables()
    assert all(indexes_of(old).values())


def test_a_change_that_others_do_not_bear_waits_for_their_end(old: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schema, "OLDEST_SERVING", 2)
    tell_of_a_process(old, 0.0)
    with refused("storage-unavailable"):
        old.create_tables()
    assert old.schema() == 1, "nothing was changed"
    tell_of_a_process(old, schema.ALIVE_SECONDS + 1)
    old.create_tables()
    assert old.schema() == schema.SCHEMA


def test_tables_of_another_version_stay_as_they_are(tmp_path: Path) -> None:
    with closing(open_database(tmp_path)) as database:
        for version, oldest in ((schema.SCHEMA + 1, schema.SCHEMA), (9, schema.SCHEMA + 1)):
            with database.transaction() as connection:
                connection.execute(sa.update(SCHEMAS).values(version=version, oldest_serving=oldest))
                connection.execute(sa.text("DROP TABLE IF EXISTS cow_stages_of_jobs"))
            if oldest <= schema.SCHEMA:
                database.create_tables()
                assert database.schema() == version
            for migrate in (True, False) if oldest > schema.SCHEMA else ():
                with pytest.raises(SettingsError, match="later version"):
                    database.prepare(migrate=migrate)
            assert "cow_stages_of_jobs" not in sa.inspect(database.engine).get_table_names()


def test_a_result_of_a_later_version_is_handed_on_as_it_is(tmp_path: Path) -> None:
    with closing(open_database(tmp_path)) as database:
        add_job(database, "job")
        written = {"of a later version": 1}
        with database.transaction() as connection:
            values = {"status": "succeeded", "format": FORMAT + 1, "result": packed(json.dumps(written))}
            connection.execute(sa.update(schema.JOBS).values(**values))
        found = JobTable(database).find("job", None)
        assert found is not None
        assert found.content == written


ROLES = ROOT / "docker" / "postgres" / "roles.sql"
REFUSED = (
    "CREATE TABLE mine (id int)",
    "ALTER TABLE cow_jobs ADD COLUMN mine int",
    "DROP TABLE cow_jobs",
    "TRUNCATE cow_jobs",
    "CREATE ROLE mine",
    "COPY cow_jobs TO PROGRAM 'true'",
)


@pytest.mark.slow
def test_a_server_runs_on_tables_that_it_may_not_create(tmp_path: Path) -> None:
    with postgres() as server:
        owner = {"COW_DATABASE_URL": server.url}
        server.run_script(ROLES, COW_SERVING_PASSWORD="it's secret")
        early = Served(tmp_path, log="early", COW_MIGRATE="false", **owner)
        try:
            early.start("/livez")
            assert "`cow migrate`" in problem(early.http.get("/readyz"), 503, "storage-unavailable")["detail"]
            told = cow_from_nothing(tmp_path, "migrate", **owner)
            assert told.returncode == 0, told.stderr
            eventually(lambda: early.http.get("/readyz").status_code == 200)
        finally:
            early.kill()
        with psycopg.connect(server.url) as connection:
            connection.execute("CREATE TABLE of_a_later_version (id int)")
        weak = server.url.replace("cow@", "cow_serving@")
        with Served(tmp_path, COW_DATABASE_URL=weak, COW_MIGRATE="false") as one:
            assert one.ended(one.submit(BODY)["id"])["status"] == "succeeded"
        with psycopg.connect(weak, autocommit=True) as connection:
            connection.execute("INSERT INTO of_a_later_version VALUES (1)")
            for statement in REFUSED:
                with pytest.raises(psycopg.errors.InsufficientPrivilege):
                    connection.execute(statement)
