"""Weights: pulled from a real server that speaks like the hub, recorded, checked, and refused where they are wrong."""

from __future__ import annotations

import builtins
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from conftest import ROOT
from hub import Blob, Hub, running
from typer.testing import CliRunner

from cow_service.cli.main import app
from cow_service.errors import WeightsUnavailable, install_line
from cow_service.weights import repositories
from cow_service.weights.manifests import Manifest, Source, load_manifests
from cow_service.weights.repositories import (
    Lock,
    LockedFile,
    check,
    download,
    examine,
    folder_of,
    read_lock,
    ready,
    resolve,
    verify,
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


def pull(wanted: Source, folder: Path, revision: str | None = None, *, endpoint: str) -> Path:
    download([resolve(wanted, folder, revision, endpoint=endpoint)], folder, endpoint=endpoint)
    return folder_of(folder, wanted.repository)


def refusal(hub: Hub, folder: Path, wanted: Source = SOURCE, revision: str | None = None) -> str:
    """What a pull that fails says. It never holds a path of this machine."""
    with pytest.raises(WeightsUnavailable) as raised:
        pull(wanted, folder, revision, endpoint=hub.address)
    assert wanted.repository in raised.value.detail
    assert str(folder.parent) not in raised.value.detail
    return raised.value.detail


def locked(folder: Path) -> Lock:
    lock = read_lock(folder, TOY)
    assert lock is not None
    return lock


def problems(wanted: Source, folder: Path, *, digests: bool = True) -> dict[str, str]:
    return {finding.file: finding.problem for finding in check(wanted, folder, digests)}


# --- pulling ---


def test_a_pull_brings_the_files_that_match_and_records_them(hub: Hub, folder: Path) -> None:
    assert pull(SOURCE, folder, endpoint=hub.address) == folder / "acme--toy"
    for path in ("config.json", "model.safetensors", "vae/model.safetensors"):
        assert (folder / "acme--toy" / path).read_bytes() == FILES[path].data
    assert not (folder / "acme--toy" / "README.md").exists()
    lock = locked(folder)
    assert lock.revision == hub.main[TOY]
    assert [(file.path, file.size, file.algorithm, file.digest) for file in lock.files] == [
        ("config.json", len(CONFIG.data), "git-sha1", CONFIG.sha1),
        ("model.safetensors", len(MODEL.data), "sha256", MODEL.sha256),
        ("vae/model.safetensors", len(VAE.data), "sha256", VAE.sha256),
    ]
    assert check(SOURCE, folder) == ()
    assert verify(SOURCE, folder, "toy") == folder / "acme--toy"


def test_a_second_pull_downloads_nothing_and_needs_no_hub(folder: Path) -> None:
    with running() as hub:
        hub.commit(TOY, FILES)
        pull(SOURCE, folder, endpoint=hub.address)
        asked = list(hub.asked)
        pull(SOURCE, folder, endpoint=hub.address)
        assert hub.asked == asked
        assert len(hub.listings) == 1
    pull(SOURCE, folder, endpoint=hub.address)


def test_a_connection_that_breaks_is_taken_up_where_it_broke(hub: Hub, folder: Path) -> None:
    chunk = 10 * 2**20  # what the library writes at a time
    large = Blob(hashlib.shake_256(b"weights").digest(2**16) * 256)
    hub.commit(TOY, {"large.safetensors": large})
    hub.cut["large.safetensors"] = chunk + 12345
    pull(source("*.safetensors"), folder, endpoint=hub.address)
    assert [asked.range for asked in hub.asked] == [None, f"bytes={chunk}-"]
    assert (folder / "acme--toy" / "large.safetensors").read_bytes() == large.data


def test_the_revision_stays_while_main_moves_until_another_is_asked_for(hub: Hub, folder: Path) -> None:
    first = hub.main[TOY]
    pull(SOURCE, folder, endpoint=hub.address)
    newer = Blob(b"newer" * 100)
    second = hub.commit(TOY, FILES | {"model.safetensors": newer})
    model = folder / "acme--toy" / "model.safetensors"
    model.unlink()
    pull(SOURCE, folder, endpoint=hub.address)
    assert model.read_bytes() == MODEL.data
    before = len(hub.asked)
    pull(SOURCE, folder, "main", endpoint=hub.address)
    assert model.read_bytes() == newer.data
    assert hub.downloads()[before:] == ["model.safetensors"]
    assert locked(folder).revision == second
    pull(SOURCE, folder, first, endpoint=hub.address)
    assert model.read_bytes() == MODEL.data


def test_a_pull_that_was_killed_goes_on_with_its_revision(hub: Hub, folder: Path, tmp_path: Path) -> None:
    first = hub.main[TOY]
    hub.stall["vae/model.safetensors"] = 1000
    arguments = SOURCE.model_dump_json(), str(folder), hub.address
    code = (
        "import sys; from pathlib import Path; from cow_service.weights.repositories import download, resolve; "
        "from cow_service.weights.manifests import Source; "
        "source, folder, hub = Source.model_validate_json(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]; "
        "download([resolve(source, folder, endpoint=hub)], folder, endpoint=hub)"
    )
    environment = os.environ | {"HF_HOME": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", code, *arguments], env=environment) as process:
        try:
            assert hub.stalled.wait(60)
            assert "another pull is downloading it" in refusal(hub, folder)
        finally:
            process.kill()
    left = set(folder.rglob("*.incomplete"))
    assert left
    assert problems(SOURCE, folder) == {"vae/model.safetensors": "missing"}
    hub.commit(TOY, FILES | {"vae/model.safetensors": Blob(b"newer")})
    before = len(hub.asked)
    pull(SOURCE, folder, endpoint=hub.address)
    assert hub.downloads()[before:] == ["vae/model.safetensors"]
    assert locked(folder).revision == first
    assert check(SOURCE, folder) == ()
    assert not left & set(folder.rglob("*.incomplete"))


def test_sources_of_one_repository_share_its_folder_and_record(hub: Hub, folder: Path) -> None:
    model, vae = source("model.safetensors", "config.json"), source("vae/*", "config.json")
    pull(model, folder, endpoint=hub.address)
    assert problems(vae, folder) == {"vae/*": "not-pulled"}
    hub.commit(TOY, FILES | {"vae/model.safetensors": Blob(b"newer")})
    pull(vae, folder, endpoint=hub.address)
    assert (folder / "acme--toy" / "vae" / "model.safetensors").read_bytes() == VAE.data
    assert hub.downloads().count("config.json") == 1
    assert check(model, folder) == check(vae, folder) == ()
    assert ready(manifest(model, vae), folder)


def test_pulls_planned_at_the_same_time_record_both(hub: Hub, folder: Path) -> None:
    model, vae = source("model.safetensors"), source("vae/*")
    downloads = [resolve(each, folder, endpoint=hub.address) for each in (model, vae)]
    for each in downloads:
        download([each], folder, endpoint=hub.address)
    assert check(model, folder) == check(vae, folder) == ()


def test_another_revision_is_another_for_all_sources_of_the_repository(hub: Hub, folder: Path) -> None:
    model, vae, readme = source("model.safetensors"), source("vae/*"), source("README.md")
    for each in (model, vae, readme):
        pull(each, folder, endpoint=hub.address)
    hub.commit(TOY, {"model.safetensors": Blob(b"newer"), "vae/model.safetensors": Blob(b"newer vae")})
    pull(model, folder, "main", endpoint=hub.address)
    assert check(model, folder) == ()
    assert problems(vae, folder) == {"vae/model.safetensors": "wrong-size"}
    assert problems(readme, folder) == {"README.md": "not-pulled"}
    pull(vae, folder, endpoint=hub.address)
    assert check(vae, folder) == check(model, folder) == ()


def test_pickled_files_are_never_taken(hub: Hub, folder: Path) -> None:
    pickled = dict.fromkeys(("a.bin", "b.pth", "c/d.PT", "e.pkl", "f.ckpt"), Blob(b"\x80\x04."))
    hub.commit(TOY, FILES | pickled)
    pull(source("*"), folder, endpoint=hub.address)
    assert set(hub.downloads()) == set(FILES)
    told = refusal(hub, folder / "other", source("config.json", "*.pth"))
    assert "only pickled files, which can run code when they are read, match '*.pth'" in told


# --- pulls that fail ---


def test_bytes_that_are_not_those_listed_are_thrown_away(hub: Hub, folder: Path) -> None:
    hub.spoilt.add("model.safetensors")
    told = refusal(hub, folder)
    assert f"model.safetensors has sha256 {hashlib.sha256(MODEL.data[::-1]).hexdigest()}" in told
    assert f"not sha256 {MODEL.sha256}" in told
    assert "run it again" in told
    assert not (folder / "acme--toy" / "model.safetensors").exists()
    hub.spoilt.clear()
    pull(SOURCE, folder, endpoint=hub.address)
    assert check(SOURCE, folder) == ()


@pytest.mark.parametrize(
    ("refused", "told"),
    [
        ({"/api/": (403, "GatedRepo")}, "its owner has not granted access"),
        ({"/resolve/": (401, "GatedRepo")}, "its owner has not granted access"),
        ({"/api/": (401, "")}, "it is not open to this account (HTTP 401)"),
        ({"/resolve/": (403, "")}, "it is not open to this account (HTTP 403)"),
        ({"/api/": (500, "")}, "the hub answered with HTTP 500"),
        ({"/storage/": (410, "")}, "the hub answered with HTTP 410"),
        ({"/resolve/": (404, "EntryNotFound")}, "a file is no longer there"),
        ({"/api/": (200, "")}, "the download failed (JSONDecodeError)"),
    ],
)
def test_what_the_hub_refuses_is_told(hub: Hub, folder: Path, refused: dict[str, tuple[int, str]], told: str) -> None:
    hub.refused = refused
    assert told in refusal(hub, folder)
    assert not list(folder.rglob("*.safetensors"))
    hub.refused = {}
    pull(SOURCE, folder, endpoint=hub.address)


def test_a_repository_or_revision_that_is_not_there(hub: Hub, folder: Path) -> None:
    assert "the hub knows no such repository" in refusal(hub, folder, source("*", repository="acme/nothing"))
    told = refusal(hub, folder, revision="v9")
    assert "it has no revision 'v9'" in told
    assert "--revision main" in told
    assert not folder.exists()


def test_a_hub_that_is_down(folder: Path) -> None:
    with running() as hub:
        pass
    told = refusal(hub, folder)
    assert "the hub cannot be reached" in told
    assert "HF_ENDPOINT" in told


def test_a_pattern_that_matches_nothing(hub: Hub, folder: Path) -> None:
    assert "no file matches 'text/*'" in refusal(hub, folder, source("*.json", "text/*"))
    assert not folder.exists()


@pytest.mark.parametrize(
    "path", ["../evil.json", "/evil.json", "a/../../evil.json", "a//evil.json", "..\\evil.json", "C:evil.json", "./x"]
)
def test_paths_that_lead_out_of_the_folder_are_refused(hub: Hub, folder: Path, path: str) -> None:
    hub.commit(TOY, {path: Blob(b"evil"), "ok.json": CONFIG})
    assert "could lead out of the folder" in refusal(hub, folder, source("*"))
    assert not hub.asked
    assert not folder.exists()


@pytest.mark.parametrize("path", ["cow.lock.json", "COW.lock.json", ".cache/huggingface/x.json"])
def test_names_that_the_download_needs_are_refused(hub: Hub, folder: Path, path: str) -> None:
    hub.commit(TOY, {path: Blob(b"evil")})
    assert "needs for itself" in refusal(hub, folder, source("*"))


def test_a_disk_that_is_too_small_is_told_before_the_first_byte(hub: Hub, folder: Path) -> None:
    hub.commit(TOY, {"config.json": CONFIG, "huge.safetensors": Blob(b"", listed_size=2 * 10**18)})
    told = refusal(hub, folder)
    assert "2000000000.0 GB are needed" in told
    assert "COW_MODELS_DIR" in told
    assert not hub.asked


def test_a_folder_that_cannot_be_used(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "weights").write_text("")
    assert "Not a directory" in refusal(hub, tmp_path / "weights")
    assert not ready(manifest(SOURCE), tmp_path / "weights")
    (tmp_path / "other" / "acme--toy" / "config.json").mkdir(parents=True)
    assert "the folder for weights cannot be used" in refusal(hub, tmp_path / "other")


def test_without_the_hubs_library_the_line_that_installs_it_is_told(
    hub: Hub, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pull(SOURCE, folder, endpoint=hub.address)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    pull(SOURCE, folder, endpoint=hub.address)  # there is nothing to download
    with pytest.raises(WeightsUnavailable, match=re.escape(install_line("wan"))):
        pull(source("README.md"), folder, endpoint=hub.address)


def test_the_exceptions_that_have_reasons_exist() -> None:
    import huggingface_hub.errors

    transport = sys.modules[huggingface_hub.errors.HTTPError.__module__.split(".", maxsplit=1)[0]]
    for name, _, _ in repositories.REASONS:
        assert any(hasattr(home, name) for home in (huggingface_hub.errors, transport, builtins)), name


# --- checking ---


def test_what_was_changed_afterwards_is_found_and_mended(hub: Hub, folder: Path) -> None:
    pull(SOURCE, folder, endpoint=hub.address)
    model, config = (folder / "acme--toy" / name for name in ("model.safetensors", "config.json"))
    changed = bytes([MODEL.data[0] ^ 1]) + MODEL.data[1:]
    model.write_bytes(changed)
    assert problems(SOURCE, folder) == {"model.safetensors": "wrong-digest"}
    assert problems(SOURCE, folder, digests=False) == {}
    config.write_bytes(b"{}")
    (folder / "acme--toy" / "vae" / "model.safetensors").unlink()
    (folder / "acme--toy" / "notes.txt").write_text("Not in the record.")
    assert problems(SOURCE, folder) == {
        "config.json": "wrong-size",
        "model.safetensors": "wrong-digest",
        "vae/model.safetensors": "missing",
    }
    with pytest.raises(WeightsUnavailable) as raised:
        verify(SOURCE, folder, "toy")
    assert raised.value.detail == (
        f"'toy' cannot use its weights of 'acme/toy': config.json has 2 bytes, not {len(CONFIG.data)} bytes; "
        f"model.safetensors has sha256 {hashlib.sha256(changed).hexdigest()}, not sha256 {MODEL.sha256}; "
        f"vae/model.safetensors is missing. Run `cow models pull toy`."
    )
    before = len(hub.asked)
    pull(SOURCE, folder, endpoint=hub.address)
    assert len(hub.asked) == before + 3
    assert check(SOURCE, folder) == ()


def test_weights_are_ready_when_every_file_has_its_size(hub: Hub, folder: Path) -> None:
    assert ready(manifest(), folder)
    assert not ready(manifest(SOURCE), folder)
    pull(SOURCE, folder, endpoint=hub.address)
    assert ready(manifest(SOURCE), folder)
    assert not ready(manifest(SOURCE, source("README.md")), folder)
    (folder / "acme--toy" / "config.json").unlink()
    assert not ready(manifest(SOURCE), folder)


def test_what_was_never_pulled_is_told(folder: Path) -> None:
    assert problems(SOURCE, folder) == {"config.json": "not-pulled", "*.safetensors": "not-pulled"}
    with pytest.raises(WeightsUnavailable, match=r"config\.json was not pulled; .* Run `cow models pull toy`"):
        verify(SOURCE, folder, "toy")


def test_at_most_ten_findings_are_told(hub: Hub, folder: Path) -> None:
    hub.commit(TOY, {f"{index:02}.json": CONFIG for index in range(13)})
    pull(source("*"), folder, endpoint=hub.address)
    for path in (folder / "acme--toy").glob("*[0-9].json"):
        path.unlink()
    assert len(check(source("*"), folder)) == 13
    with pytest.raises(WeightsUnavailable, match=r"09\.json is missing; and 3 more\. Run"):
        verify(source("*"), folder, "toy")


@pytest.mark.parametrize(
    ("data", "digest"),
    [(b"", "e69de29bb2d1d6434b8b29ae775ad8c2e48c5391"), (b"hello\n", "ce013625030ba8dba906f756967f9e9ca394464a")],
)
def test_digests_of_small_files_are_those_of_git(tmp_path: Path, data: bytes, digest: str) -> None:
    file = LockedFile(path="a", size=len(data), algorithm="git-sha1", digest=digest)
    lock = Lock(repository=TOY, revision="0" * 40, patterns=("a",), files=(file,))
    folder_of(tmp_path, TOY).mkdir()
    (folder_of(tmp_path, TOY) / "a").write_bytes(data)
    assert examine(lock, lock.files, tmp_path) == ()


def test_a_spoilt_record_is_told_and_no_path_in_it_is_followed(hub: Hub, folder: Path) -> None:
    pull(SOURCE, folder, endpoint=hub.address)
    record = folder / "acme--toy" / "cow.lock.json"
    good = record.read_text()
    for spoilt in ("", "{}", good.replace("vae/", "../"), good.replace('"version": 1', '"version": 2')):
        record.write_text(spoilt)
        with pytest.raises(WeightsUnavailable, match=r"acme--toy/cow\.lock\.json, is damaged: delete it"):
            check(SOURCE, folder)
        assert "is damaged" in refusal(hub, folder)
        assert not ready(manifest(SOURCE), folder)


# --- the command line ---

PARTS = {
    "model": source("config.json", "model.safetensors"),
    "vae": source("vae/*"),
    "other": source("*.json", repository="acme/other"),
}


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Callable[..., tuple[int, str]]:
    """`cow models ...` in this process, where there is a model `toy` in three parts: exit code, and what it said."""
    manifests = load_manifests() | {"toy": manifest().model_copy(update={"sources": PARTS})}
    monkeypatch.setattr("cow_service.weights.manifests.load_manifests", lambda: manifests)
    monkeypatch.setenv("COW_MODELS_DIR", str(folder))

    def run(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["models", *arguments])
        assert result.exception is None or isinstance(result.exception, SystemExit)
        return result.exit_code, result.output

    return run


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package with `toy` among its manifests."""
    root = tmp_path_factory.mktemp("checkout")
    for name in ("cow_service", "models", "prompts"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    toy = manifest().model_copy(update={"sources": PARTS})
    (root / "models" / "toy.yaml").write_text(yaml.safe_dump(toy.model_dump(mode="json")))
    return root


def cow(checkout: Path, folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    plain = {"COW_MODELS_DIR": str(folder), "COLUMNS": "200", "TERM": "dumb", "HF_HOME": str(checkout / "hf")}
    return subprocess.run(
        [sys.executable, "-m", "cow_service.cli.main", "models", *arguments],
        env=os.environ | plain | environment,
        cwd=checkout,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_command_pulls_and_says_what_and_where(hub: Hub, folder: Path, checkout: Path) -> None:
    hub.commit("acme/other", {"other.json": CONFIG})
    result = cow(checkout, folder, "pull", "toy", HF_ENDPOINT=hub.address)
    assert result.returncode == 0, result.stderr
    assert "toy: 4 files, 13.3 kB; to download: 4 files, 13.3 kB.\n" in result.stdout
    assert "acme/toy: model.safetensors, 10.2 kB\n" in result.stdout
    assert f"acme/toy at {hub.main[TOY][:12]} is in {folder / 'acme--toy'}\n" in result.stdout
    assert f"acme/other at {hub.main['acme/other'][:12]} is in {folder / 'acme--other'}\n" in result.stdout
    assert not result.stderr


def test_on_a_terminal_bars_are_shown_and_a_part_may_have_a_revision(hub: Hub, folder: Path, checkout: Path) -> None:
    first = hub.main[TOY]
    hub.commit(TOY, {"config.json": CONFIG})
    hub.commit("acme/other", {"other.json": CONFIG})
    terminal = {"HF_ENDPOINT": hub.address, "TQDM_POSITION": "-1"}  # as if it were one
    result = cow(checkout, folder, "pull", "toy", "--revision", f"vae={first}", "--revision", "other=main", **terminal)
    assert result.returncode == 0, result.stderr
    assert "model.safetensors: 100%" in result.stderr
    assert locked(folder).revision == first


def test_a_pull_that_fails_is_told_in_words(folder: Path, checkout: Path) -> None:
    result = cow(checkout, folder, "pull", "toy", HF_HUB_OFFLINE="1")
    assert result.returncode == 1
    assert "weights-unavailable" in result.stderr
    assert "'acme/toy' cannot be downloaded: HF_HUB_OFFLINE is set. Unset it to download." in result.stderr
    assert "Traceback" not in result.stderr


def test_the_command_checks(hub: Hub, folder: Path, toy: Callable[..., tuple[int, str]]) -> None:
    hub.commit("acme/other", {"other.json": CONFIG})
    code, told = toy("check", "toy")
    assert code == 1
    assert "vae (acme/toy, mit): not complete\n  vae/* was not pulled\n" in told
    assert "Run `cow models pull toy`." in told
    for each in PARTS.values():
        pull(each, folder, endpoint=hub.address)
    code, told = toy("check", "toy", "--json")
    assert code == 0
    assert json.loads(told) == {"name": "toy", "complete": True, "findings": {part: [] for part in PARTS}}
    assert toy("pull", "toy")[0] == 0
    (folder / "acme--toy" / "vae" / "model.safetensors").write_bytes(VAE.data[::-1])
    code, told = toy("check", "toy")
    assert code == 1
    assert "model (acme/toy, mit): complete\n" in told
    assert "  vae/model.safetensors has sha256 " in told


def test_names_and_revisions_that_cannot_be_pulled(toy: Callable[..., tuple[int, str]]) -> None:
    for command in ("pull", "check"):
        assert toy(command, "cutout") == (0, "cutout needs no weights.\n")
        code, told = toy(command, "dream")
        assert code == 1
        assert "There is no model 'dream'. Models with weights to download:" in told
        assert "toy" in told
    code, told = toy("pull", "toy", "--revision", "encoder=main")
    assert code == 1
    assert "'toy' has no part 'encoder'. Its parts: model, vae, other." in told
    code, told = toy("pull", "toy", "--revision", "main", "--revision", "vae=v1")
    assert code == 1
    assert "All parts from 'acme/toy' share a folder" in told
    assert toy("--json", "check", "toy")[0] == 2


def test_weights_of_another_revision_beside_these_are_found(hub: Hub, folder: Path) -> None:
    """A loader would take them for its own."""
    pull(SOURCE, folder, endpoint=hub.address)
    stranger = folder_of(folder, TOY) / "model-00002-of-00002.safetensors"
    stranger.write_bytes(b"old")
    assert [(finding.file, finding.problem) for finding in check(SOURCE, folder)] == [(stranger.name, "not-recorded")]
    with pytest.raises(WeightsUnavailable, match="is not of this revision: delete it"):
        verify(SOURCE, folder, "toy")
