"""Weights: pulled from a real server that speaks like the hub, recorded, checked, and refused where they are wrong."""

from __future__ import annotations

import builtins
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hub import Blob, Hub, running
from refusals import refused
from typer.testing import CliRunner
from waiting import TIME_LIMIT, eventually

from cow_service.cli.main import app
from cow_service.errors import GeneratorUnavailable, install_line
from cow_service.settings import Settings
from cow_service.weights import repositories
from cow_service.weights.manifests import Manifest, Source, check_modules, load_manifests
from cow_service.weights.repositories import (
    Lock,
    check,
    download,
    folder_of,
    read_lock,
    ready,
    resolve,
    verify,
    weights_identity,
)

pytestmark = pytest.mark.slow

TOY = "acme/toy"
CONFIG = Blob(b'{"layers": 2}', lfs=False)
MODEL = Blob(bytes(range(256)) * 40)
VAE = Blob(b"vae" * 1000)
FILES = {"config.json": CONFIG, "model.safetensors": MODEL, "vae/model.safetensors": VAE, "README.md": Blob(b"Hello")}
SOURCE = Source(repository=TOY, files=("config.json", "*.safetensors"), licence="mit")


@pytest.fixture(autouse=True)
def _no_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HF_TOKEN", raising=False)


@pytest.fixture
def hub() -> Iterator[Hub]:
    with running() as hub:
        hub.commit(TOY, FILES)
        yield hub


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "weights"


def source(*files: str, repository: str = TOY) -> Source:
    return Source(repository=repository, files=files, licence="mit")


def manifest(*sources: Source) -> Manifest:
    parts = {f"part{index}": each for index, each in enumerate(sources)}
    return Manifest(name="toy", role="generator", summary="", licence="mit", sources=parts)


def pull(wanted: Source, folder: Path, hub: Hub, revision: str | None = None) -> Path:
    download([resolve(wanted, folder, revision, endpoint=hub.address)], folder, endpoint=hub.address)
    return folder_of(folder, wanted.repository)


def refusal(hub: Hub, folder: Path, wanted: Source = SOURCE, revision: str | None = None) -> str:
    """What a pull that fails says. It never holds a path of this machine."""
    with refused("weights-unavailable") as caught:
        pull(wanted, folder, hub, revision)
    assert wanted.repository in caught.value.detail
    assert str(folder.parent) not in caught.value.detail
    return caught.value.detail


def locked(folder: Path) -> Lock:
    lock = read_lock(folder, TOY)
    assert lock is not None
    return lock


def problems(wanted: Source, folder: Path, *, digests: bool = True) -> dict[str, str]:
    return {finding.file: finding.problem for finding in check(wanted, folder, digests)}


# --- pulling ---


def test_a_pull_brings_the_files_that_match_and_records_them(folder: Path) -> None:
    """A second one downloads nothing, and needs no hub."""
    with running() as hub:
        hub.commit(TOY, FILES | dict.fromkeys(("a.bin", "b.pth", "c/d.PT", "e.pkl", "f.ckpt"), Blob(b"\x80\x04.")))
        assert pull(SOURCE, folder, hub) == folder / "acme--toy"
        asked = list(hub.asked)
        pull(SOURCE, folder, hub)
        assert hub.asked == asked
        assert len(hub.listings) == 1
        pull(source("*"), folder.with_name("all"), hub)
        assert set(hub.asked) == set(FILES), "pickles are never taken"
        assert "'*.pth'" in refusal(hub, folder, source("config.json", "*.pth"))
    pull(SOURCE, folder, hub)
    for path in ("config.json", "model.safetensors", "vae/model.safetensors"):
        assert (folder / "acme--toy" / path).read_bytes() == FILES[path].data
    assert not (folder / "acme--toy" / "README.md").exists()
    assert Blob(b"hello\n").sha1 == "ce013625030ba8dba906f756967f9e9ca394464a", "as git says"
    lock = locked(folder)
    assert lock.revision == hub.main[TOY]
    assert [(file.path, file.size, file.algorithm, file.digest) for file in lock.files] == [
        ("config.json", len(CONFIG.data), "git-sha1", CONFIG.sha1),
        ("model.safetensors", len(MODEL.data), "sha256", MODEL.sha256),
        ("vae/model.safetensors", len(VAE.data), "sha256", VAE.sha256),
    ]
    assert check(SOURCE, folder) == ()
    assert verify(SOURCE, folder, "toy") == folder / "acme--toy"


