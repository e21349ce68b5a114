"""`cow migrate` creates the tables; servers and workers need only rights to read and write them."""

from __future__ import annotations

from pathlib import Path

import psycopg
import pytest
from command_line import cow_from_nothing
from conftest import ROOT
from postgres import postgres
from servers import BODY, Served

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
        early = cow_from_nothing(tmp_path, "serve", "--port", "0", COW_MIGRATE="false", **owner)
        assert (early.returncode, "`cow migrate`" in early.stderr) == (1, True)
        told = cow_from_nothing(tmp_path, "migrate", **owner)
        assert told.returncode == 0, told.stderr
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
