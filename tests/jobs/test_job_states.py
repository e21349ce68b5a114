"""Whatever callers do in whatever order, and however often the server ends: jobs keep what was promised of them."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from conftest import SCALE
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    initialize,
    invariant,
    multiple,
    precondition,
    rule,
)
from servers import BODY, TERMINAL, Served, problem, slow

WANTED = {"cutout": BODY, "quick": slow(0.2), "long": slow(3)}


@dataclass
class Known:
    """What was promised of a job."""

    key: str | None
    body: str
    end: Any = None  # status, result, problem and when it ended


class Jobs(RuleBasedStateMachine):
    """One server, its callers, and what they may count on."""

    jobs = Bundle("jobs")

    @initialize()
    def start(self) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="cow-states-")
        self.served = Served(Path(self.folder.name), COW_SHUTDOWN_GRACE="1", COW_CONCURRENCY="1")
        self.known: dict[str, Known] = {}
        self.changed = False  # whether anything was asked for since the server started
        self.deleted: set[str] = set()

    @rule(target=jobs, body=st.sampled_from(sorted(WANTED)), key=st.sampled_from([None, None, "a", "b"]))
    def submit(self, body: str, key: str | None) -> Any:
        if self.served.process is None:  # hypothesis drops many examples before their first step: they start none
            self.served.start()
        self.changed = True
        headers = {"Prefer": "respond-async"} | ({} if key is None else {"Idempotency-Key": key})
        response = self.served.http.post("/simulate", json=WANTED[body], headers=headers)
        same = next((job for job, known in self.known.items() if key is not None and known.key == key), None)
        if same is not None and self.known[same].body != body:
            problem(response, 422, "idempotency-key-reused")
            return multiple()
        assert response.status_code == 202, response.text
        job = response.json()["id"]
        assert same in (None, job)
        if same is not None:
            return multiple()
        assert job not in self.known
        self.deleted.discard(job)  # a key that is free again gives the same id
        self.known[job] = Known(key, body)
        return job

    @rule(job=jobs)
    def wait_for_its_end(self, job: str) -> None:
        if job in self.known:
            ended = self.served.ended(job)
            assert ended["status"] != "failed", ended
            self.look(ended)

    @rule(job=jobs)
    def cancel(self, job: str) -> None:
        self.changed = True
        response = self.served.http.post(f"/jobs/{job}/cancel")
        if job in self.known:
            assert response.json()["status"] in TERMINAL
            self.look(response.json())
        else:
            problem(response, 404, "job-not-found")

    @rule(job=consumes(jobs))
    def delete(self, job: str) -> None:
        self.changed = True
        response = self.served.http.delete(f"/jobs/{job}")
        if self.known.pop(job, None) is None:
            problem(response, 404, "job-not-found")
        else:
            assert response.status_code == 204
        self.deleted.add(job)

    @precondition(lambda self: self.changed)
    @rule(in_peace=st.booleans())
    def end(self, in_peace: bool) -> None:
        if in_peace:
            self.served.stop()
        else:
            self.served.kill()
        self.served.start()
        self.changed = False

    def look(self, job: dict[str, Any]) -> None:
        """What has ended stays as it ended."""
        known = self.known[job["id"]]
        if job["status"] in TERMINAL:
            end = [job[name] for name in ("status", "result", "problem", "finished_at")]
            assert known.end in (None, end)
            known.end = end
            assert (job["result"] is not None) == (job["status"] == "succeeded")
        else:
            assert known.end is None
            assert job["finished_at"] is None

    @invariant()
    def all_are_there(self) -> None:
        if not self.known and not self.deleted:
            return
        listed = {job["id"]: job for job in self.served.http.get("/jobs", params={"limit": 500}).json()["jobs"]}
        assert set(listed) == set(self.known)
        for job_id in listed:
            self.look(self.served.job(job_id))
        for job_id in self.deleted:
            problem(self.served.http.get(f"/jobs/{job_id}"), 404, "job-not-found")

    def teardown(self) -> None:
        if hasattr(self, "served"):
            self.served.kill()
            self.folder.cleanup()


TestJobs = Jobs.TestCase
TestJobs.settings = settings(max_examples=SCALE, stateful_step_count=12, suppress_health_check=list(HealthCheck))
TestJobs.pytestmark = [pytest.mark.slow, pytest.mark.soak, pytest.mark.scaled, pytest.mark.timeout(600 * SCALE)]
