"""Callers with keys of their own share a server, and nothing else."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
import pytest
from servers import ASYNC, BODY, TERMINAL, Served, data_url, events_of, picture, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.api.middleware.access import hash_of, new_key
from cow_service.media.images import encode_png

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Caller:
    """A caller with a key."""

    http: httpx.Client

    def post(self, body: dict[str, Any], **headers: str) -> httpx.Response:
        return self.http.post("/simulate", json=body, headers=headers)

    def submit(self, body: dict[str, Any], **headers: str) -> str:
        response = self.post(body, **ASYNC, **headers)
        assert response.status_code == 202, response.text
        return response.json()["id"]

    def job(self, job_id: str) -> dict[str, Any]:
        response = self.http.get(f"/jobs/{job_id}")
        assert response.status_code == 200, response.text
        return response.json()

    def ended(self, body: dict[str, Any], **headers: str) -> dict[str, Any]:
        job_id = self.submit(body, **headers)
        return eventually(lambda: job if (job := self.job(job_id))["status"] in TERMINAL else None)

    def ids(self, **query: Any) -> list[str]:
        return [job["id"] for job in self.http.get("/jobs", params={"limit": 500} | query).json()["jobs"]]

    def sees(self, sha256: str) -> bool:
        status = self.http.get(f"/artifacts/{sha256}").status_code
        assert status in (200, 404)
        assert self.http.head(f"/artifacts/{sha256}").status_code == status
        return status == 200


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Caller]]:
    """Two callers of a server of their own."""
    keys = {name: new_key() for name in ("alice", "bob")}
    hashes = json.dumps({name: hash_of(key) for name, key in keys.items()})
    with ExitStack() as stack:
        one = stack.enter_context(Served(tmp_path_factory.mktemp("owners"), COW_API_KEYS=hashes))
        clients = [httpx.Client(base_url=one.http.base_url, timeout=TIME_LIMIT) for _ in keys]
        for client, key in zip(clients, keys.values(), strict=True):
            stack.enter_context(client).headers["Authorization"] = f"Bearer {key}"
        yield [Caller(client) for client in clients]


@pytest.fixture
def alice(both: list[Caller]) -> Caller:
    return both[0]


@pytest.fixture
def bob(both: list[Caller]) -> Caller:
    return both[1]


def artifacts(job: dict[str, Any]) -> set[str]:
    """All that a job needs or made."""
    result = job["result"]
    shown = [*result["frames"], result["overlay"], result["grounding"]["mask"], result["image"], result["video"] or {}]
    return {one["sha256"] for one in shown if one}


def test_a_job_and_its_artifacts_are_its_owners_alone(alice: Caller, bob: Caller) -> None:
    job = alice.ended({**BODY, "video": True})
    assert job["status"] == "succeeded"
    url = f"/jobs/{job['id']}"
    strangers = [bob.http.get(f"{url}{part}") for part in ("", "/request", "/download", "/events")]
    strangers += [bob.http.post(f"{url}/cancel"), bob.http.delete(url)]
    never = bob.http.get("/jobs/00000000-0000-0000-0000-000000000000")
    for response in strangers:
        told = problem(response, 404, "job-not-found")
        assert told["detail"].replace(job["id"], "ID") == never.json()["detail"].replace(never.url.path[6:], "ID")
    assert alice.job(job["id"]) == job
    running = alice.submit(slow(30, seed=1))
    problem(bob.http.post(f"/jobs/{running}/cancel"), 404, "job-not-found")
    assert alice.http.post(f"/jobs/{running}/cancel").json()["status"] == "canceled"
    assert events_of(alice.http.get(f"{url}/events"))[-1]["event"] == "succeeded"
    assert job["id"] in alice.ids()
    assert not set(alice.ids()) & set(bob.ids())
    assert len(artifacts(job)) >= 5
    for sha256 in artifacts(job):
        assert alice.sees(sha256)
        assert not bob.sees(sha256)
        for headers in ({"If-None-Match": f'"{sha256}"'}, {"Range": "bytes=0-0"}):
            problem(bob.http.get(f"/artifacts/{sha256}", headers=headers), 404, "artifact-not-found")
    assert "private" in alice.http.get(job["result"]["overlay"]["url"]).headers["cache-control"]


def test_pages_hold_ones_own_jobs(alice: Caller, bob: Caller) -> None:
    made = [(alice.ended(BODY)["id"], bob.ended(BODY)["id"]) for _ in range(4)]
    page = alice.http.get("/jobs", params={"limit": 3}).json()
    assert [job["id"] for job in page["jobs"]] == [job for job, _ in made][:0:-1]
    assert not set(bob.ids(cursor=page["next"])) & set(alice.ids())


def test_masks_are_their_owners_alone_and_stay_while_the_job_does(alice: Caller, bob: Caller) -> None:
    mask = np.zeros((160, 240), np.uint8)
    mask[60:98, 170:205] = 255
    sent = encode_png(mask, level=9)  # other bytes than those of the mask that the first stage stores
    body = {**BODY, "objects": [{"object": "cube", "mask": data_url(sent)}]}
    assert alice.ended(body)["result"]["grounding"]["others"][0]["bbox"] == [170, 60, 205, 98]
    sha256 = hashlib.sha256(sent).hexdigest()
    assert alice.sees(sha256)
    kept = {**BODY, "objects": [{"object": "cube", "mask": {"artifact": sha256}}]}
    assert alice.ended(kept)["status"] == "succeeded"
    problem(bob.post(kept), 404, "artifact-not-found")
    problem(bob.post({**BODY, "grounding": kept["objects"][0]}), 404, "artifact-not-found")


def test_an_image_is_its_owners_alone(alice: Caller, bob: Caller) -> None:
    job = alice.ended({**BODY, "image": data_url(picture(2))})
    mine = {**BODY, "image": {"artifact": job["result"]["image"]["sha256"]}}
    for headers in (ASYNC, {}):
        told = problem(bob.post(mine, **headers), 404, "artifact-not-found")
        never = bob.post({**BODY, "image": {"artifact": "0" * 64}}, **headers).json()
        shas = (job["result"]["image"]["sha256"], "0" * 64)
        assert told["detail"].replace(shas[0], "ID") == never["detail"].replace(shas[1], "ID")
    assert alice.ended(mine)["status"] == "succeeded"
    other = {**BODY, "image": {"artifact": job["result"]["overlay"]["sha256"]}, "grounding": {"point": [60, 80]}}
    assert alice.ended(other)["status"] == "succeeded"
    problem(bob.post(other), 404, "artifact-not-found")


def test_an_image_is_there_for_its_owner_at_once_and_after_a_failure(alice: Caller) -> None:
    pink = {"grounding": None, "motion": None, "question": "If the pink car turns?"}
    lost = {**BODY, **pink, "image": data_url(picture(3))}
    job = alice.ended(lost)
    assert job["status"] == "failed"
    sha256 = image_of(lost)
    assert alice.sees(sha256)
    assert alice.ended({**BODY, "image": {"artifact": sha256}})["status"] == "succeeded"
    alice.submit(body := slow(1, seed=3, image=data_url(picture(4))))
    assert alice.sees(image_of(body))


def image_of(body: dict[str, Any]) -> str:
    return hashlib.sha256(base64.b64decode(body["image"].partition(",")[2])).hexdigest()


def test_what_both_sent_stays_while_one_of_them_needs_it(alice: Caller, bob: Caller) -> None:
    body = {**BODY, "image": data_url(picture(5))}
    first, second = alice.ended(body), bob.ended(body)
    assert artifacts(first) == artifacts(second)
    assert second["result"]["reused"] == [], "what another key asked is not told"
    assert bob.ended(body)["result"]["reused"] == ["grounding", "motion", "trajectory", "generation"]
    assert alice.http.delete(f"/jobs/{first['id']}").status_code == 204
    for sha256 in artifacts(first):
        assert bob.sees(sha256)
        assert not alice.sees(sha256)
    assert bob.ended({**BODY, "image": {"artifact": second["result"]["image"]["sha256"]}})["status"] == "succeeded"
    problem(alice.post({**BODY, "image": {"artifact": image_of(body)}}), 404, "artifact-not-found")
    for job_id in bob.ids():
        bob.http.delete(f"/jobs/{job_id}")
    assert not any(caller.sees(sha256) for caller in (alice, bob) for sha256 in artifacts(first))


def test_the_same_keys_are_different_jobs(alice: Caller, bob: Caller) -> None:
    key = {"Idempotency-Key": "the-same"}
    with ThreadPoolExecutor(8) as pool:
        jobs = list(pool.map(lambda caller: caller.submit(BODY, **key), [alice, bob] * 4))
    assert len(set(jobs)) == 2
    other = {**BODY, "seed": 4}
    problem(alice.post(other, **key), 422, "idempotency-key-reused")
    mine, others = alice.ended(BODY, **key)["id"], bob.ended(BODY, **key)["id"]
    assert {mine, others} == set(jobs)
    assert alice.post(BODY, **key).headers["idempotent-replayed"] == "true"
    assert "idempotent-replayed" not in alice.post(BODY).headers
    alice.http.delete(f"/jobs/{mine}")
    assert alice.post(other, **key).json()["generator"]["seed"] == 4
    assert bob.job(others)["status"] == "succeeded"
    problem(bob.post(other, **key), 422, "idempotency-key-reused")
