"""Jobs on a real Ray cluster of two nodes, and what becomes of them where actors, nodes and the head are killed."""

from __future__ import annotations

import os
import platform
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from pydantic_core import to_json
from ray_nodes import RayNodes
from servers import Served, problem, slow
from tables import rows
from waiting import TIME_LIMIT, eventually
from worker_contract import GIVES_UP_SOONER, Contract, workers_told

from cow_service.media.artifacts import DiskArtifacts
from cow_service.observability.metrics import Metrics
from cow_service.settings import Settings, SettingsError, load_settings
from cow_service.workers import messages, process, ray_cluster

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


def test_a_server_that_others_cannot_share_takes_no_nodes_of_other_machines() -> None:
    there = [("another", {"CPU": 4.0, "memory": 1e12})]
    for own, room in (({}, 0), ({"database_url": "postgresql://cow@db/cow", "artifacts": "s3://cow"}, 4)):
        cluster = ray_cluster.Cluster(Settings(ray="auto", **own))
        cluster.note_nodes(there)
        assert cluster.room({"CPU": 1.0, "memory": 1e9}) == room
        assert ("COW_DATABASE_URL" in (cluster.fault or "")) == (room == 0)


def test_an_idle_actor_gives_its_place_to_jobs_of_another_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_cluster, "PLACE_SECONDS", 0.0)
    monkeypatch.setattr(process, "END_SECONDS", 0.1)
    cluster, links = ray_cluster.Cluster(Settings(ray="auto")), list[ray_cluster.ActorLink]()
    cluster.note_nodes([(platform.node(), {"CPU": 1.0, "memory": 1e12})])

    def open_actor(needs: dict[str, float]) -> ray_cluster.ActorLink:
        links.append(ray_cluster.ActorLink(len(links), lambda frame: None))
        return links[-1]

    monkeypatch.setattr(cluster, "open_actor", open_actor)
    settings = Settings(ray="auto", generator_concurrency={"slow": 1})
    light, other = (ray_cluster.ActorGroup(name, settings, Metrics(), cluster) for name in ("light", "slow"))
    light.fill()
    (idle,) = light.workers
    links[0].receive("placed", b"1")
    links[0].receive("message", to_json(messages.Loaded(None)))
    eventually(lambda: idle.is_loaded)
    light.fill()
    assert light.workers == [idle], "it is the fewest that there are to be"
    with ThreadPoolExecutor() as jobs:
        taken = jobs.submit(other.take, lambda: None)
        eventually(lambda: len(links) == 2)
        other.fill()
        light.fill()
        assert light.workers == []
        assert links[0].wait(TIME_LIMIT) == "killed"
        links[1].receive("placed", b"2")
        assert [taken.result(TIME_LIMIT)] == other.workers
    links[1].kill()


@pytest.mark.parametrize(
    ("queue", "own", "needs"),
    rows(
        {
            "light": ("light", {}, {"CPU": 1}),
            "vision on a GPU": ("light", {"perception": "gpu"}, {"CPU": 1, "GPU": 1}),
            "a clip": ("ati", {}, {"GPU": 1}),
            "a clip on two GPUs": ("ati", {"profile": "exact-2"}, {"GPU": 2}),
            "an MLLM": ("local", {"reader": "local"}, {"GPU": 1}),
            "no GPU": ("ati", {"device": "cpu"}, {"CPU": 1}),
        }
    ),
)
def test_an_actor_asks_for_what_its_backend_takes(queue: str, own: dict[str, str], needs: dict[str, float]) -> None:
    settings = Settings.model_validate({"ray": "auto", "worker_memory_mb": 500.0, **own})
    group = ray_cluster.ActorGroup(queue, settings, Metrics(), ray_cluster.Cluster(settings))
    assert group.needs == {**needs, "memory": 5e8}


def test_what_is_missing_or_wrong_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingsError, match="COW_RAY"):
        load_settings(ray="ray://head:10001")
    monkeypatch.setattr(ray_cluster, "find_spec", lambda name: None)
    with pytest.raises(SettingsError, match=r"pip install .*\[ray\]"):
        ray_cluster.RayCluster(Settings(ray="auto"), Metrics(), DiskArtifacts(tmp_path))
