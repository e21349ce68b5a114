"""What was acknowledged is on the disk: it outlives a database server that is killed, and a loss of power."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from conftest import SCALE, SLOWNESS
from postgres import postgres
from proxy import Proxy
from servers import ASYNC, BODY, Served, eventually, problem

pytestmark = [pytest.mark.slow, pytest.mark.soak, pytest.mark.timeout(900 * SCALE)]
CALLERS = 2
CRASHES = 2 * SCALE


class Load:
    """Callers that send requests one after another: each waits for its result, or goes on with the job's id."""

    server: Served

    def __init__(self) -> None:
        self._stop, self._seeds = threading.Event(), itertools.count()
        self._threads: list[threading.Thread] = []
        self.acknowledged: set[str] = set()
        self.results: dict[str, dict[str, Any]] = {}

    def submit(self) -> bool:
        """Sends a request for a job; returns whether it was acknowledged."""
        body = BODY | {"seed": next(self._seeds)}
        response = self.server.http.post("/simulate", json=body, headers=ASYNC)
        if response.status_code == 202:
            self.acknowledged.add(response.json()["id"])
        return response.status_code == 202

    def _call(self) -> None:
        while not self._stop.is_set():
            try:
                if not self.submit():
                    time.sleep(0.05)
                response = self.server.http.post("/simulate", json=BODY | {"seed": next(self._seeds)})
                if response.status_code == 200:
                    self.results[response.json()["id"]] = response.json()["trajectory"]
            except httpx.TransportError:  # its server is being killed
                time.sleep(0.05)

    def __enter__(self) -> Load:
        self._stop.clear()
        self._threads = [threading.Thread(target=self._call) for _ in range(CALLERS)]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def check(self) -> None:
        """Every job that was acknowledged is there and ends well; every result that was returned is the job's."""
        assert self.acknowledged, "nobody was answered: the test shows nothing"
        assert self.results, "nobody had a result: the test shows nothing"
        for job_id in self.acknowledged | self.results.keys():
            job = eventually(lambda job_id=job_id: self._ended(job_id))
            assert job["status"] == "succeeded", job
            if job_id in self.results:
                assert job["result"]["trajectory"] == self.results[job_id]

    def _ended(self, job_id: str) -> dict[str, Any] | None:
        response = self.server.http.get(f"/jobs/{job_id}")
        assert response.status_code in (200, 503), f"{job_id} is lost: {response.text}"
        return (
            response.json() if response.is_success and response.json()["status"] not in ("queued", "running") else None
        )


def test_nothing_acknowledged_is_lost_when_postgresql_is_killed(tmp_path: Path) -> None:
    load = Load()
    with postgres() as database, Served(tmp_path, COW_DATABASE_URL=database.url) as server:
        load.server = server
        with load:
            for _ in range(CRASHES):
                eventually(load.submit)
                database.kill()
                database.start()
                eventually(lambda: server.http.get("/readyz").is_success)
        load.check()


def test_nothing_acknowledged_is_lost_with_the_power(tmp_path: Path) -> None:
    """On SQLite and a folder of artifacts: the next server finds only what the one before had synced."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler: a loss of power is simulated by a library that is preloaded")
    shim, folder, disk = tmp_path / "power_cut.so", tmp_path / "files", tmp_path / "disk"
    source = Path(__file__).with_name("power_cut.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-o", shim, source, "-ldl"], check=True)
    folder.mkdir()
    disk.mkdir()
    preloaded = {"POWER_CUT_FILES": str(folder), "POWER_CUT_DISK": str(disk), "LD_PRELOAD": str(shim)}
    load = Load()
    for _ in range(CRASHES):
        with Served(folder, **preloaded) as server:
            load.server, had = server, len(load.results)
            with load:
                eventually(lambda had=had: len(load.results) > had)
                eventually(load.submit)
                server.process.kill()
        shutil.rmtree(folder)
        shutil.copytree(disk, folder, ignore=shutil.ignore_patterns(".*"))
        shutil.rmtree(disk / ".inodes")
    with Served(folder) as server:
        load.server = server
        load.check()


def test_a_network_that_loses_every_byte_is_an_answer_within_ten_seconds(tmp_path: Path) -> None:
    with (
        postgres() as database,
        Proxy(database.port) as network,
        Served(tmp_path, COW_DATABASE_URL=database.url.replace(str(database.port), str(network.port))) as server,
    ):
        job_id = server.submit(BODY)["id"]
        server.ended(job_id)
        for _ in range(CRASHES):
            network.hold()
            requests = [
                ("GET", f"/jobs/{job_id}", None),
                ("POST", "/simulate", BODY | {"seed": 1}),
                ("GET", "/jobs", None),
            ]
            with ThreadPoolExecutor() as callers:
                began = time.monotonic()
                responses = list(callers.map(lambda one: server.http.request(one[0], one[1], json=one[2]), requests))
            assert time.monotonic() - began < 10 * SLOWNESS
            for response in responses:
                problem(response, 503, "storage-unavailable")
                assert response.headers["Retry-After"]
            network.restore()
            eventually(lambda: server.http.get("/readyz").is_success)
            assert server.job(job_id)["status"] == "succeeded"
        network.hold()
        began = time.monotonic()
        server.stop()
        assert time.monotonic() - began < 30 * SLOWNESS