def test_a_pull_that_was_killed_goes_on_with_its_revision(hub: Hub, folder: Path, tmp_path: Path) -> None:
    """Killed while a file comes: its first bytes are written, and the hub sends no more."""
    first = hub.main[TOY]
    hub.stall["vae/model.safetensors"] = 1000
    code = (
        "import sys; from pathlib import Path; from cow_service.weights.repositories import download, resolve; "
        "from cow_service.weights.manifests import Source; "
        "source, folder, hub = Source.model_validate_json(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]; "
        "download([resolve(source, folder, endpoint=hub)], folder, endpoint=hub)"
    )
    command = [sys.executable, "-c", code, SOURCE.model_dump_json(), str(folder), hub.address]
    with subprocess.Popen(command, env=os.environ | {"HF_HOME": str(tmp_path)}) as process:
        try:
            assert hub.stalled.wait(TIME_LIMIT)
            eventually(lambda: any(folder.rglob("*.incomplete")))
            assert "another pull" in refusal(hub, folder)
        finally:
            process.kill()
    left = set(folder.rglob("*.incomplete"))
    assert left
    assert problems(SOURCE, folder) == {"vae/model.safetensors": "missing"}
    hub.commit(TOY, FILES | {"vae/model.safetensors": Blob(b"newer")})
    before = len(hub.asked)
    pull(SOURCE, folder, hub)
    assert hub.asked[before:] == ["vae/model.safetensors"]
    assert locked(folder).revision == first
    assert check(SOURCE, folder) == ()
    assert not left & set(folder.rglob("*.incomplete"))


def test_sources_of_one_repository_share_its_folder_record_and_revision(hub: Hub, folder: Path) -> None:
    model, vae, readme = source("model.safetensors", "config.json"), source("vae/*", "config.json"), source("README.md")
    first = hub.main[TOY]
    pull(model, folder, hub)
    assert problems(vae, folder) == {"vae/*": "not-pulled"}
    hub.commit(TOY, FILES | {"vae/model.safetensors": Blob(b"newer")})
    for each in (vae, readme):
        pull(each, folder, hub)
    assert (folder / "acme--toy" / "vae" / "model.safetensors").read_bytes() == VAE.data
    assert hub.asked.count("config.json") == 1
    assert check(model, folder) == check(vae, folder) == ()
    changed = {"model.safetensors": Blob(b"newer"), "vae/model.safetensors": Blob(b"newer vae"), "config.json": CONFIG}
    hub.commit(TOY, changed)
    pull(model, folder, hub, "main")
    assert check(model, folder) == ()
    assert problems(vae, folder) == {"vae/model.safetensors": "wrong-size"}
    assert problems(readme, folder) == {"README.md": "not-pulled"}
    before = len(hub.asked)
    pull(model, folder, hub, first)
    assert hub.asked[before:] == ["model.safetensors"]
    assert (locked(folder).revision, check(model, folder)) == (first, ())


def test_pulls_planned_at_the_same_time_record_both(hub: Hub, folder: Path) -> None:
    model, vae = source("model.safetensors"), source("vae/*")
    downloads = [resolve(each, folder, endpoint=hub.address) for each in (model, vae)]
    for each in downloads:
        download([each], folder, endpoint=hub.address)
    assert check(model, folder) == check(vae, folder) == ()


# --- pulls that fail ---


