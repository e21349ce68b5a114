"""The reader `local`: the same prompts as those of the reader `mllm`, for a model in this process."""

from __future__ import annotations

from cow_service.readers.local.loading import load_local
from cow_service.readers.mllm.client import MllmClient
from cow_service.readers.mllm.models import ConfiguredModel, resolve_model
from cow_service.readers.mllm.reader import MllmReader
from cow_service.settings import Settings
from cow_service.weights.manifests import load_families
from cow_service.weights.repositories import weights_identity


def create(settings: Settings) -> MllmReader:
    """Factory for the registry. Raises `ReaderUnavailable`, `WeightsUnavailable`, `CheckpointInvalid`."""
    model = load_local(settings)
    manifest = resolve_model(settings).manifest
    configured = ConfiguredModel(
        model, manifest.name, manifest, load_families()[manifest.family or ""], model.deterministic
    )
    return MllmReader("local", MllmClient(configured, settings), weights_identity(manifest, settings))
