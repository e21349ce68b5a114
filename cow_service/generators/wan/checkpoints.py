"""Loads Wan transformers from every format in which their weights are published; refuses what does not fit exactly.

Formats: a diffusers folder; the original folder (class `WanModel`, sharded, original names); one safetensors file in
either naming, in any floating type, fp8 with or without scales, with or without a prefix. Names and shapes are compared
with the model's before a single weight is read. Safetensors only: a pickle can run code, and is never opened.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from accelerate import init_empty_weights
from diffusers import WanTransformer3DModel
from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers
from safetensors import SafetensorError, safe_open
from torch import Tensor

from cow_service.errors import CheckpointInvalid
from cow_service.generators.wan.float8 import held_in_float8
from cow_service.weights.device import listed

PREFIXES = ("model.diffusion_model.", "diffusion_model.")  # of names in one-file checkpoints
SCALE = ".scale_weight"  # one number per fp8 weight: what it is multiplied by
UNUSED = (".scale_input", "scaled_fp8")  # for fp8 arithmetic, and the marker that scales are there
PICKLES = {".pth", ".pt", ".bin", ".ckpt", ".pkl", ".pickle"}
FLOAT8 = {"F8_E4M3", "F8_E5M2"}
FLOATING = {"F64", "F32", "F16", "BF16", *FLOAT8}
IMAGE_DIM = 1280  # of the image encoder, fixed in the original models
IN_CHANNELS = 36  # noise, mask and image
TEXT_LENGTH = 512  # tokens, fixed by the model

Architecture = Mapping[str, Any]


@dataclass(frozen=True)
class _Entry:
    """A tensor as its file's header describes it."""

    file: Path
    key: str  # with its prefix
    shape: tuple[int, ...]
    dtype: str


def load_transformer(
    path: Path, architecture: Architecture, dtype: torch.dtype, device: torch.device, *, keep_float8: bool = False
) -> WanTransformer3DModel:
    """The transformer of a folder or file, in `dtype` (norms and time embedding stay float32), on `device`.

    `keep_float8`: matrices of the blocks that the checkpoint has in float8 stay so, for torchao.
    `architecture` has the sizes of a file that comes without a `config.json`, named as in the original configuration.
    Raises `CheckpointInvalid` naming every file, name or shape that is wrong.
    """
    folder, files = checkpoint_files(path)
    config, original = _configuration(folder, architecture)
    entries = _headers(files)
    model = _empty_model(config)
    sources = _match_names(entries, model.state_dict(), original)
    _load_weights(model, sources, entries, dtype, device, keep_float8)
    return model.eval().requires_grad_(False)


def diffusers_config(architecture: Architecture) -> dict[str, Any]:
    """The model's arguments in diffusers from the names of the original configuration (`dim`, `num_heads`, ...)."""
    if architecture.get("text_len", TEXT_LENGTH) != TEXT_LENGTH:
        raise CheckpointInvalid(f"`text_len` is {architecture['text_len']}: the model takes {TEXT_LENGTH} tokens only.")
    try:
        return {
            "patch_size": (1, 2, 2),
            "num_attention_heads": architecture["num_heads"],
            "attention_head_dim": architecture["dim"] // architecture["num_heads"],
            "in_channels": architecture["in_dim"],
            "out_channels": architecture["out_dim"],
            "text_dim": architecture.get("text_dim", 4096),
            "freq_dim": architecture["freq_dim"],
            "ffn_dim": architecture["ffn_dim"],
            "num_layers": architecture["num_layers"],
            "eps": architecture.get("eps", 1e-6),
            "image_dim": architecture.get("image_dim", IMAGE_DIM),
            "added_kv_proj_dim": architecture["dim"],
        }
    except KeyError as error:
        raise CheckpointInvalid(f"The configuration does not say `{error.args[0]}`.") from error
    except (TypeError, ZeroDivisionError) as error:
        raise CheckpointInvalid(f"The configuration holds sizes that cannot be: {error}.") from error