@pytest.mark.parametrize(
    ("answers", "named"),
    [
        ({"/api/": (403, "GatedRepo")}, "granted"),
        ({"/api/": (401, "")}, "HTTP 401"),
        ({"/resolve/": (403, "")}, "HTTP 403"),
        ({"/storage/": (410, "")}, "HTTP 410"),
        ({"/resolve/": (404, "EntryNotFound")}, "a file"),
        ({"/api/": (200, "")}, "JSONDecodeError"),
    ],
)
def test_what_the_hub_refuses_is_told(hub: Hub, folder: Path, answers: dict[str, tuple[int, str]], named: str) -> None:
    hub.refused = answers
    assert named in refusal(hub, folder)
    assert not list(folder.rglob("*.safetensors"))


def test_bytes_that_are_not_those_listed_are_thrown_away(hub: Hub, folder: Path) -> None:
    hub.spoilt.add("model.safetensors")
    told, found = refusal(hub, folder), hashlib.sha256(MODEL.data[::-1]).hexdigest()
    assert all(each in told for each in ("model.safetensors", found, MODEL.sha256))
    assert problems(SOURCE, folder)["model.safetensors"] == "missing"


def test_what_is_not_there_is_told_and_changes_nothing(hub: Hub, folder: Path) -> None:
    assert "repository" in refusal(hub, folder, source("*", repository="acme/nothing"))
    assert "'v9'" in refusal(hub, folder, revision="v9")
    assert "'text/*'" in refusal(hub, folder, source("*.json", "text/*"))
    with running() as gone:
        pass
    assert "HF_ENDPOINT" in refusal(gone, folder)
    hub.commit(TOY, {"config.json": CONFIG, "huge.safetensors": Blob(b"", listed_size=2 * 10**18)})
    told = refusal(hub, folder)
    assert all(each in told for each in ("2000000000.0 GB", "COW_MODELS_DIR"))
    assert not hub.asked
    assert not list(folder.rglob("*.json"))


@pytest.mark.parametrize(
    "path",
    [
        *("../evil.json", "/evil.json", "a/../../evil.json", "a//evil.json", "..\\evil.json", "C:evil.json", "./x"),
        *("a\nb.json", "cow.lock.json", "COW.lock.json", ".cache/huggingface/x.json"),
    ],
)
def test_paths_that_lead_out_of_the_folder_or_are_the_downloads_own_are_refused(hub, folder, path) -> None:
    hub.commit(TOY, {path: Blob(b"evil"), "ok.json": CONFIG})
    assert repr(path) in refusal(hub, folder, source("*"))
    assert not hub.asked
    assert not folder.exists()


def test_a_folder_that_cannot_be_used(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "weights").write_text("")
    assert "Not a directory" in refusal(hub, tmp_path / "weights")
    assert not ready(manifest(SOURCE), tmp_path / "weights")
    (tmp_path / "other" / "acme--toy" / "config.json").mkdir(parents=True)
    assert "Is a directory" in refusal(hub, tmp_path / "other")


def test_what_is_not_installed_is_told_with_the_line_that_installs_it(hub, folder, monkeypatch) -> None:
    pull(SOURCE, folder, hub)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    pull(SOURCE, folder, hub)  # there is nothing to download
    with refused("weights-unavailable") as caught:
        pull(source("README.md"), folder, hub)
    assert install_line("wan") in caught.value.detail
    lacking = load_manifests()["ati"].model_copy(update={"modules": ("json", "no_such_module")})
    monkeypatch.setattr("cow_service.weights.manifests.find_manifest", {"ati": lacking}.get)
    with refused("generator-unavailable") as caught:
        check_modules("ati", GeneratorUnavailable)
    assert all(each in caught.value.detail for each in ("'ati'", "no_such_module", install_line("wan")))
    assert "json" not in caught.value.detail
    check_modules("unknown", GeneratorUnavailable)
    assert lacking.model_copy(update={"extra": None}).install_line() != install_line("wan")


