"""Artifacts on a real S3 server: what the store does, and a server. The store in a folder is tested in `media`."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import numpy as np
import pytest
from callers import as_caller, new_keys
from job_rows import add_job, open_database
from refusals import refused
from servers import BODY, IMAGE, Served, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.jobs.database import StoredResult
from cow_service.jobs.job_table import JobTable
from cow_service.media.artifacts import ArtifactStore
from cow_service.service import open_artifact_store
from cow_service.settings import Settings, SettingsError, load_settings

if TYPE_CHECKING:
    from object_store import ObjectStore

pytestmark = pytest.mark.slow

DATA = b"frame" * 1000
SHA256 = hashlib.sha256(DATA).hexdigest()
LONG = 10 * 3600.0  # seconds: more than any grace
WITH_VIDEO = {**BODY, "video": True, "frames": {"policy": "initial", "count": 3}}
SETTINGS, KEYS = new_keys("alice", "bob")


@pytest.fixture(scope="module")
def s3() -> Iterator[ObjectStore]:
    from object_store import serving

    with serving() as server:
        yield server


@pytest.fixture
def objects(s3, monkeypatch) -> ObjectStore:
    for name, value in s3.environment.items():
        monkeypatch.setenv(name, value)
    for name in s3.names():
        s3.remove(name)
    s3.requests.clear()
    return s3


@pytest.fixture
def store(objects, tmp_path) -> ArtifactStore:
    return open_artifact_store(Settings(data_dir=tmp_path, artifacts=objects.url))


def test_what_is_put_is_found_and_read(store):
    artifact = store.put(DATA, "image/jpeg")
    record = {"sha256": SHA256, "url": f"/artifacts/{SHA256}", "media_type": "image/jpeg", "size": len(DATA)}
    assert artifact.model_dump() == record
    assert store.put(DATA, "image/jpeg") == store.get(SHA256) == artifact
    assert store.read(SHA256) == DATA
    with store.local_file(SHA256) as path:
        assert path.read_bytes() == DATA
    store.touch(SHA256)
    store.check()
    (listed,) = store.listed()
    assert (listed.sha256, listed.size) == (SHA256, len(DATA))
    assert abs(listed.used_at - time.time()) < 60


def test_a_batch_is_there_when_its_block_ends(store):
    """Each put follows the retry policy of its owner, also of what is known to be there."""
    done = []

    def retry(work):
        done.append(work())
        return done[-1]

    with store.batch(retry) as put:
        artifacts = [
            put(data, kind) for data, kind in ((b"ab", "image/png"), (b"ab", "image/png"), (b"cd", "video/mp4"))
        ]
        with pytest.raises(ValueError, match="image/gif"):
            put(DATA, "image/gif")
    assert sorted(each.sha256 for each in done) == sorted(each.sha256 for each in artifacts)
    assert [store.get(each.sha256) for each in artifacts] == artifacts


def test_what_is_not_there_is_refused(store):
    for call in (store.get, store.read, store.touch, lambda name: store.local_file(name).__enter__()):
        for name in (SHA256, "../" * 21 + "x", SHA256.upper()):
            with refused("artifact-not-found"):
                call(name)
    assert store.delete([SHA256], time.time() + LONG) == set()
    with pytest.raises(ValueError, match="image/gif"):
        store.put(DATA, "image/gif")


@pytest.mark.parametrize("known", [True, False], ids=["by its process", "by another process"])
def test_a_damaged_object_is_not_read_and_heals(objects, store, known):
    store.put(DATA, "image/png")
    objects.damage(SHA256)
    anew = store if known else open_artifact_store(Settings(artifacts=objects.url))
    with refused("artifact-not-found"):
        anew.touch(SHA256)
    assert SHA256 not in objects.names()
    objects.damage(SHA256)
    with refused("artifact-not-found"):
        anew.read(SHA256)
    objects.damage(SHA256)
    store.put(DATA, "image/png")
    assert anew.read(SHA256) == DATA


def test_each_call_takes_one_request(objects, store, monkeypatch):
    from cow_service.media import object_artifacts

    def took(call) -> dict[str, int]:
        objects.requests.clear()
        call()
        return dict(objects.requests)

    assert took(lambda: store.put(DATA, "image/png")) == {"PUT": 1}
    assert took(lambda: store.put(DATA, "image/png")) == {"HEAD": 1}
    assert took(lambda: store.touch(SHA256)) == {"HEAD": 1}
    assert took(lambda: store.read(SHA256)) == {"GET": 1}
    assert took(lambda: store.signed_url(SHA256, 10)) == {}
    # What is used again after a while is sent again: the store has no other way to say so.
    monkeypatch.setattr(object_artifacts, "RENEWED_AFTER_SECONDS", -60.0)
    assert took(lambda: store.touch(SHA256)) == {"HEAD": 1, "GET": 1, "PUT": 1}


def test_many_are_deleted_by_few_requests(objects, store, monkeypatch):
    monkeypatch.setattr("cow_service.media.object_artifacts.DELETED_TOGETHER", 3)
    names = [store.put(b"%d" % number, "image/png").sha256 for number in range(7)]
    assert store.delete(names, time.time() - LONG) == set(), "they were used since"
    objects.requests.clear()
    assert store.delete(names, time.time() + LONG) == set(names)
    assert objects.requests == {"HEAD": len(names), "POST": 3}
    assert objects.names() == set()


def test_what_another_process_deletes_first_harms_no_others(objects, store, monkeypatch):
    """Google and Azure answer that it is not there, and delete no others of the same request."""
    import obstore

    names, delete = [store.put(data, "image/png").sha256 for data in (b"a", b"b")], obstore.delete

    def fail(store, paths):
        if not isinstance(paths, str) or paths == names[0]:
            raise FileNotFoundError
        delete(store, paths)

    monkeypatch.setattr(obstore, "delete", fail)
    store.delete(names, time.time() + LONG)
    assert objects.names() == {names[0]}


def test_a_store_that_is_away_or_refuses_is_a_typed_error(objects, store, tmp_path, monkeypatch):
    objects.refuse_everybody()
    try:
        for call in (store.check, lambda: store.put(DATA, "image/png")):
            with refused("storage-unavailable") as caught:
                call()
            assert "testing" not in caught.value.detail
    finally:
        objects.accept_everybody()
    with refused("storage-unavailable"):
        open_artifact_store(Settings(data_dir=tmp_path, artifacts="s3://no-such-bucket")).check()
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    away = open_artifact_store(Settings(data_dir=tmp_path, artifacts=objects.url))

    def put_in_a_batch() -> None:
        with away.batch() as put:
            put(DATA, "image/png")

    for call in (away.check, lambda: away.touch(SHA256), lambda: list(away.listed()), put_in_a_batch):
        with refused("storage-unavailable"):
            call()


@pytest.mark.parametrize("place", ["s3://", "http://host/bucket", "s3://key:secret@bucket", "s3://bucket?x=secret"])
def test_what_is_no_place_is_refused_and_not_repeated(place):
    with pytest.raises(SettingsError, match="COW_ARTIFACTS") as caught:
        load_settings(artifacts=place)
    assert "secret" not in str(caught.value)


def test_an_account_that_is_missing_is_named(monkeypatch, tmp_path):
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    with pytest.raises(SettingsError, match="Account"):
        open_artifact_store(Settings(data_dir=tmp_path, artifacts="az://container"))


def test_the_file_of_the_database_gives_room_back(tmp_path: Path):
    jobs, noise = [f"job-{number}" for number in range(10)], np.random.default_rng(0)
    with closing(open_database(tmp_path)) as database:
        for job in jobs:
            digits = noise.integers(0, 10**9, 60_000).tobytes().hex()  # what is stored deflated stays large
            add_job(database, job)
            database.store_results(job, [StoredResult(job, "motion", digits, ())])
        database.give_room_back(lambda: False)
        file = tmp_path / "jobs.sqlite3"
        full = file.stat().st_size
        assert full > 3_500_000
        for job in jobs:
            JobTable(database).cancel(job)
        JobTable(database).delete(jobs)
        database.give_room_back(lambda: True)
        assert file.stat().st_size == full, "it was stopped"
        database.give_room_back(lambda: False)
        assert 1_900_000 < file.stat().st_size < 2_500_000, "some is kept for what is written next"


# --- a server ---


@pytest.fixture(scope="module")
def served(tmp_path_factory, s3) -> Iterator[Served]:
    settings = {"COW_ARTIFACTS": s3.url, **s3.environment, **SETTINGS}
    # Readiness is asked without a key; everything else is Alice's.
    folder = tmp_path_factory.mktemp("redirecting")
    with Served(folder, **settings) as one, as_caller(one, KEYS["alice"]) as caller:
        yield caller


def simulated(served: Served, body: dict, **headers: str) -> dict:
    response = served.http.post("/simulate", json=body, headers=headers)
    assert response.status_code == 200, response.text
    return response.json()


def test_callers_are_sent_to_the_store(served, objects):
    video = simulated(served, WITH_VIDEO)["video"]
    sent = served.http.get(video["url"], headers={"Range": "bytes=0-99"})
    assert sent.status_code == 307
    assert sent.headers["cache-control"] == "private, max-age=600"
    assert sent.headers["location"].startswith(objects.endpoint)
    part = httpx.get(sent.headers["location"], headers={"Range": "bytes=0-99"}, timeout=TIME_LIMIT)
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
