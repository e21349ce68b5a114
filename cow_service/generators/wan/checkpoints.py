"""Loads Wan transformers and LoRAs from every format in which they are published; refuses what does not fit exactly.

Formats: a diffusers folder; the original folder (class `WanModel`, sharded, original names); one safetensors file in
either naming, in any floating type, fp8 with or without scales, with or without a prefix. Names and shapes are compared
with the model's before a single weight is read. Safetensors only: a pickle can run code, and is never opened.

A LoRA is merged into the weights, so that it costs nothing per step. Distilled LoRAs hold more than pairs of low-rank
matrices: full differences of norms, biases and modulation. diffusers' `load_lora_weights` silently drops those, and
layers that the model lacks with a warning only; here either every tensor of the file is added or the file is refused.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from accelerate import init_empty_weights
from diffusers import WanTransformer3DModel
from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from cow_service.errors import CheckpointInvalid, GeneratorUnavailable, WeightsUnavailable, listed

PREFIXES = ("model.diffusion_model.", "diffusion_model.")  # of names in one-file checkpoints
SCALE = ".scale_weight"  # one number per fp8 weight: its scale
UNUSED = (".scale_input", "scaled_fp8")  # for fp8 arithmetic, and the marker that scales are there
PICKLES = {".pth", ".pt", ".bin", ".ckpt", ".pkl", ".pickle"}
FLOAT8 = {"F8_E4M3", "F8_E5M2"}
FLOATING = {"F64", "F32", "F16", "BF16", *FLOAT8}
IMAGE_DIM = 1280  # of the image encoder, fixed in the original models
IN_CHANNELS = 36  # noise, mask and image
TEXT_LENGTH = 512  # tokens, fixed by the model

Architecture = Mapping[str, Any]


class Entry(NamedTuple):
    """A tensor as its file's header describes it."""

    file: Path
    key: str  # with its prefix
    shape: tuple[int, ...]
    dtype: str


def load_transformer(
    path: Path, architecture: Architecture, dtype: torch.dtype, device: torch.device, *, keep_float8: str | None = None
) -> WanTransformer3DModel:
    """The transformer of a folder or file, in `dtype` (norms and time embedding stay float32), on `device`.

    `keep_float8`, `Acceleration.fp8` where that is "stored" or "stored-dynamic": matrices of the blocks that the
    checkpoint has in float8 stay so.
    `architecture` has the sizes of a file that comes without a `config.json`, named as in the original configuration.
    Raises `CheckpointInvalid` naming every file, name or shape that is wrong.
    """
    folder, files = checkpoint_files(path)
    entries = read_headers(files)
    try:
        with init_empty_weights():
            model = WanTransformer3DModel(**_configuration(folder, architecture))
    except (KeyError, TypeError, ValueError, ZeroDivisionError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise CheckpointInvalid(f"The configuration does not make a Wan transformer: {reason}.") from error
    sources = _match_names(entries, model.state_dict())
    # The weights are read one at a time and file after file, straight to their device.
    precise = tuple(model._keep_in_fp32_modules or ())  # pyright: ignore[reportPrivateUsage] - they stay in float32
    state: dict[str, Tensor] = {}
    for file in files:
        here = [(name, source) for name, source in sources.items() if entries[source].file == file]
        try:
            with safe_open(file, framework="pt", device=str(device)) as opened:
                for name, source in here:
                    entry, tensor = entries[source], opened.get_tensor(entries[source].key)
                    scale = read_scale(source, entries, device)
                    if keep_float8 and entry.dtype in FLOAT8 and len(entry.shape) == 2 and name.startswith("blocks."):
                        state[name] = _keep_in_float8(tensor, scale, dtype, computes=keep_float8 == "stored-dynamic")
                        continue
                    keep = any(part in precise for part in name.split("."))
                    exact = tensor if scale is None else tensor.float() * scale
                    state[name] = exact.to(torch.float32 if keep else dtype)
        except (SafetensorError, OSError) as error:
            raise CheckpointInvalid(f"{file.name} is damaged ({_reason(error)}). Download it again.") from error
    model.load_state_dict(state, strict=True, assign=True)
    cast(Any, model).to(device)  # for the tables of the rotary embedding, which no checkpoint holds
    return model.eval().requires_grad_(False)


def read_scale(source: str, entries: Mapping[str, Entry], device: torch.device) -> Tensor | None:
    """The scale of a weight, which may lie in another file; None if it has none."""
    entry = entries.get(source.removesuffix(".weight") + SCALE) if source.endswith(".weight") else None
    if entry is None:
        return None
    with safe_open(entry.file, framework="pt", device=str(device)) as scales:
        return scales.get_tensor(entry.key).float()


def diffusers_config(architecture: Architecture) -> dict[str, Any]:
    """The model's arguments in diffusers from the names of the original configuration (`dim`, `num_heads`, ...)."""
    if architecture.get("text_len", TEXT_LENGTH) != TEXT_LENGTH:
        raise CheckpointInvalid(f"`text_len` is {architecture['text_len']}: the model takes {TEXT_LENGTH} tokens only.")
    takes_image = architecture.get("model_type", "i2v") == "i2v"
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
        "image_dim": architecture.get("image_dim", IMAGE_DIM) if takes_image else None,
        "added_kv_proj_dim": architecture["dim"] if takes_image else None,
    }


