"""Worker processes that start slowly, or not at all, or freeze; and a server that starts while its database is away."""

from __future__ import annotations

import re
import signal
from contextlib import ExitStack
from pathlib import Path

import pytest
from postgres import postgres
from servers import BODY, SLOW_GENERATOR, Served, problem, slow
from waiting import eventually
from worker_processes import workers_of

from cow_service.workers.pool import HEARTBEAT_TIMEOUT_SECONDS

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
# Another worker is started sooner than it would be.
IMPATIENT = """
from cow_service.workers import pool
pool.FIRST_PAUSE_SECONDS, pool.WATCH_SECONDS = 0.25, 0.2
from cow_service.cli.main import app
app(["serve"])
"""


def bad_starts(folder: Path, *starts: str, **settings: str) -> Served:
    """A server whose first worker processes start badly: each "dies", or takes a number of seconds longer."""
    (folder / "site").mkdir()
    (folder / "site" / "sitecustomize.py").write_text(AT_START)
    (folder / "starts").write_text("\n".join(starts))
    own = {"PYTHONPATH": f"{folder / 'site'}:{SLOW_GENERATOR}", "STARTS": str(folder / "starts")}
    return Served(folder, IMPATIENT, COW_WORKERS="true", **own, **settings)


def ends(served: Served, reason: str) -> int:
    """How many workers have ended for a reason."""
    told = re.search(rf'^cow_worker_ends_total{{reason="{reason}"}} (\d+)', served.http.get("/metrics").text, re.M)
    return int(told[1]) if told else 0


@pytest.mark.soak
def test_a_worker_that_starts_slowly_is_waited_for(tmp_path: Path) -> None:
    with bad_starts(tmp_path, f"{1.2 * HEARTBEAT_TIMEOUT_SECONDS}", COW_CONCURRENCY="1") as served:
        assert served.http.post("/simulate", json=BODY).status_code == 200
        assert sum(ends(served, reason) for reason in ("crashed", "frozen", "load")) == 0


def test_no_job_fails_because_a_worker_cannot_start_or_freezes(tmp_path: Path) -> None:
    # The server stays up, and is ready after the third start. With more than one worker, the second could start just
    # when this looks for those to kill, and would do the job.
    with bad_starts(tmp_path, "dies", "1000", COW_CONCURRENCY="1", COW_LOAD_TIMEOUT="25") as served:
        assert (ends(served, "crashed"), ends(served, "load")) == (1, 1)
        (tmp_path / "starts").write_text("dies\n" * 1000)
        for one in workers_of(served):
            one.kill()
        job = served.submit(BODY)
        refused = eventually(lambda: None if (answer := served.http.get("/readyz")).is_success else answer)
        assert "signal 9" in problem(refused, 503, "not-ready")["detail"]
        eventually(lambda: ends(served, "crashed") >= 5)  # more than the crashes of its own that end a job
        assert served.job(job["id"])["status"] in ("queued", "running")
        (tmp_path / "starts").write_text("")
        assert served.ended(job["id"])["status"] == "succeeded"
        eventually(lambda: served.http.get("/readyz").is_success)
        job = served.submit(slow(1, seed=7))
        eventually(lambda: 7 in served.clips())
        (worker,) = workers_of(served)
        worker.send_signal(signal.SIGSTOP)
        assert served.ended(job["id"])["status"] == "succeeded"
        assert (ends(served, "frozen"), served.clips().count(7)) == (1, 2)


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
            assert "COW_DATABASE_URL" in served.log()
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
        eventually(lambda: re.search("3 starts.* 1 s later", served.log()))
        assert served.http.get("/readyz").is_success
