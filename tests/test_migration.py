"""`cow migrate` makes the tables; what runs later needs no more than to read and write them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import psycopg
import pytest
from postgres import postgres_server
from servers import BODY, Served

ROLE = """
CREATE ROLE cow_app LOGIN;
GRANT USAGE ON SCHEMA public, dbos TO cow_app;
GRANT SELECT, INSERT, UPDATE, DELETE ON ALL TABLES IN SCHEMA public, dbos TO cow_app;
GRANT USAGE ON ALL SEQUENCES IN SCHEMA public, dbos TO cow_app;
"""


def cow(*words: str, **settings: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COW_")} | settings
    command = [sys.executable, "-m", "cow_service.cli.main", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)


@pytest.mark.slow
def test_a_server_runs_on_tables_that_it_may_not_create(tmp_path: Path) -> None:
    with postgres_server() as url:
        told = cow("migrate", COW_DATABASE_URL=url, COW_DATA_DIR=str(tmp_path))
        assert (told.returncode, told.stdout) == (0, "The job database is up to date.\n"), told.stderr
        assert cow("migrate", COW_DATABASE_URL=url, COW_DATA_DIR=str(tmp_path)).returncode == 0, (
            "again it changes nothing"
        )
        with psycopg.connect(url) as connection:
            connection.execute(ROLE)
        weak = {"COW_DATABASE_URL": url.replace("cow@", "cow_app@"), "COW_MIGRATE": "false"}
        with Served(tmp_path, **weak) as one:
            assert one.ended(one.submit(BODY)["id"])["status"] == "succeeded"


@pytest.mark.slow
def test_a_server_that_must_not_create_tables_says_what_is_missing(tmp_path: Path) -> None:
    own = {"COW_DATA_DIR": str(tmp_path), "COW_MIGRATE": "false", "COW_WORKERS": "false"}
    told = cow("serve", "--port", "0", **own)
    assert told.returncode == 1
    assert "run `cow migrate` first" in told.stderr
    assert cow("migrate", **own).returncode == 0
    with Served(tmp_path, **own) as one:
        assert one.http.get("/readyz").status_code == 200
