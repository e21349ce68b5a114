"""Reads the manifests in `models/`: what a backend or model is, what it needs, its defaults. No weights, no loading."""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, JsonValue

from cow_service.errors import CowError, install_line
from cow_service.records import Coordinates, Record


@dataclass(frozen=True)
class Resources:
    """The files of one kind."""

    folder: str
    suffix: str
    kind: str  # for messages

    def names(self) -> tuple[str, ...]:
        """File names without suffix, sorted."""
        return tuple(self._files())

    def read(self, name: str) -> str:
        """The text of one. Raises `LookupError`, naming those that exist."""
        return self.file(name).read_text(encoding="utf-8")

    def file(self, name: str) -> Traversable:
        """One as it lies in the package. Raises `LookupError`, naming those that exist."""
        # Looked up among the names that exist, never joined to a path: a name cannot lead out of the folder.
        found = self._files()
        if name not in found:
            raise LookupError(f"No {self.kind} is named {name!r}; there are: {', '.join(found) or 'none'}.")
        return found[name]

    def _files(self) -> dict[str, Traversable]:
        # The wheel's own copy comes first: the folder next to an installed package is site-packages, not ours.
        shipped = files("cow_service").joinpath("_shipped")
        root: Traversable = shipped if shipped.is_dir() else Path(__file__).resolve().parents[2]
        folder = root.joinpath(self.folder)
        found = [file for file in folder.iterdir() if file.is_file()] if folder.is_dir() else []
        names = {file.name.removesuffix(self.suffix): file for file in found if file.name.endswith(self.suffix)}
        return dict(sorted(names.items()))


PROMPTS = Resources("prompts", ".md", "prompt")
TOOL_PROMPTS = Resources("prompts/tools", ".md", "prompt of a tool")
MANIFESTS = Resources("models", ".yaml", "model manifest")
NETWORKS = Resources("models", ".onnx", "network")
CARDS = Resources("models", ".json", "card of a network")
FAMILIES = Resources("models/families", ".yaml", "family of MLLMs")
EXAMPLES = {  # each has one, `image`
    name: Resources(f"examples/{name}", ".jpg", "picture")
    for name in ("ball-and-mug", "falling-ball", "bottle-passes-cylinder", "thrown-ball")
}
FILMS = {name: Resources(f"examples/{name}", ".mp4", "film") for name in EXAMPLES}  # each has one, `film`


class Source(Record):
    """Files of one repository on the hub. Revision and digests are recorded when they are downloaded, not here."""

    repository: str = Field(pattern=r"^[\w.-]+/[\w.-]+$", description="owner/name")
    files: tuple[str, ...] = Field(min_length=1, description="Glob patterns of the files that are used.")
    licence: str
    pickled: bool = Field(
        default=False, description="Whether they are pickles. So only where their reader lets them run no code."
    )


class Manifest(Record):
    """One backend or model as described by `models/<name>.yaml`."""

    name: str
    role: Literal["reader", "generator", "mllm", "finder", "segmenter", "detector", "depth", "inpainter"] = Field(
        description="Which registry it belongs to; an `mllm` is what the readers `mllm` and `local` ask, the last five "
        "are what the service sees with."
    )
    summary: str
    licence: str
    weights: str | None = Field(default=None, description="Repository of the weights; null where there are none.")
    extra: str | None = Field(default=None, description="The optional dependency group that it needs.")
    concurrency: int | None = Field(
        default=None,
        ge=1,
        description="Jobs that a generator or reader works on at the same time on a device of its own; null where it "
        "has none.",
    )
    modules: tuple[str, ...] = Field(default=(), description="Python modules that must be importable.")
    settings: tuple[str, ...] = Field(default=(), description="Settings (COW_...) that it cannot do without.")
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
    family: str | None = Field(default=None, description="An MLLM's family: `models/families/<family>.yaml`.")
    provider: str | None = Field(default=None, description="Who serves an MLLM; null where one runs one's own server.")
    model: str | None = Field(default=None, description="The name under which an MLLM is served.")
    also: tuple[str, ...] = Field(default=(), description="Other served names that mean it, with * and ?.")
    local: dict[str, JsonValue] = Field(default_factory=dict, description="How an MLLM runs in-process.")

    def missing_modules(self) -> tuple[str, ...]:
        """Modules that are not installed. Nothing is imported to find out."""
        return tuple(module for module in self.modules if find_spec(module) is None)

    def install_line(self) -> str:
        """The command that installs what this backend needs."""
        return install_line(self.extra) if self.extra else "pip install --force-reinstall cow-service"


def check_modules(name: str, unavailable: type[CowError]) -> None:
    """Raises `unavailable`, with the command that helps, where the modules of a backend are not installed."""
    manifest = find_manifest(name)
    if manifest is not None and (missing := manifest.missing_modules()):
        raise unavailable(
            f"'{name}' needs {', '.join(missing)}, not installed on this server: {manifest.install_line()}"
        )


class ImageSize(Record):
    """At which size a family sees an image of a given size: its own rule, followed before sending."""

    multiple: int = Field(default=1, ge=1, description="Sides are rounded to multiples of this, px.")
    min_pixels: int = Field(default=0, ge=0)
    max_pixels: int = Field(default=4_194_304, gt=0, description="What is larger is made smaller before it is sent.")
    max_side: int | None = Field(default=None, gt=0, description="px; null for no limit.")


class Family(Record):
    """What MLLMs of one family have in common, as described by `models/families/<name>.yaml`."""

    name: str
    coordinates: Coordinates
    image: ImageSize = ImageSize()
    also: tuple[str, ...] = Field(
        default=(), description="Served names of its models that have no manifest, in lower case, with * and ?."
    )


@cache
def load_families() -> dict[str, Family]:
    """All shipped families by name."""
    return {name: Family.model_validate(_parse(FAMILIES.read(name))) for name in FAMILIES.names()}


@cache
def find_manifest(name: str) -> Manifest | None:
    """One shipped manifest; None for an unknown name. Only its own file is read."""
    return Manifest.model_validate(_parse(MANIFESTS.read(name))) if name in MANIFESTS.names() else None


@cache
def load_manifests() -> dict[str, Manifest]:
    """All shipped manifests by name."""
    return {name: manifest for name in MANIFESTS.names() if (manifest := find_manifest(name)) is not None}


def _parse(text: str) -> Any:
    # libyaml where it is there: starting a server waits for this, and it is several times as fast.
    return yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