def checkpoint_files(path: Path) -> tuple[Path | None, tuple[Path, ...]]:
    """The folder of a configuration, if any, and the safetensors files. Raises `CheckpointInvalid` if some lack."""
    if path.suffix in PICKLES:
        raise CheckpointInvalid(f"{path.name} is a pickle, which can run code when opened. Use its safetensors form.")
    if path.is_file():
        return None, (path,)
    if not path.is_dir():
        raise CheckpointInvalid(f"There is no checkpoint '{path.name}'. Check COW_CHECKPOINTS.")
    folder = path / "transformer" if (path / "transformer").is_dir() else path
    files = tuple(sorted(folder.glob("*.safetensors")))
    if not files:
        pickles = [file.name for file in sorted(folder.iterdir()) if file.suffix in PICKLES]
        found = f"only pickles ({', '.join(pickles)}), which can run code when opened" if pickles else "none"
        raise CheckpointInvalid(f"'{path.name}' has no safetensors files: {found}.")
    # Every shard that a name like -00001-of-00007 promises must be there.
    present = {file.name for file in files}
    promised: set[str] = set()
    for name in present:
        if numbered := re.fullmatch(r"(.*-)\d+-of-(\d+)\.safetensors", name):
            promised |= {f"{numbered[1]}{i + 1:05d}-of-{numbered[2]}.safetensors" for i in range(int(numbered[2]))}
    if absent := sorted(promised - present):
        raise CheckpointInvalid(f"Shards are missing: {listed(absent)}. Download the checkpoint again.")
    return folder, files


def _configuration(folder: Path | None, architecture: Architecture) -> dict[str, Any]:
    """The model's arguments."""
    file = folder / "config.json" if folder else None
    if file is None or not file.is_file():
        return diffusers_config(architecture)
    config = _json(file)
    kind, model = config.get("_class_name"), architecture.get("model_type", "i2v")
    if kind == "WanTransformer3DModel":
        takes_image = model == "i2v"
        channels = IN_CHANNELS if takes_image else architecture["in_dim"]
        if config.get("in_channels") != channels or (config.get("image_dim") is not None) != takes_image:
            lacking = "takes no image" if takes_image else f"is not of the type '{model}'"
            dim = "no `image_dim`" if takes_image else "it has an `image_dim`"
            raise CheckpointInvalid(f"The model of config.json {lacking}: `in_channels` is not {channels}, or {dim}.")
        return {name: value for name, value in config.items() if not name.startswith("_")}
    if kind == "WanModel":
        if config.get("model_type", model) != model:
            raise CheckpointInvalid(f"`model_type` in config.json is '{config['model_type']}', not '{model}'.")
        return diffusers_config(config)
    raise CheckpointInvalid(f"config.json is of class '{kind}': neither WanModel nor WanTransformer3DModel.")


