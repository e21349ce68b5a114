"""Reads the manifests in `models/`: what a backend is, what it needs, and its defaults. No weights, no loading."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import Literal

import yaml
from pydantic import Field, JsonValue

from cow_service.records import Record
from cow_service.resources import manifest_names, read_manifest_text


class Source(Record):
    """Files of one repository on the hub. Revision and digests are recorded when they are downloaded, not here."""

    repository: str = Field(pattern=r"^[\w.-]+/[\w.-]+$", description="owner/name")
    files: tuple[str, ...] = Field(min_length=1, description="Glob patterns of the files that are used.")
    licence: str


class Manifest(Record):
    """One backend or model as described by `models/<name>.yaml`."""

    name: str
    door: Literal["reader", "generator"]
    summary: str
    licence: str
    weights: str | None = Field(default=None, description="Repository of the weights; null where there are none.")
    extra: str | None = Field(default=None, description="The optional dependency group that it needs.")
    modules: tuple[str, ...] = Field(default=(), description="Python modules that must be importable.")
    sources: dict[str, Source] = Field(default_factory=dict, description="What `cow models pull` downloads, by part.")
    architecture: dict[str, int | float | str] = Field(
        default_factory=dict,
        description="Sizes of the model, named as in the configuration of its original checkpoint.",
    )
    parameters: dict[str, int] = Field(
        default_factory=dict, description="Parameters of each part, computed from its sizes."
    )
    profiles: dict[str, dict[str, JsonValue]] = Field(default_factory=dict, description="Named ways to run it.")
    defaults: dict[str, bool | int | float | str] = Field(default_factory=dict)

    def missing_modules(self) -> tuple[str, ...]:
        """Modules that are not installed. Nothing is imported to find out."""
        return tuple(module for module in self.modules if find_spec(module) is None)

    def install_line(self) -> str:
        """The command that installs what this backend needs."""
        return f'pip install "cow-service[{self.extra}]"' if self.extra else "pip install --force-reinstall cow-service"


@cache
def load_manifests() -> dict[str, Manifest]:
    """All shipped manifests by name."""
    return {name: Manifest.model_validate(yaml.safe_load(read_manifest_text(name))) for name in manifest_names()}
