"""The reader `local`: the same questions as the reader `mllm` asks, put to a model in this process."""

from __future__ import annotations

from cow_service.readers.local.loading import load_local
from cow_service.readers.mllm.asking import Asker
from cow_service.readers.mllm.reader import MllmReader
from cow_service.readers.mllm.serving import Served, described
from cow_service.settings import Settings
from cow_service.weights.lock import weights_identity
from cow_service.weights.manifests import load_families


def create(settings: Settings) -> MllmReader:
    """Factory for the registry. Raises `ReaderUnavailable`, `WeightsUnavailable`, `CheckpointInvalid`."""
    model = load_local(settings)
    manifest, _, _ = described(settings)
    served = Served(model, manifest.name, manifest, load_families()[manifest.family or ""])
    return MllmReader("local", Asker(served, settings), weights_identity(manifest, settings))