def test_the_exceptions_that_have_reasons_exist() -> None:
    import huggingface_hub.errors

    transport = sys.modules[huggingface_hub.errors.HTTPError.__module__.split(".", maxsplit=1)[0]]
    for name, _, _ in repositories.REASONS:
        assert any(hasattr(home, name) for home in (huggingface_hub.errors, transport, builtins)), name


# --- checking ---


def test_what_was_changed_afterwards_is_found_and_mended(hub: Hub, folder: Path) -> None:
    assert problems(SOURCE, folder) == {"config.json": "not-pulled", "*.safetensors": "not-pulled"}
    assert ready(manifest(), folder)
    assert not ready(manifest(SOURCE), folder)
    pull(SOURCE, folder, hub)
    assert ready(manifest(SOURCE), folder)
    assert not ready(manifest(SOURCE, source("README.md")), folder)
    assert ready(manifest(SOURCE, source("README.md")), folder, without=("part1",))
    there = folder / "acme--toy"
    changed = bytes([MODEL.data[0] ^ 1]) + MODEL.data[1:]
    (there / "model.safetensors").write_bytes(changed)
    assert problems(SOURCE, folder) == {"model.safetensors": "wrong-digest"}
    assert problems(SOURCE, folder, digests=False) == {}
    (there / "config.json").write_bytes(b"{}")
    (there / "vae" / "model.safetensors").unlink()
    (there / "notes.txt").write_text("Not in the record.")
    assert not ready(manifest(SOURCE), folder)
    wrong = {"config.json": "wrong-size", "model.safetensors": "wrong-digest", "vae/model.safetensors": "missing"}
    assert problems(SOURCE, folder) == wrong
    with refused("weights-unavailable") as caught:
        verify(SOURCE, folder, "toy")
    digest, told = hashlib.sha256(changed).hexdigest(), caught.value.detail
    assert all(each in told for each in (*wrong, digest, MODEL.sha256, "2 bytes", "13 bytes", "cow models pull toy"))
    before = len(hub.asked)
    pull(SOURCE, folder, hub)
    assert len(hub.asked) == before + 3
    assert check(SOURCE, folder) == ()
    # Weights of another revision beside these: a loader would take them for its own.
    (there / "model-00002-of-00002.safetensors").write_bytes(b"old")
    assert problems(SOURCE, folder) == {"model-00002-of-00002.safetensors": "not-recorded"}
    with refused("weights-unavailable"):
        verify(SOURCE, folder, "toy")


def test_at_most_ten_findings_are_told(hub: Hub, folder: Path) -> None:
    hub.commit(TOY, {f"{index:02}.json": CONFIG for index in range(13)})
    pull(source("*"), folder, hub)
    for path in (folder / "acme--toy").glob("*[0-9].json"):
        path.unlink()
    assert len(check(source("*"), folder)) == 13
    with refused("weights-unavailable") as caught:
        verify(source("*"), folder, "toy")
    assert [f"{index:02}.json" in caught.value.detail for index in range(13)] == [True] * 10 + [False] * 3
    assert "3 more" in caught.value.detail


def test_a_spoilt_record_is_told_and_no_path_in_it_is_followed(hub: Hub, folder: Path) -> None:
    pull(SOURCE, folder, hub)
    record = folder / "acme--toy" / "cow.lock.json"
    good = record.read_text()
    for spoilt in ("", "{}", good.replace("vae/", "../"), good.replace('"version": 1', '"version": 2')):
        record.write_text(spoilt)
        with refused("weights-unavailable") as caught:
            check(SOURCE, folder)
        assert "acme--toy/cow.lock.json" in caught.value.detail
        assert "acme--toy/cow.lock.json" in refusal(hub, folder)
        assert not ready(manifest(SOURCE), folder)