def _json(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointInvalid(f"{file.name} cannot be read: {_reason(error)}.") from error
    if not isinstance(found, dict):
        raise CheckpointInvalid(f"{file.name} is not a JSON object.")
    return cast("dict[str, Any]", found)


def _reason(error: Exception) -> str:
    """What went wrong, without the path that the operating system adds."""
    return error.strerror or "unreadable" if isinstance(error, OSError) else str(error)


def read_headers(files: Iterable[Path]) -> dict[str, Entry]:
    """What the files hold, by name without the prefix. Raises `CheckpointInvalid` for a file that is damaged."""
    entries: dict[str, Entry] = {}
    for file in files:
        try:
            with safe_open(file, framework="pt") as opened:
                for key in tuple(opened.keys()):
                    prefix = next((prefix for prefix in PREFIXES if key.startswith(prefix)), "")
                    name, part = key.removeprefix(prefix), opened.get_slice(key)
                    if name in entries:
                        raise CheckpointInvalid(f"'{name}' is both in {entries[name].file.name} and in {file.name}.")
                    entries[name] = Entry(file, key, tuple(part.get_shape()), part.get_dtype())
        except (SafetensorError, OSError) as error:
            raise CheckpointInvalid(
                f"{file.name} is cut short or damaged ({_reason(error)}). Download it again."
            ) from error
    return entries


def _match_names(entries: dict[str, Entry], wanted: Mapping[str, Tensor]) -> dict[str, str]:
    """For each of the model's names, the checkpoint's. Raises `CheckpointInvalid` listing all that does not fit."""
    weights = {name for name in entries if not name.endswith((SCALE, *UNUSED))}
    sources = {name: name for name in sorted(weights)}
    if not any(name.startswith("condition_embedder.") for name in weights):  # the original names
        sources = diffusers_names(sources)
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


def _keep_in_float8(weight: Tensor, scale: Tensor | None, dtype: torch.dtype, *, computes: bool) -> Tensor:
    """A weight made of a float8 matrix, with or without a scale, whose values are not rounded again.

    It computes in `dtype`, or `computes` in float8, by rounding what it is multiplied with.
    """
    from torchao.quantization import Float8Tensor, PerTensor  # noqa: PLC0415

    factor = torch.ones((), device=weight.device) if scale is None else scale
    computing: dict[str, Any] = {}
    if computes:
        from torchao.float8.inference import Float8MMConfig  # noqa: PLC0415
        from torchao.quantization.quantize_.common import KernelPreference  # noqa: PLC0415
        from torchao.quantization.quantize_.workflows import QuantizeTensorToFloat8Kwargs  # noqa: PLC0415

        # One scale for a matrix: of torchao's kernels PyTorch's own takes that.
        torch_kernel = KernelPreference.TORCH
        rounding = QuantizeTensorToFloat8Kwargs(granularity=PerTensor(), kernel_preference=torch_kernel)
        computing = {"act_quant_kwargs": rounding, "kernel_preference": torch_kernel}
        computing |= {"mm_config": Float8MMConfig(use_fast_accum=True)}
    scales = factor.float().reshape(1, 1)
    return Float8Tensor(qdata=weight, scale=scales, block_size=list(weight.shape), dtype=dtype, **computing)


def diffusers_names(originals: Iterable[str]) -> dict[str, str]:
    """Names of the original Wan checkpoint by their names in diffusers' model.

    The second and third norm of a block are swapped there. diffusers' converter renames keys and reads no value of
    this model, so names stand in for the tensors.
    """
    return cast("dict[str, str]", convert_wan_transformer_to_diffusers({name: name for name in originals}))


def counted(kinds: Mapping[str, Sequence[str]]) -> str:
    """For an error: how many names there are of each kind, and the first of them; empty if there are none."""
    return "; ".join(f"{len(names)} {kind}: {listed(names)}" for kind, names in kinds.items() if names)


LORA_PREFIXES = ("base_model.model.", "model.", "diffusion_model.", "transformer.")
# How a tensor's name ends, which part of its layer's change it is, and the parameter of the layer that it changes.
ENDS = (
    (".lora_down.weight", "down", ".weight"),
    (".lora_A.weight", "down", ".weight"),
    (".lora_A.default.weight", "down", ".weight"),
    (".lora_up.weight", "up", ".weight"),
    (".lora_B.weight", "up", ".weight"),
    (".lora_B.default.weight", "up", ".weight"),
    (".alpha", "alpha", ".weight"),
    (".diff", "whole", ".weight"),
    (".diff_b", "whole", ".bias"),
    (".lora_B.bias", "whole", ".bias"),
    (".diff_m", "whole", ".modulation"),
)
MAX_LISTED = 3  # names in a message


@dataclass(frozen=True)
class _Change:
    """What is added to one parameter: a whole difference, a low-rank product, or both."""

    whole: Tensor | None = None
    down: Tensor | None = None
    up: Tensor | None = None
    alpha: Tensor | None = None

    def fits(self, parameter: Tensor) -> bool:
        """Whether it is complete and of the parameter's shape."""
        if self.whole is not None and self.whole.shape != parameter.shape:
            return False
        if self.down is None or self.up is None:
            return self.whole is not None and self.down is self.up is self.alpha is None
        product = (self.up.shape[0], *self.down.shape[1:])
        return product == tuple(parameter.shape) and self.up.flatten(1).shape[1] == self.down.shape[0]

    def on(self, device: torch.device) -> Tensor:
        """The difference in float32."""
        total = torch.zeros((), device=device)
        if self.whole is not None:
            total = total + self.whole.to(device, torch.float32)
        if self.down is not None and self.up is not None:
            up, down = self.up.to(device, torch.float32), self.down.to(device, torch.float32)
            factor = 1.0 if self.alpha is None else self.alpha.item() / down.shape[0]
            total = total + factor * (up.flatten(1) @ down.flatten(1)).reshape(up.shape[0], *down.shape[1:])
        return total


@torch.no_grad()
def add_lora(transformer: nn.Module, file: Path) -> None:
    """Adds the LoRA in a safetensors file to the weights of a transformer.

    Before `accelerate`: weights in float8 cannot be added to. Raises `CheckpointInvalid` for a file with a tensor that
    does not belong to the model or has another shape, before anything is changed; `WeightsUnavailable` without a file.
    """
    parameters = dict(transformer.named_parameters())
    if any(type(parameter) is not nn.Parameter or parameter.is_meta for parameter in parameters.values()):
        raise GeneratorUnavailable("A LoRA must be added before the weights are made float8 or offloaded.")
    for name, change in _changes(read_lora(file), parameters, file.name).items():
        parameter = parameters[name]
        parameter.copy_(parameter.float() + change.on(parameter.device))


def read_lora(file: Path) -> dict[str, Tensor]:
    """The tensors of a LoRA whose scale is in its weights."""
    if not file.is_file():
        raise WeightsUnavailable(f"There is no LoRA '{file.name}'. Pull it with `cow models pull`.")
    try:
        with safe_open(file, framework="pt") as opened:
            keys: list[str] = list(opened.keys())
            tensors: dict[str, Tensor] = {key: opened.get_tensor(key) for key in keys}
            said: dict[str, str] = opened.metadata() or {}
        adapter: dict[str, Any] = json.loads(said.get("lora_adapter_metadata", "{}"))
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointInvalid(f"LoRA '{file.name}' is not a readable safetensors file. Pull it again.") from error
    for key, alpha in adapter.items():
        stem = key.removesuffix("lora_alpha")
        if (stem != key and alpha != adapter.get(f"{stem}r")) or (key.endswith("alpha_pattern") and alpha):
            raise CheckpointInvalid(
                f"LoRA '{file.name}' is scaled by its metadata. Save it with the scale in its weights."
            )
    if broken := [key for key, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise CheckpointInvalid(
            f"LoRA '{file.name}' holds infinite or undefined values: {listed(sorted(broken), MAX_LISTED)}."
        )
    return tensors


def _changes(tensors: Mapping[str, Tensor], parameters: Mapping[str, Tensor], file: str) -> dict[str, _Change]:
    """The changes by the name of their parameter. Raises `CheckpointInvalid` if the file does not fit."""
    found: dict[str, dict[str, Tensor]] = {}
    unknown: list[str] = []
    for key, tensor in tensors.items():
        bare = reduce(str.removeprefix, LORA_PREFIXES, key)
        ends = ((bare.removesuffix(end) + parameter, part) for end, part, parameter in ENDS if bare.endswith(end))
        target, part = next(ends, (key, ""))
        layer = found.setdefault(target, {})
        if not part or part in layer:
            unknown.append(key)
        layer[part] = tensor
    names = {target: target for target in found}
    if not names.keys() <= parameters.keys():  # the original's names
        names = {original: name for name, original in diffusers_names(names).items()}
    unknown += [target for target in found if names[target] not in parameters]
    if unknown or not found:
        misplaced = listed(sorted(unknown), MAX_LISTED) or "an empty one"
        raise CheckpointInvalid(f"LoRA '{file}' is not one for this model, which has no place for {misplaced}.")
    changes = {names[target]: _Change(**parts) for target, parts in found.items()}
    if misfits := [name for name, change in changes.items() if not change.fits(parameters[name])]:
        raise CheckpointInvalid(
            f"LoRA '{file}' does not fit this model: half of a pair or another shape for "
            f"{listed(sorted(misfits), MAX_LISTED)}."
        )
    return changes