def checkpoint_files(path: Path) -> tuple[Path | None, tuple[Path, ...]]:
    """The folder of a configuration, where there is one, and the safetensors files in order.

    Raises `CheckpointInvalid` where there are none, or shards are missing. Opens none of them.
    """
    if path.suffix in PICKLES:
        raise CheckpointInvalid(f"{path.name} is a pickle, which can run code when opened. Use its safetensors form.")
    if path.is_file():
        return None, (path,)
    if not path.is_dir():
        raise CheckpointInvalid(f"There is no checkpoint '{path.name}'.")
    folder = path / "transformer" if (path / "transformer").is_dir() else path
    files = tuple(sorted(folder.glob("*.safetensors")))
    if not files:
        pickles = [file.name for file in sorted(folder.iterdir()) if file.suffix in PICKLES]
        found = f"only pickles ({', '.join(pickles)}), which can run code when opened" if pickles else "none"
        raise CheckpointInvalid(f"'{path.name}' has no safetensors files: {found}.")
    _check_shards(folder, files)
    return folder, files


def _check_shards(folder: Path, files: tuple[Path, ...]) -> None:
    """Every shard that the index or a name like -00001-of-00007 promises must be there."""
    present = {file.name for file in files}
    promised: set[str] = set()
    for index in folder.glob("*.safetensors.index.json"):
        promised |= set(_json(index).get("weight_map", {}).values())
    for name in present:
        if numbered := re.fullmatch(r"(.*-)\d+-of-(\d+)\.safetensors", name):
            count = int(numbered[2])
            promised |= {f"{numbered[1]}{i:05d}-of-{numbered[2]}.safetensors" for i in range(1, count + 1)}
    if absent := sorted(promised - present):
        raise CheckpointInvalid(f"Shards are missing: {listed(absent)}. Download the checkpoint again.")


def _configuration(folder: Path | None, architecture: Architecture) -> tuple[dict[str, Any], bool | None]:
    """The model's arguments, and whether names are the original ones; null where only the names can tell."""
    file = folder / "config.json" if folder else None
    if file is None or not file.is_file():
        return diffusers_config(architecture), None
    config = _json(file)
    kind = config.get("_class_name")
    if kind == "WanTransformer3DModel":
        if config.get("in_channels") != IN_CHANNELS or config.get("image_dim") is None:
            raise CheckpointInvalid(
                "The model of config.json takes no image: `in_channels` is not 36, or no `image_dim`."
            )
        return {name: value for name, value in config.items() if not name.startswith("_")}, False
    if kind == "WanModel":
        if config.get("model_type", "i2v") != "i2v":
            raise CheckpointInvalid(
                f"`model_type` in config.json is '{config['model_type']}', not 'i2v': no image input."
            )
        return diffusers_config(config), True
    raise CheckpointInvalid(f"config.json is of class '{kind}': neither WanModel nor WanTransformer3DModel.")


