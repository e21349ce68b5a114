"""Where artifacts are kept: in a folder, or in an object store."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from cow_service.media.artifacts import ArtifactStore
from cow_service.media.disk_artifacts import DiskArtifacts
from cow_service.settings import Settings, SettingsError


def open_artifact_store(settings: Settings) -> ArtifactStore:
    """The store of COW_ARTIFACTS. Raises `SettingsError` where its library is missing or cannot be set up."""
    place = settings.artifacts
    if place is None:
        return DiskArtifacts(settings.data_dir / "artifacts")
    if "://" not in place:
        return DiskArtifacts(Path(place).expanduser())
    if find_spec("obstore") is None:
        raise SettingsError(
            f"Bad settings: COW_ARTIFACTS={place!r} needs obstore, not installed: pip install 'cow-service[objects]'."
        )
    from cow_service.media.object_artifacts import ObjectArtifacts  # noqa: PLC0415 - an optional library

    return ObjectArtifacts(place, settings.data_dir / "scratch")
