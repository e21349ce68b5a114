"""Callers with keys of their own share a server, and nothing else."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import Any

import httpx
import numpy as np
import pytest
from servers import ASYNC, BODY, Served, data_url, events_of, picture, problem, slow
from waiting import TIME_LIMIT

from cow_service.api.middleware.access import hash_of, new_key
from cow_service.media.images import encode_png

pytestmark = pytest.mark.slow


def post(caller: Served, body: dict[str, Any], **headers: str) -> httpx.Response:
    return caller.http.post("/simulate", json=body, headers=headers)


def submit(caller: Served, body: dict[str, Any], **headers: str) -> str:
    return caller.submit(body, **headers)["id"]


def ended(caller: Served, body: dict[str, Any], **headers: str) -> dict[str, Any]:
    return caller.ended(submit(caller, body, **headers))


def ids(caller: Served, **query: Any) -> list[str]:
    return [job["id"] for job in caller.http.get("/jobs", params={"limit": 500} | query).json()["jobs"]]


def sees(caller: Served, sha256: str) -> bool:
    status = caller.http.get(f"/artifacts/{sha256}").status_code
    assert status in (200, 404)
    assert caller.http.head(f"/artifacts/{sha256}").status_code == status
    return status == 200


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Served]]:
    """Two callers of a server of their own."""
    keys = {name: new_key() for name in ("alice", "bob")}
    hashes = json.dumps({name: hash_of(key) for name, key in keys.items()})
    with Served(tmp_path_factory.mktemp("owners"), COW_API_KEYS=hashes) as one:
        callers = [copy(one) for _ in keys]
        for caller, key in zip(callers, keys.values(), strict=True):
            headers = {"Authorization": f"Bearer {key}"}
            caller.http = httpx.Client(base_url=one.http.base_url, timeout=TIME_LIMIT, headers=headers)
        yield callers
        for caller in callers:
            caller.http.close()


@pytest.fixture
def alice(both: list[Served]) -> Served:
    return both[0]


@pytest.fixture
def bob(both: list[Served]) -> Served:
    return both[1]


def artifacts(job: dict[str, Any]) -> set[str]:
    """All that a job needs or made."""
    result = job["result"]
    shown = [*result["frames"], result["overlay"], result["grounding"]["mask"], result["image"], result["video"] or {}]
    return {one["sha256"] for one in shown if one}


def test_a_job_and_its_artifacts_are_its_owners_alone(alice: Served, bob: Served) -> None:
    job = ended(alice, {**BODY, "video": True})
    assert job["status"] == "succeeded"
    url = f"/jobs/{job['id']}"
    strangers = [bob.http.get(f"{url}{part}") for part in ("", "/request", "/download", "/events")]
    strangers += [bob.http.post(f"{url}/cancel"), bob.http.delete(url)]
    never = bob.http.get("/jobs/00000000-0000-0000-0000-000000000000")
    for response in strangers:
        told = problem(response, 404, "job-not-found")
        assert told["detail"].replace(job["id"], "ID") == never.json()["detail"].replace(never.url.path[6:], "ID")
    assert alice.job(job["id"]) == job
    running = submit(alice, slow(30, seed=1))
    problem(bob.http.post(f"/jobs/{running}/cancel"), 404, "job-not-found")
    assert alice.http.post(f"/jobs/{running}/cancel").json()["status"] == "canceled"
    assert events_of(alice.http.get(f"{url}/events"))[-1]["event"] == "succeeded"
    assert job["id"] in ids(alice)
    assert not set(ids(alice)) & set(ids(bob))
    assert len(artifacts(job)) >= 5
    for sha256 in artifacts(job):
        assert sees(alice, sha256)
        assert not sees(bob, sha256)
        for headers in ({"If-None-Match": f'"{sha256}"'}, {"Range": "bytes=0-0"}):
            problem(bob.http.get(f"/artifacts/{sha256}", headers=headers), 404, "artifact-not-found")
    assert "private" in alice.http.get(job["result"]["overlay"]["url"]).headers["cache-control"]


def test_masks_are_their_owners_alone_and_stay_while_the_job_does(alice: Served, bob: Served) -> None:
    mask = np.zeros((160, 240), np.uint8)
    mask[60:98, 170:205] = 255
    sent = encode_png(mask, level=9)  # other bytes than those of the mask that the first stage stores
    body = {**BODY, "objects": [{"object": "cube", "mask": data_url(sent)}]}
    assert ended(alice, body)["result"]["grounding"]["others"][0]["bbox"] == [170, 60, 205, 98]
    sha256 = hashlib.sha256(sent).hexdigest()
    assert sees(alice, sha256)
    kept = {**BODY, "objects": [{"object": "cube", "mask": {"artifact": sha256}}]}
    assert ended(alice, kept)["status"] == "succeeded"
    problem(post(bob, kept), 404, "artifact-not-found")
    problem(post(bob, {**BODY, "grounding": kept["objects"][0]}), 404, "artifact-not-found")


def test_an_image_is_its_owners_alone(alice: Served, bob: Served) -> None:
    job = ended(alice, {**BODY, "image": data_url(picture(2))})
    mine = {**BODY, "image": {"artifact": job["result"]["image"]["sha256"]}}
    for headers in (ASYNC, {}):
        told = problem(post(bob, mine, **headers), 404, "artifact-not-found")
        never = post(bob, {**BODY, "image": {"artifact": "0" * 64}}, **headers).json()
        shas = (job["result"]["image"]["sha256"], "0" * 64)
        assert told["detail"].replace(shas[0], "ID") == never["detail"].replace(shas[1], "ID")
    assert ended(alice, mine)["status"] == "succeeded"
    other = {**BODY, "image": {"artifact": job["result"]["overlay"]["sha256"]}, "grounding": {"point": [60, 80]}}
    assert ended(alice, other)["status"] == "succeeded"
    problem(post(bob, other), 404, "artifact-not-found")


def test_an_image_is_there_for_its_owner_at_once_and_after_a_failure(alice: Served) -> None:
    pink = {"grounding": None, "motion": None, "question": "If the pink car turns?"}
    lost = {**BODY, **pink, "image": data_url(picture(3))}
    job = ended(alice, lost)
    assert job["status"] == "failed"
    sha256 = image_of(lost)
    assert sees(alice, sha256)
    assert ended(alice, {**BODY, "image": {"artifact": sha256}})["status"] == "succeeded"
    submit(alice, body := slow(1, seed=3, image=data_url(picture(4))))
    assert sees(alice, image_of(body))


def image_of(body: dict[str, Any]) -> str:
    return hashlib.sha256(base64.b64decode(body["image"].partition(",")[2])).hexdigest()


def test_what_both_sent_stays_while_one_of_them_needs_it(alice: Served, bob: Served) -> None:
    body = {**BODY, "image": data_url(picture(5))}
    first, second = ended(alice, body), ended(bob, body)
    assert artifacts(first) == artifacts(second)
    assert second["result"]["reused"] == [], "what another key asked is not told"
    assert ended(bob, body)["result"]["reused"] == ["grounding", "motion", "trajectory", "generation"]
    assert alice.http.delete(f"/jobs/{first['id']}").status_code == 204
    for sha256 in artifacts(first):
        assert sees(bob, sha256)
        assert not sees(alice, sha256)
    assert ended(bob, {**BODY, "image": {"artifact": second["result"]["image"]["sha256"]}})["status"] == "succeeded"
    problem(post(alice, {**BODY, "image": {"artifact": image_of(body)}}), 404, "artifact-not-found")
    for job_id in ids(bob):
        bob.http.delete(f"/jobs/{job_id}")
    assert not any(sees(caller, sha256) for caller in (alice, bob) for sha256 in artifacts(first))


def test_the_same_keys_are_different_jobs(alice: Served, bob: Served) -> None:
    key = {"Idempotency-Key": "the-same"}
    with ThreadPoolExecutor(8) as pool:
        jobs = list(pool.map(lambda caller: submit(caller, BODY, **key), [alice, bob] * 4))
    assert len(set(jobs)) == 2
    other = {**BODY, "seed": 4}
    problem(post(alice, other, **key), 422, "idempotency-key-reused")
    mine, others = ended(alice, BODY, **key)["id"], ended(bob, BODY, **key)["id"]
    assert {mine, others} == set(jobs)
    assert post(alice, BODY, **key).headers["idempotent-replayed"] == "true"
    assert "idempotent-replayed" not in post(alice, BODY).headers
    alice.http.delete(f"/jobs/{mine}")
    assert post(alice, other, **key).json()["generator"]["seed"] == 4
    assert bob.job(others)["status"] == "succeeded"
    problem(post(bob, other, **key), 422, "idempotency-key-reused")
