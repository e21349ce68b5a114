"""Shipped files are found from a checkout and from a wheel."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import ROOT

from cow_service.weights import manifests as resources
from cow_service.weights.manifests import FAMILIES, MANIFESTS, PROMPTS, TOOL_PROMPTS


def test_in_a_checkout_they_are_the_files_of_its_folders() -> None:
    for kind in (PROMPTS, TOOL_PROMPTS, MANIFESTS, FAMILIES):
        files = {file.stem: file for file in (ROOT / kind.folder).glob(f"*{kind.suffix}")}
        assert {name: kind.read(name) for name in kind.names()} == {
            name: file.read_text(encoding="utf-8") for name, file in files.items()
        }
        assert list(kind.names()) == sorted(files)


def test_in_a_wheel_they_are_its_own_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resources, "files", lambda package: tmp_path)
    (tmp_path / "_shipped").mkdir()
    assert PROMPTS.names() == ()
    with pytest.raises(LookupError):
        PROMPTS.read("hello")
    for folder, name in (("prompts", "hello.md"), ("prompts", "notes.txt"), ("models", "toy.yaml")):
        file = tmp_path / "_shipped" / folder / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"{name}: ä", encoding="utf-8")
    assert (PROMPTS.names(), PROMPTS.read("hello")) == (("hello",), "hello.md: ä")
    assert (MANIFESTS.names(), MANIFESTS.read("toy")) == (("toy",), "toy.yaml: ä")
    for name in ("absent", "", "../models/toy", "hello.md", "notes"):
        with pytest.raises(LookupError, match="hello"):  # what exists is named
            PROMPTS.read(name)
