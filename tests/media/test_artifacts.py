"""Artifacts on a real disk: named by content, written whole or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cow_service.errors import ArtifactNotFound, StorageUnavailable
from cow_service.media.artifacts import MEDIA_TYPES, DiskArtifacts

DATA = b"frame" * 1000
SHA256 = hashlib.sha256(DATA).hexdigest()


@pytest.fixture
def folder(tmp_path) -> Path:
    return tmp_path / "data" / "artifacts"


@pytest.fixture
def store(folder) -> DiskArtifacts:
    return DiskArtifacts(folder)


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def path_of(store: DiskArtifacts, sha256: str) -> Path:
    with store.local_file(sha256) as path:
        return path


def failing(number: int):
    def fail(*_arguments, **_options):
        raise OSError(number, os.strerror(number), "/secret/path")

    return fail


@pytest.mark.parametrize(("media_type", "extension"), MEDIA_TYPES.items())
def test_put_get_read(store, folder, media_type, extension):
    artifact = store.put(DATA, media_type)
    assert artifact.model_dump() == {
        "sha256": SHA256,
        "url": f"/artifacts/{SHA256}",
        "media_type": media_type,
        "size": len(DATA),
    }
    assert store.get(SHA256) == artifact
    with store.local_file(SHA256) as path:
        assert path == folder / SHA256[:2] / f"{SHA256}.{extension}"
    assert store.read(SHA256) == DATA
    assert files(folder) == [f"{SHA256[:2]}/{SHA256}.{extension}"]


@pytest.mark.parametrize("damage", [DATA[:-1], DATA[:-1] + b"x", b""], ids=["shorter", "changed", "empty"])
@pytest.mark.parametrize("started_anew", [False, True])
def test_what_is_damaged_is_not_handed_out_and_heals(store, folder, damage, started_anew):
    path = path_of(store, store.put(DATA, "image/png").sha256)
    path.write_bytes(damage)
    if started_anew:
        store = DiskArtifacts(folder)
    with pytest.raises(ArtifactNotFound):
        store.get(SHA256)
    assert files(folder) == []
    path.write_bytes(damage)
    assert store.put(DATA, "image/png").size == len(DATA)
    assert store.read(SHA256) == DATA


def test_bytes_are_compared_once(store, folder, monkeypatch):
    store.put(DATA, "image/png")
    anew, compared = DiskArtifacts(folder), []
    whole = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda *given: compared.append(1) or whole(*given))
    for _ in range(3):
        anew.touch(SHA256)
        assert anew.read(SHA256) == DATA
    assert len(compared) == 1


def test_no_bytes_are_an_artifact_too(store):
    assert store.read(store.put(b"", "application/json").sha256) == b""


def test_a_second_put_changes_nothing_but_says_that_it_is_needed(store, folder):
    first = store.put(DATA, "image/png")
    before = path_of(store, SHA256).stat()
    assert store.put(DATA, "image/png") == first
    after = path_of(store, SHA256).stat()
    assert (before.st_ino, before.st_size) == (after.st_ino, after.st_size)
    assert before.st_mtime_ns <= after.st_mtime_ns
    assert len(files(folder)) == 1


def test_the_first_media_type_stays(store, folder):
    store.put(DATA, "video/mp4")
    assert store.put(DATA, "image/png").media_type == "video/mp4"
    assert store.get(SHA256).media_type == "video/mp4"
    assert len(files(folder)) == 1


def test_another_store_on_the_same_folder_finds_it(store, folder):
    artifact = store.put(DATA, "image/jpeg")
    assert DiskArtifacts(folder).get(SHA256) == artifact


def test_an_unknown_media_type_is_a_programming_error(store, folder):
    with pytest.raises(ValueError, match="'image/gif' is not supported: use one of image/png"):
        store.put(DATA, "image/gif")
    assert not folder.exists()


def test_an_absent_digest_is_named(store):
    with pytest.raises(ArtifactNotFound, match=SHA256) as caught:
        store.get(SHA256)
    assert caught.value.code == "artifact-not-found"
    with pytest.raises(ArtifactNotFound):
        store.read(SHA256)


@pytest.mark.parametrize(
    "name", ["", "abc", SHA256.upper(), SHA256 + "\n", SHA256 + "0", "../" * 21 + "x", "\0" * 64, "\u0660" * 64]
)
def test_what_is_no_digest_never_reaches_the_disk(store, monkeypatch, name):
    store.put(DATA, "image/png")
    monkeypatch.setattr(Path, "stat", failing(errno.EIO))
    with pytest.raises(ArtifactNotFound, match="64 lower-case hex digits"):
        store.get(name)


def test_a_long_name_is_cut_in_the_message(store):
    with pytest.raises(ArtifactNotFound) as caught:
        store.get("x" * 100_000)
    assert len(caught.value.detail) < 200


def test_a_half_written_file_is_never_found(store, folder, monkeypatch):
    monkeypatch.setattr(os, "fsync", failing(errno.EIO))
    with pytest.raises(StorageUnavailable):
        store.put(DATA, "image/png")
    assert files(folder) == []
    with pytest.raises(ArtifactNotFound):
        store.get(SHA256)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_named(store, folder, monkeypatch, number):
    monkeypatch.setattr(os, "fsync", failing(number))
    with pytest.raises(StorageUnavailable, match=r"disk of the data folder is full: free some space") as caught:
        store.put(DATA, "image/png")
    assert "/" not in caught.value.detail
    assert isinstance(caught.value.__cause__, OSError)
    with pytest.raises(StorageUnavailable, match="full"):
        store.check()
    assert files(folder) == []


def test_a_file_where_the_folder_should_be(tmp_path):
    blocked = tmp_path / "data"
    blocked.write_bytes(b"")
    store = DiskArtifacts(blocked)
    for call in (
        store.check,
        lambda: store.put(DATA, "image/png"),
        lambda: store.get(SHA256),
        lambda: store.read(SHA256),
    ):
        with pytest.raises(StorageUnavailable, match="data folder cannot be used") as caught:
            call()
        assert caught.value.code == "storage-unavailable"
        assert str(tmp_path) not in caught.value.detail


def test_a_folder_that_may_not_be_written(store, folder, monkeypatch):
    monkeypatch.setattr(Path, "mkdir", failing(errno.EACCES))
    with pytest.raises(StorageUnavailable, match=r"Permission denied") as caught:
        store.check()
    assert "/" not in caught.value.detail


def test_check_leaves_nothing_behind(store, folder):
    store.check()
    store.check()
    assert files(folder) == []


def test_a_folder_that_is_removed_is_made_again(store, folder):
    store.put(DATA, "image/png")
    shutil.rmtree(folder)
    with pytest.raises(ArtifactNotFound):
        store.get(SHA256)
    store.put(DATA, "image/png")
    assert store.read(SHA256) == DATA


def test_the_same_bytes_from_many_threads(store, folder):
    media_types = list(MEDIA_TYPES) * 8
    with ThreadPoolExecutor(8) as pool:
        artifacts = list(pool.map(lambda media_type: store.put(DATA, media_type), media_types))
    assert len(set(artifacts)) == 1
    assert len(files(folder)) == 1


def test_what_nobody_needs_any_more_goes(store, folder):
    kept, loose = store.put(DATA, "image/png"), store.put(b"other", "image/png")
    for artifact in (kept, loose):
        os.utime(path_of(store, artifact.sha256), (1000, 1000))
    listed = {one.sha256: one for one in store.listed()}
    assert {(each.size, each.used_at) for each in listed.values()} == {(len(DATA), 1000), (len(b"other"), 1000)}
    store.touch(kept.sha256)
    assert [one.sha256 for one in store.listed() if one.used_at <= 1000] == [loose.sha256]
    both = [kept.sha256, loose.sha256]
    assert store.delete(both, untouched_since=1000) == {loose.sha256}
    assert store.delete(both, untouched_since=1000) == set()
    assert store.read(kept.sha256) == DATA
    with pytest.raises(ArtifactNotFound):
        store.touch(loose.sha256)
