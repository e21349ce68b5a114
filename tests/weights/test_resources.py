"""Shipped files are found from a checkout and from a wheel."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import ROOT

from cow_service.weights import manifests as resources
from cow_service.weights.manifests import MANIFESTS, PROMPTS


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that stands for the installed package, with its shipped files inside."""
    for folder, name in (("prompts", "hello.md"), ("prompts", "notes.txt"), ("models", "toy.yaml")):
        file = tmp_path / "_shipped" / folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{name}: ä", encoding="utf-8")
    monkeypatch.setattr(resources, "files", lambda package: tmp_path)
    return tmp_path


def test_names_in_a_checkout() -> None:
    assert PROMPTS.names() == tuple(sorted(file.stem for file in (ROOT / "prompts").glob("*.md")))
    assert MANIFESTS.names() == tuple(sorted(file.stem for file in (ROOT / "models").glob("*.yaml")))


def test_text_in_a_checkout() -> None:
    for name in PROMPTS.names():
        assert PROMPTS.read(name) == (ROOT / "prompts" / f"{name}.md").read_text(encoding="utf-8")
    for name in MANIFESTS.names():
        assert MANIFESTS.read(name) == (ROOT / "models" / f"{name}.yaml").read_text(encoding="utf-8")


@pytest.mark.usefixtures("wheel")
def test_wheel() -> None:
    assert PROMPTS.names() == ("hello",)
    assert MANIFESTS.names() == ("toy",)
    assert PROMPTS.read("hello") == "hello.md: ä"
    assert MANIFESTS.read("toy") == "toy.yaml: ä"


@pytest.mark.usefixtures("wheel")
@pytest.mark.parametrize("name", ["absent", "", "../models/toy", "hello.md", "notes"])
def test_missing_names_what_exists(name: str) -> None:
    with pytest.raises(LookupError, match="there are: hello"):
        PROMPTS.read(name)
    with pytest.raises(LookupError, match="there are: toy"):
        MANIFESTS.read(name)


def test_no_folder_means_no_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "_shipped").mkdir()
    monkeypatch.setattr(resources, "files", lambda package: tmp_path)
    assert PROMPTS.names() == ()
    with pytest.raises(LookupError, match="there are: none"):
        PROMPTS.read("hello")


def test_shipped_folders_are_in_the_wheel_recipe() -> None:
    recipe = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for kind in (PROMPTS, MANIFESTS):
        assert f'"{kind.folder}" = "cow_service/_shipped/{kind.folder}"' in recipe