def test_the_identity_of_weights_changes_with_them(hub: Hub, folder: Path, tmp_path: Path) -> None:
    own = tmp_path / "own" / "mine.safetensors"
    own.parent.mkdir()
    toy, seen = manifest(SOURCE), list[str]()

    def look(**checkpoints: Path) -> None:
        seen.append(weights_identity(toy, Settings(models_dir=folder, checkpoints=checkpoints)))

    look()
    pull(SOURCE, folder, hub)
    look()
    own.write_bytes(b"1")
    look(toy=own)
    look(toy=own.parent)
    own.write_bytes(b"22")
    look(toy=own.parent)
    os.utime(own, (1, 1))
    look(toy=own.parent)
    assert seen[2] == seen[3]
    assert len(set(seen)) == 5


# --- the command line ---

PARTS = {
    "model": source("config.json", "model.safetensors"),
    "vae": source("vae/*"),
    "other": source("*.json", repository="acme/other"),
}


@pytest.fixture
def cow(monkeypatch: pytest.MonkeyPatch, folder: Path, hub: Hub) -> Callable[..., tuple[int, str]]:
    """`cow models ...` in this process, where there is a model `toy` in three parts: exit code, and what it said."""
    from huggingface_hub import HfApi

    manifests = load_manifests() | {"toy": manifest().model_copy(update={"sources": PARTS})}
    monkeypatch.setattr("cow_service.weights.manifests.load_manifests", lambda: manifests)
    monkeypatch.setattr("huggingface_hub.HfApi", lambda endpoint, **rest: HfApi(endpoint=hub.address, **rest))
    monkeypatch.setenv("COW_MODELS_DIR", str(folder))

    def run(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["models", *arguments])
        assert result.exception is None or isinstance(result.exception, SystemExit)
        return result.exit_code, result.output

    return run


def test_the_command_pulls_and_checks_and_says_what_and_where(hub: Hub, folder: Path, cow, monkeypatch) -> None:
    first = hub.main[TOY]
    hub.commit(TOY, {"config.json": CONFIG})
    hub.commit("acme/other", {"other.json": CONFIG})
    code, told = cow("check", "toy")
    assert code == 1
    assert all(each in told for each in ("vae (acme/toy, mit)", "vae/*", "cow models pull toy"))
    code, told = cow("pull", "toy", "--revision", f"vae={first}", "--revision", "other=main")
    assert code == 0, told
    assert "4 files, 13.3 kB" in told
    assert "acme/toy: model.safetensors, 10.2 kB" in told
    for repository, revision in ((TOY, first), ("acme/other", hub.main["acme/other"])):
        assert f"{repository} at {revision[:12]} is in {folder_of(folder, repository)}" in told
    assert locked(folder).revision == first
    code, told = cow("check", "toy", "--json")
    assert code == 0
    assert json.loads(told) == {"name": "toy", "complete": True, "findings": {part: [] for part in PARTS}}
    (folder / "acme--toy" / "vae" / "model.safetensors").write_bytes(VAE.data[::-1])
    code, told = cow("check", "toy")
    assert code == 1
    assert all(each in told for each in ("model (acme/toy, mit)", "vae/model.safetensors", VAE.sha256))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    code, told = cow("pull", "toy")
    assert code == 1
    assert all(each in told for each in ("weights-unavailable", "acme/toy", "HF_HUB_OFFLINE"))


def test_names_and_revisions_that_cannot_be_pulled(cow: Callable[..., tuple[int, str]]) -> None:
    for command in ("pull", "check"):
        assert cow(command, "cutout")[0] == 0  # it needs no weights
        code, told = cow(command, "dream")
        assert code == 1
        assert all(name in told for name in ("dream", "toy"))
    code, told = cow("pull", "toy", "--revision", "encoder=main")
    assert code == 1
    assert all(part in told for part in ("encoder", *PARTS))
    code, told = cow("pull", "toy", "--revision", "main", "--revision", "vae=v1")
    assert code == 1
    assert "acme/toy" in told, "whose parts share a folder"
    assert cow("--json", "check", "toy")[0] == 2
