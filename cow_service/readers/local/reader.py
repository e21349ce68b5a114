"""The reader `local`: the same prompts as those of the reader `mllm`, for a model in this process.

It is loaded here: its manifest is found, its weights are checked, and foreign errors translated.
"""

import json
import re
import traceback
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import transformers
from pydantic_ai.settings import ModelSettings
from transformers.models.auto.processing_auto import PROCESSOR_MAPPING

from cow_service.errors import CheckpointInvalid, CowError, ReaderUnavailable, listed
from cow_service.readers.local.generation import BatchGenerator
from cow_service.readers.local.model import LocalModel, LocalOptions
from cow_service.readers.local.tiny import make_tiny, still
from cow_service.readers.mllm.client import MllmClient
from cow_service.readers.mllm.known import mllm_manifests, resolve_model
from cow_service.readers.mllm.models import ConfiguredModel
from cow_service.readers.mllm.reader import MllmReader
from cow_service.settings import Settings
from cow_service.weights.device import BUILD_LOCK, choose_device, is_out_of_memory, reason_of
from cow_service.weights.manifests import Manifest, load_families
from cow_service.weights.repositories import verify, weights_identity


def create(settings: Settings) -> MllmReader:
    """Factory for the registry. Raises `ReaderUnavailable`, `WeightsUnavailable`, `CheckpointInvalid`."""
    model = load_local(settings)
    manifest = resolve_model(settings).manifest
    family = load_families()[manifest.family or ""]
    configured = ConfiguredModel(model, manifest.name, manifest, family, model.deterministic)
    # One batch is written and the next one waits; longer waits would only use up COW_MLLM_TIMEOUT.
    most = min(settings.mllm_concurrency, 2 * LocalOptions.model_validate(manifest.local).max_batch)
    client = MllmClient(configured, settings.model_copy(update={"mllm_concurrency": most}))
    return MllmReader("local", client, weights_identity(manifest, settings))


def load_local(settings: Settings) -> LocalModel:
    """The model that `settings.mllm` names. One without sources is made here, at the sizes of its manifest.

    Raises `ReaderUnavailable` for what there is not or this machine cannot do, `WeightsUnavailable` and
    `CheckpointInvalid`.
    """
    manifests, name = mllm_manifests(), settings.mllm
    manifest, own = manifests.get(name or ""), settings.checkpoints.get(name or "")
    if manifest is None or not (own or manifest.sources or manifest.architecture):
        usable = ", ".join(each.name for each in manifests.values() if each.sources or each.architecture)
        fault = f"'{name}' has no weights that run in this process" if name else "No multimodal LLM is chosen"
        raise ReaderUnavailable(
            f"{fault}. Take the reader 'mllm' for one that is served by others, or set COW_MLLM to one of {usable}."
        )
    options = LocalOptions.model_validate(manifest.local)
    places = device_map(settings.device)
    with BUILD_LOCK, _translated(manifest.name):
        if own is None and not manifest.sources:
            model, processor = make_tiny(manifest.architecture)
            torch.nn.Module.to(model, torch.device(places[""] if isinstance(places, dict) else "cuda"))
        else:
            folder = own or verify(manifest.sources["weights"], settings.weights_dir, manifest.name)
            model, processor = _from_folder(folder, manifest, options, places)
        generator = BatchGenerator(model, processor)
    defaults: Any = {name: value for name, value in manifest.defaults.items() if name in ModelSettings.__annotations__}
    return LocalModel(manifest.name, generator, options, ModelSettings(**defaults))


def device_map(device: str) -> str | dict[str, str]:
    """Where the weights go, as accelerate takes it. Raises `ReaderUnavailable` for a GPU that is not here."""
    if device == "auto" and torch.cuda.is_available():
        return "auto"  # over all GPUs that it takes
    return {"": str(choose_device(device, ReaderUnavailable))}


def _from_folder(
    folder: Path, manifest: Manifest, options: LocalOptions, places: str | dict[str, str]
) -> tuple[transformers.PreTrainedModel, transformers.ProcessorMixin]:
    """The model and processor of a checkpoint. Opens safetensors only: a pickle can run code."""
    try:
        kind = str(json.loads((folder / "config.json").read_text(encoding="utf-8"))["model_type"])
        files = sorted(file.name for file in folder.iterdir())
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise CheckpointInvalid(
            f"'{folder.name}' is no folder of a transformers checkpoint: no `config.json` says its `model_type`."
        ) from error
    if not any(name.endswith(".safetensors") for name in files):
        raise CheckpointInvalid(f"'{folder.name}' has no safetensors files, and pickles are never opened.")
    # How places are written goes with the family. Another one's would be read wrong without a sign of it.
    bare_kind, bare_family = (re.sub(r"[^a-z0-9]", "", name.lower()) for name in (kind, manifest.family or ""))
    if not bare_kind.startswith(bare_family):
        raise CheckpointInvalid(
            f"'{folder.name}' is of the type '{kind}', and '{manifest.name}' of the family '{manifest.family}', which "
            f"writes places in its own way. Name it under a manifest of its family in COW_CHECKPOINTS."
        )

    as_it_is: Any = {"local_files_only": True, "trust_remote_code": False}
    config: transformers.PreTrainedConfig = transformers.AutoConfig.from_pretrained(folder, **as_it_is)
    if type(config) in PROCESSOR_MAPPING:
        processor_class: Any = PROCESSOR_MAPPING[type(config)]
        # PIL's image processors everywhere: with torchvision's the same image would give other numbers where that is
        # installed.
        processor = still(processor_class).from_pretrained(folder, backend="pil", **as_it_is)
    else:
        processor = transformers.AutoProcessor.from_pretrained(folder, **as_it_is)
    dtype: Any = options.dtype if options.dtype == "auto" else getattr(torch, options.dtype)
    loaded: Any = transformers.AutoModelForImageTextToText.from_pretrained(
        folder, dtype=dtype, device_map=places, use_safetensors=True, output_loading_info=True, **as_it_is
    )
    model, found = loaded
    # transformers only warns of these, and fills what is missing with random numbers.
    for kind, what in (("missing_keys", "lacks"), ("unexpected_keys", "has, beyond its model,")):
        if names := sorted(found[kind]):
            raise CheckpointInvalid(f"The checkpoint '{folder.name}' {what} {listed(names)}. Download it again.")
    return model, processor


@contextmanager
def _translated(name: str) -> Generator[None]:
    """Whatever transformers, safetensors or PyTorch raise becomes a `CowError` with the reason, without folders."""
    try:
        yield
    except CowError:
        raise
    except Exception as error:
        # The failed frames hold what was half loaded, and live as long as the traceback does.
        traceback.clear_frames(error.__traceback__)
        if is_out_of_memory(error):
            raise ReaderUnavailable(
                f"'{name}' does not fit into memory. Set COW_MLLM to a smaller model, or COW_DEVICE to a larger device."
            ) from error
        kind, remedy = CheckpointInvalid, ""
        if isinstance(error, ImportError):
            kind, remedy = ReaderUnavailable, " Install what it names."
        raise kind(f"'{name}' cannot be loaded: {reason_of(error)}{remedy}") from error