def _json(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointInvalid(f"{file.name} cannot be read: {_reason(error)}.") from error
    if not isinstance(found, dict):
        raise CheckpointInvalid(f"{file.name} is no JSON object.")
    return cast("dict[str, Any]", found)


def _reason(error: Exception) -> str:
    """What went wrong, without the path that the operating system adds."""
    return error.strerror or "unreadable" if isinstance(error, OSError) else str(error)


def _headers(files: Iterable[Path]) -> dict[str, _Entry]:
    """What the files hold, by name without the prefix. Reads headers only."""
    entries: dict[str, _Entry] = {}
    for file in files:
        try:
            with safe_open(file, framework="pt") as opened:
                for key in tuple(opened.keys()):
                    prefix = next((prefix for prefix in PREFIXES if key.startswith(prefix)), "")
                    name, part = key.removeprefix(prefix), opened.get_slice(key)
                    if name in entries:
                        raise CheckpointInvalid(f"'{name}' is both in {entries[name].file.name} and in {file.name}.")
                    entries[name] = _Entry(file, key, tuple(part.get_shape()), part.get_dtype())
        except (SafetensorError, OSError) as error:
            raise CheckpointInvalid(
                f"{file.name} is cut short or damaged ({_reason(error)}). Download it again."
            ) from error
    return entries


def _empty_model(config: dict[str, Any]) -> WanTransformer3DModel:
    try:
        with init_empty_weights():
            return WanTransformer3DModel(**config)
    except (TypeError, ValueError, ZeroDivisionError, RuntimeError) as error:
        raise CheckpointInvalid(f"The configuration does not make a Wan transformer: {error}.") from error


def _match_names(entries: dict[str, _Entry], wanted: Mapping[str, Tensor], original: bool | None) -> dict[str, str]:
    """For each of the model's names, the checkpoint's. Raises `CheckpointInvalid` listing all that does not fit."""
    weights = {name for name in entries if not name.endswith((SCALE, *UNUSED))}
    if original is None:
        original = not any(name.startswith("condition_embedder.") for name in weights)
    sources = diffusers_names(sorted(weights)) if original else {name: name for name in sorted(weights)}
    unknown = sorted(set(sources.values()) - {sources[name] for name in sources.keys() & wanted.keys()})
    unknown += sorted(weights - set(sources.values()))  # two names became one
    unknown += sorted(n for n in entries if n.endswith(SCALE) and n.removesuffix(SCALE) + ".weight" not in weights)
    missing = sorted(wanted.keys() - sources.keys())
    shapes = [
        f"{sources[name]} is {list(entries[sources[name]].shape)}, not {list(tensor.shape)}"
        for name, tensor in wanted.items()
        if name in sources and entries[sources[name]].shape != tuple(tensor.shape)
    ]
    shapes += [
        f"{name} is {list(entry.shape)}, not one number"
        for name, entry in entries.items()
        if name.endswith(SCALE) and math.prod(entry.shape) != 1
    ]
    types = [f"{name} is {entries[name].dtype}" for name in sorted(weights) if entries[name].dtype not in FLOATING]
    misfits = counted({
        "unknown": unknown, "missing": missing, "of another shape": shapes, "not floating-point": types,
    })  # fmt: skip
    if misfits:
        raise CheckpointInvalid(f"The checkpoint does not fit the model. {misfits}.")
    return sources


def _load_weights(
    model: WanTransformer3DModel,
    sources: Mapping[str, str],
    entries: Mapping[str, _Entry],
    dtype: torch.dtype,
    device: torch.device,
    keep_float8: bool,
) -> None:
    """Reads the weights, one at a time and file after file, straight to their device."""
    precise = tuple(model._keep_in_fp32_modules or ())  # pyright: ignore[reportPrivateUsage]
    state: dict[str, Tensor] = {}
    for file in sorted({entry.file for entry in entries.values()}):
        here = [(name, source) for name, source in sources.items() if entries[source].file == file]
        try:
            with safe_open(file, framework="pt", device=str(device)) as opened:
                for name, source in here:
                    entry, tensor = entries[source], opened.get_tensor(entries[source].key)
                    key = source.removesuffix(".weight") + SCALE
                    scale = _scale(entries[key], device) if source.endswith(".weight") and key in entries else None
                    if keep_float8 and entry.dtype in FLOAT8 and len(entry.shape) == 2 and name.startswith("blocks."):
                        state[name] = held_in_float8(tensor, scale, dtype)
                        continue
                    keep = any(part in precise for part in name.split("."))
                    exact = tensor if scale is None else tensor.float() * scale
                    state[name] = exact.to(torch.float32 if keep else dtype)
        except (SafetensorError, OSError) as error:
            raise CheckpointInvalid(f"{file.name} is damaged ({_reason(error)}). Download it again.") from error
    model.load_state_dict(state, strict=True, assign=True)
    cast(Any, model).to(device)  # for the tables of the rotary embedding, which no checkpoint holds


def _scale(entry: _Entry, device: torch.device) -> Tensor:
    with safe_open(entry.file, framework="pt", device=str(device)) as opened:
        return opened.get_tensor(entry.key).float()


def diffusers_names(originals: Iterable[str]) -> dict[str, str]:
    """Names of the original Wan checkpoint by their names in diffusers' model.

    The second and third norm of a block are swapped there. diffusers' converter renames keys and reads no value of
    this model, so names stand in for the tensors.
    """
    return cast("dict[str, str]", convert_wan_transformer_to_diffusers({name: name for name in originals}))


def counted(kinds: Mapping[str, Sequence[str]]) -> str:
    """For an error: how many names there are of each kind, and the first of them; empty where there are none."""
    return "; ".join(f"{len(names)} {kind}: {listed(names)}" for kind, names in kinds.items() if names)
