"""What every artifact store does, on a real disk and on a real S3 server."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import object_store
import obstore
import pytest
from job_rows import add_job

from cow_service.errors import ArtifactNotFound, StorageUnavailable
from cow_service.jobs.database import Database, StoredResult
from cow_service.jobs.job_table import JobTable
from cow_service.jobs.maintenance import collect_artifacts
from cow_service.media import object_artifacts
from cow_service.media.artifacts import ArtifactStore
from cow_service.service import Service, open_artifact_store
from cow_service.settings import Settings, SettingsError, load_settings

pytestmark = pytest.mark.slow

DATA = b"frame" * 1000
SHA256 = hashlib.sha256(DATA).hexdigest()
LONG = 10 * 3600.0  # seconds: more than any grace


@pytest.fixture(scope="module")
def server() -> Iterator[object_store.ObjectStore]:
    with object_store.serving() as server:
        yield server


@pytest.fixture
def objects(server, monkeypatch) -> object_store.ObjectStore:
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    for name in server.names():
        server.remove(name)
    server.requests.clear()
    return server


@pytest.fixture(params=["disk", "objects"])
def settings(request, tmp_path) -> Settings:
    if request.param == "disk":
        return Settings(data_dir=tmp_path, artifacts=str(tmp_path / "elsewhere"))
    return Settings(data_dir=tmp_path, artifacts=request.getfixturevalue("objects").url)


@pytest.fixture
def store(settings) -> ArtifactStore:
    return open_artifact_store(settings)


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


def test_nothing_stays_behind(store, settings):
    with store.scratch() as path:
        path.write_bytes(DATA)
    assert not list(settings.data_dir.rglob("*.part"))


def test_what_a_killed_process_left_goes_after_a_while(store, settings):
    with store.scratch() as path:
        path.write_bytes(DATA)
        store.remove_leftovers(time.time() - LONG)
        assert path.exists()
        store.remove_leftovers(time.time() + LONG)
        assert not list(settings.data_dir.rglob("*.part"))


def test_every_put_of_a_batch_follows_the_retry_policy_of_its_owner(store):
    done = []

    def retry(work):
        done.append(work())
        return done[-1]

    with store.batch(retry) as put:
        first = put(DATA, "image/png")
        put(DATA, "image/png")  # one that is known to be there is asked for with the same policy
        clip = put(DATA * 2, "video/mp4")
    assert sorted(each.sha256 for each in done) == sorted(each.sha256 for each in (first, first, clip))


def test_a_batch_is_there_when_its_block_ends(store):
    with store.batch() as put:
        artifacts = [put(name.encode() * 500, "image/png") for name in ("ab", "cd", "ef")]
        with pytest.raises(ValueError, match="'image/gif' is not supported"):
            put(DATA, "image/gif")
    assert [store.get(each.sha256) for each in artifacts] == artifacts


def test_what_is_not_there_is_named(store):
    for call in (store.get, store.read, store.touch, lambda name: store.local_file(name).__enter__()):
        for name in (SHA256, "../" * 21 + "x", SHA256.upper()):
            with pytest.raises(ArtifactNotFound, match=r"send the image again|64 lower-case hex digits"):
                call(name)
    assert store.delete([SHA256], time.time() + LONG) == set()
    with pytest.raises(ValueError, match="'image/gif' is not supported"):
        store.put(DATA, "image/gif")


def test_it_is_deleted_unless_it_was_used(store):
    store.put(DATA, "image/png")
    assert store.delete([SHA256], time.time() - LONG) == set()
    assert store.delete([SHA256], time.time() + LONG) == {SHA256}
    assert list(store.listed()) == []


def test_processes_that_share_a_store_give_it_the_same_name(settings, tmp_path):
    address = open_artifact_store(settings).address
    assert open_artifact_store(settings).address == address
    other = settings.model_copy(update={"artifacts": None})
    assert open_artifact_store(other).address != address
    assert str(tmp_path) not in address


@pytest.mark.parametrize("known", [True, False], ids=["by its process", "by another process"])
def test_a_damaged_object_is_not_read_and_heals(objects, store_of_objects, known):
    store = store_of_objects
    store.put(DATA, "image/png")
    objects.damage(SHA256)
    anew = store if known else open_artifact_store(Settings(artifacts=objects.url))
    with pytest.raises(ArtifactNotFound):
        anew.touch(SHA256)
    assert SHA256 not in objects.names()
    objects.damage(SHA256)
    with pytest.raises(ArtifactNotFound):
        anew.read(SHA256)
    objects.damage(SHA256)
    store.put(DATA, "image/png")
    assert anew.read(SHA256) == DATA


@pytest.fixture
def store_of_objects(objects, tmp_path) -> ArtifactStore:
    return open_artifact_store(Settings(data_dir=tmp_path, artifacts=objects.url))


def test_each_call_takes_one_request(objects, store_of_objects, monkeypatch):
    store = store_of_objects

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


def test_many_are_deleted_by_few_requests(objects, store_of_objects):
    together = object_artifacts.DELETED_TOGETHER
    names = [store_of_objects.put(b"%d" % number, "image/png").sha256 for number in range(2 * together + 1)]
    objects.requests.clear()
    assert store_of_objects.delete(names, time.time() + LONG) == set(names)
    assert objects.requests == {"HEAD": len(names), "POST": 3}
    assert objects.names() == set()


def test_what_another_process_deletes_first_harms_no_others(objects, store_of_objects, monkeypatch):
    """Google and Azure answer that it is not there, and delete no others of the same request."""
    names, delete = [store_of_objects.put(data, "image/png").sha256 for data in (b"a", b"b")], obstore.delete

    def fail(store, paths):
        if not isinstance(paths, str) or paths == names[0]:
            raise FileNotFoundError
        delete(store, paths)

    monkeypatch.setattr(obstore, "delete", fail)
    store_of_objects.delete(names, time.time() + LONG)
    assert objects.names() == {names[0]}


def test_a_store_that_is_away_or_refuses_is_a_typed_error(objects, store_of_objects, tmp_path, monkeypatch):
    objects.refuse_everybody()
    try:
        for call in (store_of_objects.check, lambda: store_of_objects.put(DATA, "image/png")):
            with pytest.raises(StorageUnavailable, match="refuses the credentials") as caught:
                call()
            assert "testing" not in caught.value.detail
    finally:
        objects.accept_everybody()
    absent = open_artifact_store(Settings(data_dir=tmp_path, artifacts="s3://no-such-bucket"))
    with pytest.raises(StorageUnavailable, match="no such bucket"):
        absent.check()
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    away = open_artifact_store(Settings(data_dir=tmp_path, artifacts=objects.url))

    def put_in_a_batch() -> None:
        with away.batch() as put:
            put(DATA, "image/png")

    for call in (away.check, lambda: away.touch(SHA256), lambda: list(away.listed()), put_in_a_batch):
        with pytest.raises(StorageUnavailable, match="object store of COW_ARTIFACTS cannot be used"):
            call()


@pytest.mark.parametrize("place", ["s3://", "http://host/bucket", "s3://key:secret@bucket", "s3://bucket?x=secret"])
def test_what_is_no_place_is_refused_and_not_repeated(place):
    with pytest.raises(SettingsError, match=r"COW_ARTIFACTS must be a folder, or s3://BUCKET/PREFIX") as caught:
        load_settings(artifacts=place)
    assert "secret" not in str(caught.value)


def test_an_account_that_is_missing_is_named(monkeypatch, tmp_path):
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    with pytest.raises(SettingsError, match="Account must be specified"):
        open_artifact_store(Settings(data_dir=tmp_path, artifacts="az://container"))


def test_beyond_the_budget_the_oldest_go_first(settings, monkeypatch):
    """None of an open job, and none that was used a moment ago."""
    settings = settings.model_copy(update={"artifacts_max_gb": 2500 / 1e9})
    with Service(settings) as service:
        database = Database(settings)
        database.create_tables()
        store = service.artifacts
        kept = {name: store.put(name.encode() * 500, "image/png").sha256 for name in ("ab", "cd", "ef", "gh")}
        for name, sha256 in kept.items():
            add_job(database, f"job-{name}")
            database.reuse_result(f"job-{name}", "generation", [sha256])
            if name != "ab":
                JobTable(database).cancel(f"job-{name}")
        # An object store reports times of its own clock, in whole seconds: here they are set.
        ages = dict(zip(kept.values(), (4000, 3000, 2000, 1000), strict=True))
        listed, now = [*store.listed()], time.time()
        aged = [type(one)(one.sha256, one.size, now - ages[one.sha256]) for one in listed]
        monkeypatch.setattr(store, "listed", lambda: iter(aged))
        collect_artifacts(service, database, lambda: False, now=now)
        assert {one.sha256 for one in listed if _is_there(store, one.sha256)} == set(kept.values())  # used just now
        collect_artifacts(service, database, lambda: False, now=now + LONG)
        left = {name for name, sha256 in kept.items() if _is_there(store, sha256)}
        assert left == {"ab", "gh"}


def _is_there(store: ArtifactStore, sha256: str) -> bool:
    try:
        return bool(store.get(sha256))
    except ArtifactNotFound:
        return False


def test_the_file_of_the_database_gives_room_back(tmp_path: Path):
    database = Database(Settings(data_dir=tmp_path))
    database.create_tables()
    jobs, noise = [f"job-{number}" for number in range(40)], np.random.default_rng(0)
    for job in jobs:
        digits = noise.integers(0, 10**9, 60_000).tobytes().hex()  # what is stored deflated stays large
        add_job(database, job)
        key = hashlib.sha256(job.encode()).hexdigest()
        database.store_results(job, [StoredResult(key, "motion", digits, ())])
    database.give_room_back(lambda: False)
    file = tmp_path / "jobs.sqlite3"
    full = file.stat().st_size
    assert full > 10_000_000
    JobTable(database).delete(jobs)
    database.give_room_back(lambda: False)
    assert file.stat().st_size < full / 4
    database.close()
