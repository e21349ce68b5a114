"""What is known of the multimodal LLM of the settings without calling it: its manifest, and notes of earlier calls."""

import hashlib
import os
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TypeVar

from cow_service.errors import ReaderUnavailable
from cow_service.media.artifacts import make_private
from cow_service.records import MllmMeasurement, MllmStatus, Record, ServerCapabilities
from cow_service.settings import Settings
from cow_service.weights.manifests import Family, Manifest, load_families, load_manifests

UNKNOWN = "generic"  # the manifest, and the family, for models that no other one describes
USUAL = MllmMeasurement(bbox_deviation=0.1, direction_deviation=20.0)  # where nothing was measured
MAX_AGE_SECONDS = 7 * 24 * 3600.0  # servers are updated: what is older is found out again

Kept = TypeVar("Kept", bound=Record)


@dataclass(frozen=True)
class ResolvedModel:
    """What COW_MLLM means."""

    manifest: Manifest
    provider: str | None  # null if one runs one's own server
    name: str  # as it is served
    base_url: str | None

    @property
    def family(self) -> Family:
        """That of its manifest, else the one that its served name tells."""
        families = load_families()
        if self.manifest.name != UNKNOWN:
            return families[self.manifest.family or UNKNOWN]
        name = self.name.lower()
        matching = (each for each in families.values() if any(fnmatchcase(name, pattern) for pattern in each.also))
        return next(matching, families[UNKNOWN])

    @property
    def server(self) -> str:
        """Its address, else its provider's name."""
        return (self.base_url or self.provider or "").rstrip("/")


def resolve_model(settings: Settings) -> ResolvedModel:
    """The manifest, provider and served name of the settings. A manifest with a base URL is on one's own server.

    Raises `ReaderUnavailable` if COW_MLLM is not set or names nothing.
    """
    name, manifests = settings.mllm, mllm_manifests()
    if name is None:
        raise ReaderUnavailable(
            "Reader 'mllm' needs COW_MLLM, which is not set: a manifest's name such as qwen3-vl-8b with "
            "COW_MLLM_BASE_URL, or provider:model such as openai:gpt-5."
        )
    if name in manifests:
        manifest = manifests[name]
        provider = manifest.provider if settings.mllm_base_url is None else None
        return ResolvedModel(manifest, provider, settings.mllm_model or manifest.model or name, settings.mllm_base_url)
    provider, _, model = name.partition(":")
    if not (provider and model):
        close = get_close_matches(name, manifests, n=3, cutoff=0.5)
        names = f"Did you mean {' or '.join(close)}?" if close else f"Manifests: {', '.join(manifests)}."
        raise ReaderUnavailable(f"COW_MLLM={name!r} is no manifest and not provider:model. {names}")
    return ResolvedModel(manifest_for(model), provider, settings.mllm_model or model, settings.mllm_base_url)


def mllm_manifests() -> dict[str, Manifest]:
    """The manifests of multimodal LLMs by name."""
    return {name: manifest for name, manifest in load_manifests().items() if manifest.role == "mllm"}


def manifest_for(model: str) -> Manifest:
    """The manifest of a model by the name under which it is served; the generic one where none describes it."""
    manifests = mllm_manifests()
    for manifest in manifests.values():
        patterns = (manifest.model or manifest.name, *manifest.also)
        if any(fnmatchcase(model.lower(), pattern.lower()) for pattern in patterns):
            return manifest
    return manifests[UNKNOWN]


class MllmNotes:
    """What is kept of one model on one server, in files: what its server takes, and how far its readings are off."""

    def __init__(self, data_dir: Path, server: str, model: str) -> None:
        name = hashlib.sha256(f"{server}\n{model}".encode()).hexdigest()[:16]
        self._takes, self._measured = (data_dir / "mllm" / f"{name}.{kind}.json" for kind in ("takes", "measured"))

    @property
    def takes(self) -> ServerCapabilities | None:
        """What was learned in the last week; None: nothing."""
        with suppress(OSError):
            if time.time() - self._takes.stat().st_mtime < MAX_AGE_SECONDS:
                return _read(self._takes, ServerCapabilities)
        return None

    @property
    def measured(self) -> MllmMeasurement | None:
        """What a check has measured; None: nothing."""
        return _read(self._measured, MllmMeasurement)

    def keep(self, note: ServerCapabilities | MllmMeasurement) -> None:
        """Replaces what was known. Raises `OSError`."""
        path = self._takes if isinstance(note, ServerCapabilities) else self._measured
        make_private(path.parent)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, encoding="utf-8", delete=False) as part:
            part.write(note.model_dump_json())
        os.replace(part.name, path)


def _read(path: Path, kind: type[Kept]) -> Kept | None:
    """None where there is none, or one of another version."""
    with suppress(OSError, ValueError):
        return kind.model_validate_json(path.read_text(encoding="utf-8"))
    return None


def status_of(settings: Settings) -> MllmStatus | None:
    """The model of the settings; None where they name none that there is."""
    try:
        model = resolve_model(settings)
    except ReaderUnavailable:
        return None
    is_local = settings.reader == "local"
    name, server = (model.manifest.name, "local") if is_local else (model.name, model.server)
    notes = MllmNotes(settings.data_dir, server, name)
    return MllmStatus(name=name, family=model.family.name, takes=notes.takes, measured=notes.measured)
