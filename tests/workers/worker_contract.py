"""What every way to compute jobs apart from the server has to do."""

from __future__ import annotations

from typing import Any

import pytest
from servers import BODY, Served, problem, slow
from waiting import eventually

# Each further try costs the start of a worker.
GIVES_UP_SOONER = """
from cow_service.workers import pool
pool.MAX_CRASHES = 2
from cow_service.cli.main import app
app(["serve"])
"""


def poison(how: str, seed: int = 0) -> dict[str, Any]:
    """A request whose clip does something to the process that makes it, after a moment."""
    body = slow(0.2, seed=seed)
    return body | {"generator_options": {"seconds": 0.2, "end": how}}


def workers_told(served: Served) -> list[dict[str, Any]]:
    """The workers of a server, as it says."""
    (process,) = served.http.get("/workers").raise_for_status().json()["processes"]
    return process["workers"]


def pids(served: Served) -> set[int]:
    return {one["pid"] for one in workers_told(served)}


class Contract:
    """Each subclass is in a file with a fixture `served`: a server that gives a job up after two crashes."""

    def test_a_worker_is_kept_for_the_next_job(self, served: Served) -> None:
        (worker,) = eventually(lambda: pids(served))
        for _ in range(2):
            served.http.post("/simulate", json=BODY).raise_for_status()
        assert pids(served) == {worker}

    def test_a_crash_harms_the_job_that_caused_it_and_no_other(self, served: Served) -> None:
        innocents = [served.submit(slow(0.3, seed=seed))["id"] for seed in (1, 2)]
        guilty = served.submit(poison("kill", seed=100))["id"]
        innocents += [served.submit(slow(0.3, seed=seed))["id"] for seed in (3, 4)]
        ended = served.ended(guilty)
        assert ended["status"] == "failed"
        assert ended["problem"]["type"] == "urn:cow:problem:worker-ended"
        assert "crashed" in ended["problem"]["detail"]
        others = [served.ended(one) for one in innocents]
        assert [one["problem"] for one in others if one["status"] != "succeeded"] == []
        assert served.clips().count(100) == 2, "it is tried again: the crash may have been no fault of the job"
        assert all(served.clips().count(seed) == 1 for seed in range(1, 5)), "nobody else was begun twice"

    def test_too_much_memory_ends_the_job_alone(self, served: Served) -> None:
        told = problem(served.http.post("/simulate", json=poison("memory", seed=101)), 500, "worker-ended")
        assert "MB" in told["detail"]
        assert served.clips().count(101) == 1, "it would take as much again"
        assert served.http.post("/simulate", json=slow(0.1, seed=102)).status_code == 200

    def test_a_worker_whose_device_fails_is_replaced(self, served: Served) -> None:
        before = pids(served)
        problem(served.http.post("/simulate", json=poison("device", seed=120)), 503, "device-failed")
        assert served.clips().count(120) == 2, "another process may be able to use it"
        assert served.http.post("/simulate", json=slow(0.1, seed=121)).status_code == 200
        assert not before & pids(served)

    @pytest.mark.soak
    def test_a_job_that_never_ends_is_ended(self, served: Served) -> None:
        problem(served.http.post("/simulate", json=poison("hang", seed=103)), 504, "job-timeout")
        assert served.http.post("/simulate", json=slow(0.1, seed=104)).status_code == 200

    def test_a_job_that_cannot_be_stopped_is_canceled_all_the_same(self, served: Served) -> None:
        job = served.submit(poison("hang", seed=105))
        served.rendering(job["id"])
        assert served.http.post(f"/jobs/{job['id']}/cancel").json()["status"] == "canceled"
        assert served.http.post("/simulate", json=slow(0.1, seed=106)).status_code == 200
