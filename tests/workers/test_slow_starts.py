"""Worker processes that start slowly, or not at all, and a server that starts while its database is away."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path

import pytest
from postgres import postgres
from servers import BODY, Served, problem
from test_workers import workers_of
from waiting import eventually

pytestmark = pytest.mark.slow

# Runs at the start of every Python process of the server, before its imports.
AT_START = """
import os, pathlib, sys, time
if "cow_service.workers" in sys.orig_argv:
    file = pathlib.Path(os.environ["STARTS"])
    start, _, left = file.read_text().partition("\\n")
    file.write_text(left)
    if start == "dies":
        os.kill(os.getpid(), 9)
    time.sleep(float(start or 0))
"""
SILENCE = 8.0  # seconds; it is a good deal more than the two between heartbeats
# Everything that is waited for is waited for less long.
IMPATIENT = f"""
from cow_service.workers import pool
pool.HEARTBEAT_TIMEOUT_SECONDS, pool.FIRST_PAUSE_SECONDS, pool.WATCH_SECONDS = {SILENCE}, 0.25, 0.2
from cow_service.cli.main import app
app(["serve"])
"""


def bad_starts(folder: Path, *starts: str, **settings: str) -> Served:
    """A server whose first worker processes start badly: each "dies", or takes a number of seconds longer."""
    (folder / "site").mkdir()
    (folder / "site" / "sitecustomize.py").write_text(AT_START)
    (folder / "starts").write_text("\n".join(starts))
    own = {"PYTHONPATH": str(folder / "site"), "STARTS": str(folder / "starts")}
    return Served(folder, IMPATIENT, COW_WORKERS="true", **own, **settings)


@pytest.mark.soak
def test_a_worker_that_starts_slowly_is_waited_for(tmp_path: Path) -> None:
    with bad_starts(tmp_path, f"{1.2 * SILENCE}", COW_CONCURRENCY="1") as served:
        assert served.http.post("/simulate", json=BODY).status_code == 200
        assert "was ended" not in served.log()


def test_no_job_fails_because_a_worker_cannot_start_or_does_not_load_in_time(tmp_path: Path) -> None:
    # The server stays up, and is ready after the third start. With more than one worker, the second could start just
    # when this looks for those to kill, and would do the job.
    limits = {"COW_CONCURRENCY": "1", "COW_LOAD_TIMEOUT": "12"}
    with bad_starts(tmp_path, "dies", "1000", **limits) as served:
        assert served.log().count("before it had loaded its backends") == 2
        assert "COW_LOAD_TIMEOUT" in served.log()
        (tmp_path / "starts").write_text("dies\n" * 3)  # as many as the crashes of its own that end a job
        for one in workers_of(served):
            one.kill()
        job = served.submit(BODY)
        refused = eventually(lambda: None if (answer := served.http.get("/readyz")).is_success else answer)
        assert "signal 9" in problem(refused, 503, "not-ready")["detail"]
        assert served.job(job["id"])["status"] in ("queued", "running")
        assert served.ended(job["id"])["status"] == "succeeded"
        eventually(lambda: served.http.get("/readyz").is_success)


def test_a_server_that_starts_while_its_database_is_away_waits_and_says_so(tmp_path: Path) -> None:
    with postgres() as database:
        database.kill()
        served = Served(tmp_path, COW_DATABASE_URL=database.url)
        with ExitStack() as stack:
            stack.callback(served.kill)
            served.start("/livez")
            problem(served.http.get("/readyz"), 503, "storage-unavailable")
            refused = served.http.post("/simulate", json=BODY)
            problem(refused, 503, "not-ready")
            assert refused.headers["Retry-After"]
            assert "the job database cannot be reached" in served.log()
            database.start()
            eventually(lambda: served.http.get("/readyz").is_success)
            assert served.http.post("/simulate", json=BODY).is_success


@pytest.mark.soak  # fifteen seconds of waiting
def test_a_second_worker_that_cannot_start_is_tried_more_and_more_rarely(tmp_path: Path) -> None:
    with bad_starts(tmp_path, COW_CONCURRENCY="2") as served:
        both = eventually(lambda: found if len(found := workers_of(served)) == 2 else None)
        eventually(lambda: len(served.http.get("/workers").json()["processes"][0]["workers"]) == 2)
        (tmp_path / "starts").write_text("dies\n" * 1000)
        both[1].kill()
        served.http.post("/simulate", json=BODY).raise_for_status()  # by the first
        eventually(lambda: re.search("3 starts have failed. Another one is started 1 s later", served.log()))
        assert served.http.get("/readyz").is_success
