"""Worker processes that start slowly, or not at all, or freeze; and a server that starts while its database is away."""

from __future__ import annotations

import re
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from queue import Queue

import pytest
from postgres import postgres
from proxy import Proxy
from servers import BODY, SLOW_GENERATOR, Served, problem, slow
from tables import rows
from waiting import TIME_LIMIT, eventually
from worker_processes import workers_of

from cow_service.media.artifacts import DiskArtifacts
from cow_service.observability.metrics import Metrics
from cow_service.settings import Settings
from cow_service.workers import pool

pytestmark = pytest.mark.slow

# Runs at the start of every Python process of the server, before its imports.
AT_START = """
import os, pathlib, sys
if "cow_service.workers" in sys.orig_argv:
    file = pathlib.Path(os.environ["STARTS"])
    start, _, left = file.read_text().partition("\\n")
    file.write_text(left)
    if start == "dies":
        os.kill(os.getpid(), 9)
"""
# Another worker is started sooner than it would be, and one that says nothing is given up sooner.
IMPATIENT = """
from cow_service.workers import pool
pool.FIRST_PAUSE_SECONDS, pool.WATCH_SECONDS, pool.HEARTBEAT_TIMEOUT_SECONDS = 0.25, 0.2, 6.0
from cow_service.cli.main import app
app(["serve"])
"""


def bad_starts(folder: Path, *starts: str, **settings: str) -> Served:
    """A server whose first worker processes start badly: each "dies"."""
    (folder / "site").mkdir()
    (folder / "site" / "sitecustomize.py").write_text(AT_START)
    (folder / "starts").write_text("\n".join(starts))
    own = {"PYTHONPATH": f"{folder / 'site'}:{SLOW_GENERATOR}", "STARTS": str(folder / "starts")}
    return Served(folder, IMPATIENT, COW_WORKERS="true", **own, **settings)


def ends(served: Served, reason: str) -> int:
    """How many workers have ended for a reason."""
    told = re.search(rf'^cow_worker_ends_total{{reason="{reason}"}} (\d+)', served.http.get("/metrics").text, re.M)
    return int(told[1]) if told else 0


def test_no_job_fails_because_a_worker_cannot_start_or_freezes(tmp_path: Path) -> None:
    # The server stays up, and is ready after the second start. With more than one worker, the second could start just
    # when this looks for those to kill, and would do the job.
    with bad_starts(tmp_path, "dies", COW_CONCURRENCY="1") as served:
        assert ends(served, "crashed") == 1
        (tmp_path / "starts").write_text("dies\n" * 1000)
        for one in workers_of(served):
            one.kill()
        job = served.submit(BODY)
        refused = eventually(lambda: None if (answer := served.http.get("/readyz")).is_success else answer)
        assert "signal 9" in problem(refused, 503, "not-ready")["detail"]
        eventually(lambda: ends(served, "crashed") >= 5)  # more than the crashes of its own that end a job
        eventually(lambda: re.search("3 starts.* 1 s later", served.log()))  # they are tried more and more rarely
        assert served.job(job["id"])["status"] in ("queued", "running")
        (tmp_path / "starts").write_text("")
        assert served.ended(job["id"])["status"] == "succeeded"
        eventually(lambda: served.http.get("/readyz").is_success)
        job = served.submit(slow(100, seed=7))
        eventually(lambda: 7 in served.clips())
        (worker,) = workers_of(served)
        worker.send_signal(signal.SIGSTOP)
        eventually(lambda: served.clips().count(7) == 2)
        assert ends(served, "frozen") == 1
        assert served.http.post(f"/jobs/{job['id']}/cancel").json()["status"] == "canceled"


class Silent:
    """A worker that was started long ago, and has said nothing for a while."""

    is_alive, memory_bytes, idle_bytes, jobs = True, 0, 0, ()

    def __init__(self, name: str, settings: Settings, on_end: object) -> None:
        self.is_loaded, self.started = settings.load_timeout > 100, time.monotonic() - 100
        self.heard = time.monotonic() - pool.HEARTBEAT_TIMEOUT_SECONDS - 1
        self.ended = Queue[str]()

    def kill(self, end_reason: str, reason: str) -> None:
        self.ended.put(end_reason)

    def close(self) -> None:
        self.ended.put("stopped")


@pytest.mark.parametrize(
    ("load_timeout", "reason"), rows({"loading takes too long": (99, "load"), "it is frozen": (1000, "frozen")})
)
def test_a_worker_that_says_nothing_is_ended(
    load_timeout: float, reason: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(pool, "Worker", Silent)
    monkeypatch.setattr(pool, "WATCH_SECONDS", 0.01)
    settings = Settings(load_timeout=load_timeout, concurrency=1)
    workers = pool.WorkerPool(settings, Metrics(), DiskArtifacts(tmp_path))
    workers.start()
    (worker,) = workers.groups[0].workers
    assert isinstance(worker, Silent)
    assert worker.ended.get(timeout=TIME_LIMIT) == reason
    workers.close()


def test_a_server_whose_database_is_away_says_so_from_its_start_on(tmp_path: Path) -> None:
    """Also where the network loses every byte: that is an error and no silence."""
    with postgres() as database, Proxy(database.port) as network, ExitStack() as stack:
        database.kill()
        url = database.url.replace(str(database.port), str(network.port))
        served = Served(tmp_path, COW_DATABASE_URL=url)
        stack.callback(served.kill)
        served.start("/livez")
        # It answers probes while the reader is still being loaded.
        eventually(lambda: served.http.get("/readyz").json()["type"].endswith("storage-unavailable"))
        problem(served.http.get("/readyz"), 503, "storage-unavailable")
        refused = served.http.post("/simulate", json=BODY)
        problem(refused, 503, "storage-unavailable")
        assert refused.headers["Retry-After"]
        assert "COW_DATABASE_URL" in served.log()
        database.start()
        eventually(lambda: served.http.get("/readyz").is_success)
        job_id = served.submit(BODY)["id"]
        served.ended(job_id)
        network.hold()
        requests = [("GET", f"/jobs/{job_id}", None), ("POST", "/simulate", BODY | {"seed": 1}), ("GET", "/jobs", None)]
        with ThreadPoolExecutor() as callers:
            responses = list(callers.map(lambda one: served.http.request(one[0], one[1], json=one[2]), requests))
        for response in responses:
            problem(response, 503, "storage-unavailable")
            assert response.headers["Retry-After"]
        network.restore()
        eventually(lambda: served.http.get("/readyz").is_success)
        assert served.job(job_id)["status"] == "succeeded"
        network.hold()
        served.stop()
