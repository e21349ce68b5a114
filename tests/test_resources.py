"""Shipped files are found from a checkout and from a wheel."""

from __future__ import annotations

from pathlib import Path

import pytest

from cow_service.weights import resources

ROOT = Path(__file__).parents[1]


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
    assert resources.prompt_names() == tuple(sorted(file.stem for file in (ROOT / "prompts").glob("*.md")))
    assert resources.manifest_names() == tuple(sorted(file.stem for file in (ROOT / "models").glob("*.yaml")))


def test_text_in_a_checkout() -> None:
    for name in resources.prompt_names():
        assert resources.read_prompt_text(name) == (ROOT / "prompts" / f"{name}.md").read_text(encoding="utf-8")
    for name in resources.manifest_names():
        assert resources.read_manifest_text(name) == (ROOT / "models" / f"{name}.yaml").read_text(encoding="utf-8")


@pytest.mark.usefixtures("wheel")
def test_wheel() -> None:
    assert resources.prompt_names() == ("hello",)
    assert resources.manifest_names() == ("toy",)
    assert resources.read_prompt_text("hello") == "hello.md: ä"
    assert resources.read_manifest_text("toy") == "toy.yaml: ä"


@pytest.mark.usefixtures("wheel")
@pytest.mark.parametrize("name", ["absent", "", "../models/toy", "hello.md", "notes"])
def test_missing_names_what_exists(name: str) -> None:
    with pytest.raises(LookupError, match="there are: hello"):
        resources.read_prompt_text(name)
    with pytest.raises(LookupError, match="there are: toy"):
        resources.read_manifest_text(name)


def test_no_folder_means_no_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "_shipped").mkdir()
    monkeypatch.setattr(resources, "files", lambda package: tmp_path)
    assert resources.prompt_names() == ()
    with pytest.raises(LookupError, match="there are: none"):
        resources.read_prompt_text("hello")


def test_shipped_folders_are_in_the_wheel_recipe() -> None:
    recipe = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for folder, _ in (resources.PROMPTS, resources.MANIFESTS):
        assert f'"{folder}" = "cow_service/_shipped/{folder}"' in recipe
