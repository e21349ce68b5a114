"""Artifacts on a real disk: named by content, written whole or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from refusals import refused

from cow_service.jobs.engine import JobEngine
from cow_service.media.artifacts import MEDIA_TYPES, DiskArtifacts
from cow_service.readers.mllm.known import MllmNotes
from cow_service.records import ServerCapabilities
from cow_service.service import Service
from cow_service.settings import Settings

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
def test_what_is_put_is_found_by_this_store_and_another(store, folder, media_type, extension):
    artifact = store.put(DATA, media_type)
    assert artifact.model_dump() == {
        "sha256": SHA256, "url": f"/artifacts/{SHA256}", "media_type": media_type, "size": len(DATA)
    }  # fmt: skip
    for found in (store, DiskArtifacts(folder)):
        assert found.get(SHA256) == artifact
        assert found.read(SHA256) == DATA
        assert path_of(found, SHA256) == folder / SHA256[:2] / f"{SHA256}.{extension}"
    assert files(folder) == [f"{SHA256[:2]}/{SHA256}.{extension}"]


@pytest.mark.parametrize("damage", [DATA[:-1], DATA[:-1] + b"x", b""], ids=["shorter", "changed", "empty"])
@pytest.mark.parametrize("started_anew", [False, True])
def test_what_is_damaged_is_not_handed_out_and_heals(store, folder, damage, started_anew):
    path = path_of(store, store.put(DATA, "image/png").sha256)
    path.write_bytes(damage)
    if started_anew:
        store = DiskArtifacts(folder)
    with refused("artifact-not-found"):
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


def test_a_second_put_keeps_the_first_media_type_and_says_that_it_is_needed(store, folder):
    first = store.put(DATA, "video/mp4")
    path = path_of(store, SHA256)
    os.utime(path, (1000, 1000))
    number = path.stat().st_ino
    assert store.put(DATA, "image/png") == first == store.get(SHA256)
    assert path.stat().st_ino == number
    assert path.stat().st_mtime > 1000
    assert len(files(folder)) == 1


def test_an_unknown_media_type_is_a_programming_error(store, folder):
    with pytest.raises(ValueError, match="image/gif"):
        store.put(DATA, "image/gif")
    assert not folder.exists()


@pytest.mark.parametrize(
    "name", ["", "abc", SHA256.upper(), SHA256 + "\n", SHA256 + "0", "../" * 21 + "x", "\0" * 64, "\u0660" * 64]
)
def test_what_is_no_digest_never_reaches_the_disk(store, monkeypatch, name):
    store.put(DATA, "image/png")
    monkeypatch.setattr(Path, "stat", failing(errno.EIO))
    with refused("artifact-not-found"):
        store.get(name)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EACCES])
def test_what_the_disk_refuses_is_told_without_its_path_and_leaves_nothing(store, folder, monkeypatch, number):
    monkeypatch.setattr(os, "fsync", failing(number))
    for call in (lambda: store.put(DATA, "image/png"), store.check):
        with refused("storage-unavailable") as caught:
            call()
        assert ("full" in caught.value.detail) == (number != errno.EACCES)
        assert "/" not in caught.value.detail
    assert files(folder) == []


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
    with refused("artifact-not-found"):
        store.touch(loose.sha256)


def test_temporary_files_of_processes_that_were_killed_go(store, folder):
    left, young = folder / ".a.part", folder / ".b.part"
    with store.scratch() as path:
        assert path.parent == folder
        for file in (left, young, path):
            file.write_bytes(b"")
        os.utime(left, (1000, 1000))
        store.remove_leftovers(1000)
        assert files(folder) == sorted([young.name, path.name])
    assert files(folder) == [young.name]


def test_a_folder_has_one_name_for_all_processes(store, folder, tmp_path):
    assert store.address == DiskArtifacts(folder).address != DiskArtifacts(tmp_path / "other").address


def test_what_is_kept_is_for_its_own_user_alone(tmp_path: Path) -> None:
    """A folder of before keeps its mode."""
    before = tmp_path / "before"
    before.mkdir(mode=0o755)
    for folder in (tmp_path / "new" / "data", before):
        settings = Settings(data_dir=folder, mllm="openai:gpt-5")
        with Service(settings) as service:
            engine = JobEngine(service)
            engine.start()
            service.artifacts.put(b"\x89PNG\r\n\x1a\n", "image/png")
            with service.artifacts.scratch() as scratch:
                MllmNotes(settings.data_dir, "server", "m").keep(ServerCapabilities())
                kept = {path: stat.filemode(path.stat().st_mode) for path in folder.rglob("*")}
            engine.close()
        assert {scratch, settings.data_dir / "jobs.sqlite3-wal"} <= kept.keys()
        assert set(kept.values()) == {"drwx------", "-rw-------"}, kept
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o700
    assert stat.S_IMODE(before.stat().st_mode) == 0o755
