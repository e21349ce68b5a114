"""`cow migrate` creates the tables; servers and workers need only rights to read and write them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import psycopg
import pytest
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


def cow(*words: str, **settings: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COW_")} | settings
    command = [sys.executable, "-m", "cow_service.cli.main", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)


@pytest.mark.slow
@pytest.mark.parametrize(
    "roles_first",
    [
        pytest.param(True, id="roles before tables"),
        pytest.param(False, id="tables before roles", marks=pytest.mark.soak),
    ],
)
def test_a_server_runs_on_tables_that_it_may_not_create(tmp_path: Path, roles_first: bool) -> None:
    with postgres() as server:
        url = server.url
        if roles_first:
            server.run_script(ROLES, COW_SERVING_PASSWORD="it's secret")
        told = cow("migrate", COW_DATABASE_URL=url, COW_DATA_DIR=str(tmp_path))
        assert (told.returncode, told.stdout) == (0, "The job database is up to date.\n"), told.stderr
        if roles_first:
            again = cow("migrate", COW_DATABASE_URL=url, COW_DATA_DIR=str(tmp_path))
            assert again.returncode == 0, "it changes nothing"
        else:
            server.run_script(ROLES, COW_SERVING_PASSWORD="it's secret")
        with psycopg.connect(url) as connection:
            connection.execute("CREATE TABLE of_a_later_version (id int)")
        weak = url.replace("cow@", "cow_serving@")
        with Served(tmp_path, COW_DATABASE_URL=weak, COW_MIGRATE="false") as one:
            assert one.ended(one.submit(BODY)["id"])["status"] == "succeeded"
        with psycopg.connect(weak, autocommit=True) as connection:
            connection.execute("INSERT INTO of_a_later_version VALUES (1)")
            for statement in REFUSED:
                with pytest.raises(psycopg.errors.InsufficientPrivilege):
                    connection.execute(statement)


@pytest.mark.slow
def test_a_server_that_must_not_create_tables_says_what_is_missing(tmp_path: Path) -> None:
    own = {"COW_DATA_DIR": str(tmp_path), "COW_MIGRATE": "false", "COW_WORKERS": "false"}
    told = cow("serve", "--port", "0", **own)
    assert told.returncode == 1
    assert "run `cow migrate` first" in told.stderr
    assert cow("migrate", **own).returncode == 0
    with Served(tmp_path, **own) as one:
        assert one.http.get("/readyz").status_code == 200
