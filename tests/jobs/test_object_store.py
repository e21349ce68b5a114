"""Real servers that keep their artifacts on a real S3 server, and share no folder."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import httpx
import pytest
from callers import as_caller, new_keys
from servers import BODY, IMAGE, Served, problem, slow
from waiting import eventually

if TYPE_CHECKING:
    from object_store import ObjectStore

pytestmark = pytest.mark.slow

WITH_VIDEO = {**BODY, "video": True, "frames": {"policy": "initial", "count": 3}}
SETTINGS, KEYS = new_keys("alice", "bob")


@pytest.fixture(scope="module")
def objects() -> Iterator[ObjectStore]:
    from object_store import serving

    with serving() as objects:
        yield objects


@pytest.fixture(scope="module")
def served(tmp_path_factory, objects) -> Iterator[Served]:
    settings = {"COW_ARTIFACTS": objects.url, **objects.environment, **SETTINGS}
    # Readiness is asked without a key; everything else is Alice's.
    folder = tmp_path_factory.mktemp("redirecting")
    with Served(folder, **settings) as one, as_caller(one, KEYS["alice"]) as caller:
        yield caller


def simulated(served: Served, body: dict, **headers: str) -> dict:
    response = served.http.post("/simulate", json=body, headers=headers)
    assert response.status_code == 200, response.text
    return response.json()


def test_a_job_takes_few_requests_of_the_store(served, objects):
    objects.requests.clear()
    simulation = simulated(served, WITH_VIDEO)
    # The image, the mask, three frames, the overlay and the video; nothing is asked for before it is sent.
    # Each process looks at most every two seconds whether the store is there, which is a PUT and a GET.
    assert objects.requests["PUT"] - objects.requests["GET"] <= 7, objects.requests
    assert objects.requests.total() - objects.requests["PUT"] - objects.requests["GET"] <= 4, objects.requests
    kept = {simulation["video"]["sha256"], *(frame["sha256"] for frame in simulation["frames"])}
    assert kept < objects.names()
    assert not [*served.data.rglob("*.png"), *served.data.rglob("*.mp4"), *served.data.rglob("*.part")]


def test_callers_are_sent_to_the_store(served, objects):
    video = simulated(served, WITH_VIDEO)["video"]
    sent = served.http.get(video["url"], headers={"Range": "bytes=0-99"})
    assert sent.status_code == 307
    assert sent.headers["cache-control"] == "private, max-age=600"
    assert sent.headers["location"].startswith(objects.endpoint)
    part = httpx.get(sent.headers["location"], headers={"Range": "bytes=0-99"})
    assert (part.status_code, len(part.content), part.headers["content-type"]) == (206, 100, "video/mp4")
    whole = served.http.get(video["url"], follow_redirects=True).content
    assert hashlib.sha256(whole).hexdigest() == video["sha256"]
    outside = served.http.get(video["url"], headers={"Range": f"bytes={len(whole)}-"})
    assert outside.status_code == 307, "the store itself says that it lies outside"
    head = served.http.head(video["url"])
    assert (head.status_code, head.headers["content-length"]) == (200, str(len(whole)))
    assert served.http.get(video["url"], headers={"If-None-Match": f'"{video["sha256"]}"'}).status_code == 304
    # Ownership is checked first: other callers are not redirected.
    with as_caller(served, KEYS["bob"]) as bob:
        problem(bob.http.get(video["url"]), 404, "artifact-not-found")


def test_what_is_damaged_is_made_again(served, objects):
    image = hashlib.sha256(IMAGE).hexdigest()
    first = simulated(served, BODY)
    frame = first["frames"][0]
    for sha256 in (image, frame["sha256"]):
        objects.damage(sha256)
    again = simulated(served, BODY)
    assert again["frames"] == first["frames"]
    assert "generation" not in again["reused"]
    for sha256 in (image, frame["sha256"]):
        found = served.http.get(f"/artifacts/{sha256}", follow_redirects=True)
        assert hashlib.sha256(found.content).hexdigest() == sha256


def test_a_store_that_is_away_for_a_while_is_waited_for(served, objects):
    """Jobs wait for it; callers are told."""
    simulated(served, slow(0.1, seed=77))
    job = served.submit(slow(0.5, seed=77))  # whose frames are there: the store is asked whether they still are
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(served.http.post, "/simulate", json=slow(5, seed=78))
        eventually(lambda: served.clips().count(77) == 2 and 78 in served.clips())
        objects.stop()
        try:
            told = call.result()  # while the store is still away
            problem(told, 503, "storage-unavailable")
            eventually(lambda: served.http.get("/readyz").status_code == 503)
            problem(served.http.post("/simulate", json=BODY), 503, "storage-unavailable")
            eventually(lambda: "a job waits" in served.log())
            waits = told.headers["location"].removeprefix("/jobs/")
            assert served.job(waits)["status"] == "running"
        finally:
            objects.start()
    waited = served.ended(waits)
    assert (served.ended(job["id"])["status"], waited["status"]) == ("succeeded", "succeeded")
    assert (served.clips().count(77), served.clips().count(78)) == (2, 1), "no clip is made again for an outage"


def test_another_server_passes_the_bytes_on(served, objects, tmp_path):
    """It shares only the store with the first one, and is set not to redirect."""
    video = simulated(served, {**WITH_VIDEO, "seed": 3})["video"]
    settings = {"COW_ARTIFACTS": objects.url, "COW_ARTIFACTS_REDIRECT": "false", **objects.environment}
    with Served(tmp_path, **settings) as other:
        whole = other.http.get(video["url"])
        assert (whole.status_code, whole.headers["content-type"]) == (200, "video/mp4")
        assert hashlib.sha256(whole.content).hexdigest() == video["sha256"]
        part = other.http.get(video["url"], headers={"Range": "bytes=10-19"})
        assert (part.status_code, part.content) == (206, whole.content[10:20])
        objects.damage(video["sha256"], "video/mp4")
        problem(other.http.get(video["url"]), 404, "artifact-not-found")
        image = hashlib.sha256(IMAGE).hexdigest()
        assert simulated(other, {**BODY, "image": {"artifact": image}})["frames"]
        assert not list(other.data.rglob("*.part"))
