"""Jobs on a real Ray cluster of two nodes, and what becomes of them where actors, nodes and the head are killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from ray_nodes import RayNodes
from servers import Served, problem, slow
from waiting import eventually
from worker_contract import GIVES_UP_SOONER, Contract, workers_told

from cow_service.observability.metrics import Metrics
from cow_service.settings import Settings, SettingsError, load_settings

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RayNodes]:
    with RayNodes(tmp_path_factory.mktemp("ray")) as cluster:
        cluster.add()
        cluster.add()
        yield cluster


@pytest.fixture(scope="module")
def served(nodes: RayNodes) -> Iterator[Served]:
    own = {"COW_RAY": nodes.address, "COW_WORKER_MEMORY_MB": "600", "COW_JOB_TIMEOUT": "90"}
    # The bridge notices soon that the head is away.
    own |= {"RAY_gcs_rpc_server_reconnect_timeout_s": "3", "RAY_USAGE_STATS_ENABLED": "0"}
    with Served(nodes.folder, GIVES_UP_SOONER, **own) as one:
        eventually(lambda: capacity(one) == 2)
        nodes.add()
        yield one
        one.stop()
        assert eventually(lambda: not nodes.actors()), "they end with their server"


class TestActors(Contract):
    """As worker processes."""


def busy(served: Served, jobs: list[str]) -> list[int]:
    """The actors that make the clips of some jobs."""
    rendering = {
        job["id"]: one["pid"] for one in workers_told(served) for job in one["jobs"] if job["stage"] == "generation"
    }
    return [rendering[job] for job in jobs if job in rendering]


def capacity(served: Served) -> int:
    (process,) = served.http.get("/workers").json()["processes"]
    return process["queues"].get("light", 0)


def test_no_job_is_lost_or_doubled_where_actors_and_nodes_are_killed(served: Served, nodes: RayNodes) -> None:
    third = nodes.newest
    eventually(lambda: capacity(served) == 3)  # a node more, a place more
    others = [served.submit(slow(100, seed=seed))["id"] for seed in range(190, 193)]
    eventually(lambda: len(busy(served, others)) == 3)  # and an actor more
    for job in others:
        served.http.post(f"/jobs/{job}/cancel").raise_for_status()
    jobs = [served.submit(slow(4, seed=seed))["id"] for seed in range(200, 206)]
    actors = eventually(lambda: found if len(found := busy(served, jobs)) == 3 else None)
    os.kill(next(pid for pid in actors if not nodes.has(third, pid)), signal.SIGKILL)
    assert any(nodes.has(third, pid) for pid in actors), "each node has one"
    nodes.kill(third)
    assert [served.ended(job)["status"] for job in jobs] == ["succeeded"] * 6
    begun = [served.clips().count(seed) for seed in range(200, 206)]
    assert sorted(begun) == [1, 1, 1, 1, 2, 2], "two of them were begun again"
    eventually(lambda: capacity(served) == 2)


def test_jobs_wait_while_the_head_is_away(served: Served, nodes: RayNodes) -> None:
    job = served.submit(slow(3, seed=300))
    eventually(lambda: 300 in served.clips())
    nodes.end()
    told = eventually(lambda: None if (answer := served.http.get("/readyz")).is_success else answer)
    assert "Ray cluster" in problem(told, 503, "not-ready")["detail"]
    waits = served.submit(slow(0.1, seed=301))
    nodes.add()
    for one in (job, waits):
        assert served.ended(one["id"])["status"] == "succeeded"
    assert served.http.get("/readyz").is_success


def test_a_server_that_others_cannot_share_takes_no_nodes_of_other_machines(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cow_service.workers.ray_cluster import Cluster

    there = [("another", {"CPU": 4.0, "memory": 1e12})]
    for own, room in (({}, 0), ({"database_url": "postgresql://cow@db/cow", "artifacts": "s3://cow"}, 4)):
        cluster = Cluster(Settings(ray="auto", **own))
        cluster.note_nodes(there)
        assert cluster.room({"CPU": 1.0, "memory": 1e9}) == room
        assert ("COW_DATABASE_URL" in (cluster.fault or "")) == (room == 0)


def test_what_is_missing_or_wrong_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    from cow_service.workers import ray_cluster

    with pytest.raises(SettingsError, match="COW_RAY"):
        load_settings(ray="ray://head:10001")
    monkeypatch.setattr(ray_cluster, "find_spec", lambda name: None)
    with pytest.raises(SettingsError, match=r"pip install .*\[ray\]"):
        ray_cluster.RayCluster(Settings(ray="auto"), Metrics())
