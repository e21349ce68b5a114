"""Finds the prompts and manifests that ship with the package, in a checkout and in an installed wheel alike.

In a checkout they are folders beside the package; a wheel carries them inside it, under `_shipped`.
"""

from __future__ import annotations

from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

PROMPTS = ("prompts", ".md")
MANIFESTS = ("models", ".yaml")
FAMILIES = ("models/families", ".yaml")


def _folder(name: str) -> Traversable:
    # The wheel's own copy comes first: what lies beside an installed package is site-packages, not ours.
    shipped = files("cow_service").joinpath("_shipped")
    return shipped.joinpath(name) if shipped.is_dir() else Path(__file__).resolve().parents[2] / name


def _named(kind: tuple[str, str]) -> dict[str, Traversable]:
    folder, suffix = _folder(kind[0]), kind[1]
    found = {file.name.removesuffix(suffix): file for file in _files(folder) if file.name.endswith(suffix)}
    return dict(sorted(found.items()))


def _files(folder: Traversable) -> list[Traversable]:
    return [file for file in folder.iterdir() if file.is_file()] if folder.is_dir() else []


def _read(kind: tuple[str, str], what: str, name: str) -> str:
    # Looked up among the names that exist, never joined to a path: a name cannot lead out of the folder.
    named = _named(kind)
    if name not in named:
        raise LookupError(f"No {what} is named {name!r}; there are: {', '.join(named) or 'none'}.")
    return named[name].read_text(encoding="utf-8")


def prompt_names() -> tuple[str, ...]:
    """Names of the shipped prompts, sorted."""
    return tuple(_named(PROMPTS))


def manifest_names() -> tuple[str, ...]:
    """Names of the shipped model manifests, sorted."""
    return tuple(_named(MANIFESTS))


def family_names() -> tuple[str, ...]:
    """Names of the shipped families of MLLMs, sorted."""
    return tuple(_named(FAMILIES))


def read_prompt_text(name: str) -> str:
    """A prompt file's text. Raises `LookupError`, naming those that exist."""
    return _read(PROMPTS, "prompt", name)


def read_manifest_text(name: str) -> str:
    """A model manifest's text. Raises `LookupError`, naming those that exist."""
    return _read(MANIFESTS, "manifest", name)


def read_family_text(name: str) -> str:
    """A family file's text. Raises `LookupError`, naming those that exist."""
    return _read(FAMILIES, "family of MLLMs", name)
