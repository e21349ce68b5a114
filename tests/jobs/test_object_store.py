"""Real servers that keep their artifacts on a real S3 server, and share no folder."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import object_store
import pytest
from servers import BODY, IMAGE, Served, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.api.middleware.access import hash_of, new_key
from cow_service.client import Client
from cow_service.client.errors import ServerUnreachable

pytestmark = pytest.mark.slow

WITH_VIDEO = {**BODY, "video": True, "frames": {"policy": "initial", "count": 3}}


@pytest.fixture(scope="module")
def objects() -> Iterator[object_store.ObjectStore]:
    with object_store.serving() as objects:
        yield objects


@pytest.fixture(scope="module")
def keys() -> dict[str, str]:
    return {name: new_key() for name in ("alice", "bob")}


@pytest.fixture(scope="module")
def served(tmp_path_factory, objects, keys) -> Iterator[Served]:
    hashes = json.dumps({name: hash_of(key) for name, key in keys.items()})
    settings = {"COW_ARTIFACTS": objects.url, **objects.environment}
    # Readiness is asked without a key; everything else is Alice's.
    with Served(tmp_path_factory.mktemp("redirecting"), COW_WORKERS="true", COW_API_KEYS=hashes, **settings) as one:
        one.http.headers["Authorization"] = f"Bearer {keys['alice']}"
        yield one


def simulated(served: Served, body: dict, **headers: str) -> dict:
    response = served.http.post("/simulate", json=body, headers=headers)
    assert response.status_code == 200, response.text
    return response.json()


def test_a_job_takes_few_requests_of_the_store(served, objects):
    objects.requests.clear()
    simulation = simulated(served, WITH_VIDEO)
    # The image, the mask, three frames, the overlay and the video; nothing is asked for before it is sent.
    assert objects.requests["PUT"] <= 8, objects.requests
    assert objects.requests.total() - objects.requests["PUT"] <= 4, objects.requests
    kept = {simulation["video"]["sha256"], *(frame["sha256"] for frame in simulation["frames"])}
    assert kept < objects.names()
    assert not [*served.data.rglob("*.png"), *served.data.rglob("*.mp4"), *served.data.rglob("*.part")]


def test_callers_are_sent_to_the_store(served, objects, keys):
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
    others = {"Authorization": f"Bearer {keys['bob']}"}
    problem(served.http.get(video["url"], headers=others), 404, "artifact-not-found")


def test_the_sdk_follows_and_keeps_its_key_to_itself(served, objects, keys):
    requests: list[httpx.Request] = []
    hooks = {"request": [requests.append]}
    with httpx.Client(event_hooks=hooks, timeout=TIME_LIMIT) as http:
        client = Client(str(served.http.base_url), api_key=keys["alice"], http_client=http)
        sha256 = simulated(served, BODY)["frames"][0]["sha256"]
        assert hashlib.sha256(client.artifact(sha256)).hexdigest() == sha256
    asked, followed = requests
    assert asked.headers["authorization"] == f"Bearer {keys['alice']}"
    assert str(followed.url).startswith(objects.endpoint)
    assert keys["alice"] not in str(followed.url) + str(followed.headers)
    assert "authorization" not in followed.headers


def test_the_sdk_says_that_the_store_cannot_be_reached():
    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.host == "store":
            raise httpx.ConnectError("refused", request=request)
        return httpx.Response(307, headers={"Location": "http://store/bucket/x?signature=secret"})

    with httpx.Client(transport=httpx.MockTransport(answer)) as http:
        client = Client("http://server:80", http_client=http, retries=0)
        with pytest.raises(ServerUnreachable, match="COW_ARTIFACTS_REDIRECT=false") as caught:
            client.artifact("0" * 64)
    assert "secret" not in caught.value.detail


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
    simulated(served, slow(0.1, seed=77))
    job = served.submit(slow(1.0, seed=77))  # whose frames are there: the store is asked whether they still are
    served.rendering(job["id"])
    objects.stop()
    try:
        eventually(lambda: served.http.get("/readyz").status_code == 503)
        problem(served.http.post("/simulate", json=BODY), 503, "storage-unavailable")
        time.sleep(2)  # the clip is done meanwhile, and cannot be sent
        assert served.job(job["id"])["status"] == "running"
    finally:
        objects.start()
    assert served.ended(job["id"])["status"] == "succeeded"
    assert served.clips().count(77) == 2, "no clip is made again for an outage"


def test_who_waits_for_a_job_is_told_that_the_store_is_away(served, objects):
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(served.http.post, "/simulate", json=slow(1.0, seed=78))
        eventually(lambda: 78 in served.clips())
        objects.stop()
        try:
            told = call.result(60)  # while the store is still away
        finally:
            objects.start()
    problem(told, 503, "storage-unavailable")
    assert "The job continues" in told.json()["detail"]
    assert served.ended(told.headers["location"].removeprefix("/jobs/"))["status"] == "succeeded"


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


def test_a_server_that_may_not_use_the_store_says_so_and_ends(objects, tmp_path):
    command = [sys.executable, "-m", "cow_service.cli.main", "serve", "--port", "0"]
    place = {"COW_DATA_DIR": str(tmp_path), "COW_ARTIFACTS": "s3://no-such-bucket/cow"}
    ended = subprocess.run(
        command, env=objects.environment | place, capture_output=True, text=True, timeout=TIME_LIMIT, check=False
    )
    assert ended.returncode != 0
    assert "there is no such bucket" in ended.stderr
    assert objects.environment["AWS_SECRET_ACCESS_KEY"] not in ended.stderr + ended.stdout


def test_servers_of_one_database_have_one_store(served, objects, tmp_path):
    settings = {"COW_ARTIFACTS": objects.url + "/elsewhere", "COW_DATA_DIR": str(served.data), **objects.environment}
    command = [sys.executable, "-m", "cow_service.cli.main", "serve", "--port", "0"]
    ended = subprocess.run(command, env=settings, capture_output=True, text=True, timeout=TIME_LIMIT, check=False)
    assert ended.returncode != 0
    assert f"have their images in {objects.url}" in ended.stderr.replace("\n", " ")
