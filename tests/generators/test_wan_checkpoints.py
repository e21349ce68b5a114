"""Every published form of the weights loads to the same model, and whatever does not fit is refused by name."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from refusals import refused

from cow_service.weights.manifests import load_manifests

if TYPE_CHECKING:
    from torch import Tensor

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

PREFIX = "model.diffusion_model."
SHARD = "diffusion_pytorch_model.safetensors"
ARCHITECTURE = {
    "dim": 24, "ffn_dim": 32, "freq_dim": 32, "in_dim": 36, "num_heads": 2, "num_layers": 2, "out_dim": 16,
    "text_dim": 16,
}  # fmt: skip
TOY = load_manifests()["tiny-ati"].architecture
KEY = "blocks.0.self_attn.q.weight"

Weights = dict[str, "Tensor"]


def loaded(path: Path, dtype: str = "float32", **how: Any) -> Any:
    import toys

    return toys.load_transformer(path, ARCHITECTURE, getattr(toys.torch, dtype), toys.CPU, **how)


@pytest.fixture(scope="module")
def original(toys) -> Weights:
    return toys.original_weights()


@pytest.fixture(scope="module")
def truth(toys, tmp_path_factory: pytest.TempPathFactory) -> Weights:
    return loaded(toys.original_folder(tmp_path_factory.mktemp("truth"))).state_dict()


def same(model: Any, wanted: Weights) -> bool:
    found = model.state_dict()
    return found.keys() == wanted.keys() and all(found[key].equal(wanted[key]) for key in wanted)


def single(folder: Path, weights: Weights, prefix: str = "") -> Path:
    import toys

    toys.save_file({prefix + name: tensor.contiguous() for name, tensor in weights.items()}, folder / "one.safetensors")
    return folder / "one.safetensors"


def test_folders_of_shards_load_to_the_same(toys, tmp_path: Path, truth: Weights) -> None:
    assert same(loaded(toys.original_folder(tmp_path / "sharded", shards=4)), truth)
    model, whole = loaded(toys.original_folder(tmp_path / "original")), tmp_path / "whole"
    model.save_pretrained(whole / "transformer", max_shard_size="1MB")
    assert len(list((whole / "transformer").glob("*.safetensors"))) > 1
    assert same(loaded(whole / "transformer"), truth)
    assert same(loaded(whole), truth)


def test_one_file_loads_to_the_same_in_any_names_and_precision(tmp_path, original, truth) -> None:
    for prefix in ("", PREFIX, "diffusion_model."):
        assert same(loaded(single(tmp_path, original, prefix)), truth)
    assert same(loaded(single(tmp_path, truth)), truth), "in the names of diffusers"
    half = {name: tensor.half() for name, tensor in original.items()}
    assert same(loaded(single(tmp_path, half)), {name: tensor.half().float() for name, tensor in truth.items()})
    found = loaded(single(tmp_path, original), "bfloat16").state_dict()
    precise = ("blocks.0.scale_shift_table", "blocks.0.norm2.weight")
    names = (*precise, "condition_embedder.time_embedder.linear_1.weight", "blocks.0.attn1.to_q.weight")
    assert [str(found[name].dtype) for name in names] == ["torch.float32"] * 3 + ["torch.bfloat16"]


def matrix(name: str, tensor: Tensor) -> bool:
    return name.startswith("blocks.") and tensor.ndim == 2 and name.endswith("weight")


def float8(original: Weights, *, scaled: bool = False) -> Weights:
    """As published: matrices of the blocks in fp8, the rest in half precision.

    Scaled, each with the number that it is multiplied by: its values use the whole range of the type.
    """
    import toys

    small, held = toys.torch.float8_e4m3fn, {name: tensor.half() for name, tensor in original.items()}
    for name, tensor in original.items():
        if matrix(name, tensor):
            scale = tensor.abs().max() / 448 if scaled else toys.torch.ones(())
            held[name] = (tensor / scale).to(small)
            if scaled:
                layer = name.removesuffix("weight")
                held |= {f"{layer}scale_weight": scale.reshape(1), f"{layer}scale_input": toys.torch.ones(1)}
    return held | ({"scaled_fp8": toys.torch.zeros(2, dtype=small)} if scaled else {})


@pytest.mark.skipif(find_spec("torchao") is None, reason="torchao is not installed")
@pytest.mark.parametrize(("scaled", "dtype"), [(True, "bfloat16"), (False, "float32")])
def test_float8_is_kept_where_asked(toys, tmp_path, original, truth, scaled: bool, dtype: str) -> None:
    """It computes what the same checkpoint does in the model's precision, and takes half of bfloat16's memory."""
    from torchao.quantization import Float8Tensor

    file = single(tmp_path, float8(original, scaled=scaled), PREFIX)
    usual, kept, computing = (loaded(file, dtype, keep_float8=how) for how in (None, "stored", "stored-dynamic"))
    for name, tensor in usual.state_dict().items():
        assert (tensor - truth[name]).abs().max() <= 0.07 * truth[name].abs().max(), name
    small = {name for name, weight in kept.named_parameters() if isinstance(weight, Float8Tensor)}
    assert small == {name for name, weight in usual.named_parameters() if matrix(name, weight)}
    assert all(kept.get_parameter(name).qdata.dtype == toys.torch.float8_e4m3fn for name in small)
    assert all(kept.get_parameter(n).dequantize().equal(usual.get_parameter(n)) for n in small), "value by value"
    drawn = toys.torch.Generator().manual_seed(1)
    shapes = {"hidden_states": (36, 2, 4, 4), "encoder_hidden_states": (512, 16)}
    shapes |= {"encoder_hidden_states_image": (17, 1280)}
    given = {name: toys.torch.randn(1, *each, generator=drawn).to(usual.dtype) for name, each in shapes.items()}

    def off(model: Any) -> float:
        time = toys.torch.tensor([500.0])
        with toys.torch.no_grad():
            ours, theirs = (each(timestep=time, **given).sample.float() for each in (model, usual))
        return toys.error(ours, theirs)

    assert off(kept) < (1e-6 if dtype == "float32" else 0.01)
    if dtype == "bfloat16":
        assert 1e-4 < off(computing) < 0.05, "its inputs are rounded to float8, too"


# What does not fit


def assert_refused(path: Path, *named: str) -> None:
    """It is named, without folders of this machine."""
    with refused("checkpoint-invalid") as caught:
        loaded(path)
    assert all(each in caught.value.detail for each in named), caught.value.detail
    assert str(path.parent) not in caught.value.detail


def row_scales(weights: Weights) -> None:
    """They would be multiplied along the wrong side."""
    weights |= float8({KEY: weights[KEY]}) | {KEY.removesuffix("weight") + "scale_weight": weights[KEY][0].clone()}


def without_a_layer(weights: Weights) -> None:
    for name in [name for name in weights if name.startswith("blocks.1.")]:
        del weights[name]


FFN = "blocks.0.ffn.0.weight"
BROKEN: dict[str, tuple[Callable[[Weights], Any], tuple[str, ...]]] = {
    "missing": (lambda w: w.pop(KEY), ("1 missing: blocks.0.attn1.to_q.weight",)),
    "extra": (lambda w: w.update({"blocks.7.surprise.weight": w[KEY]}), ("1 unknown: blocks.7.surprise.weight",)),
    "shape": (lambda w: w.update({FFN: w[FFN].T}), ("blocks.0.ffn.0.weight is [24, 32], not [32, 24]",)),
    "integers": (lambda w: w.update({KEY: w[KEY].char()}), (f"{KEY} is I8",)),
    "orphan scale": (
        lambda w: w.update({"blocks.9.ffn.0.scale_weight": w[KEY][0, :1]}),
        ("1 unknown: blocks.9",),
    ),
    "a scale for each row": (row_scales, ("scale_weight is [24], not one number",)),
    "a whole layer": (without_a_layer, ("blocks.1.", " more")),
    "twice, with and without a prefix": (lambda w: w.update({PREFIX + KEY: w[KEY]}), (KEY,)),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_does_not_fit_is_named(toys, tmp_path: Path, original: Weights, kind: str) -> None:
    breakage, named = BROKEN[kind]
    weights = dict(original)
    breakage(weights)
    weights = {name: tensor.clone().contiguous() for name, tensor in weights.items()}
    assert_refused(toys.original_folder(tmp_path / "folder", weights=weights), *named)
    assert_refused(single(tmp_path, weights), *named)


def test_files_that_are_damaged_or_missing_are_named(toys, tmp_path: Path) -> None:
    shard = toys.original_folder(tmp_path / "cut") / SHARD
    whole = shard.read_bytes()
    for left in (4, 1000, 100_000):
        shard.write_bytes(whole[:left])
        assert_refused(shard.parent, SHARD)
    shard.write_bytes(whole)
    (shard.parent / "z.safetensors").symlink_to(tmp_path / "nowhere")
    assert_refused(shard.parent, "z.safetensors", "unreadable")
    sharded = toys.original_folder(tmp_path / "sharded", shards=3)
    (sharded / "diffusion_pytorch_model-00002-of-00003.safetensors").unlink()
    assert_refused(sharded, "diffusion_pytorch_model-00002-of-00003")
    (tmp_path / "pickles").mkdir()
    toys.torch.save({"w": toys.torch.zeros(2)}, tmp_path / "pickles" / "model.pth")
    for path in (tmp_path / "pickles" / "model.pth", tmp_path / "pickles"):
        assert_refused(path, "model.pth")
    assert_refused(tmp_path / "absent", "absent")
    (tmp_path / "empty").mkdir()
    assert_refused(tmp_path / "empty", "none")


WAN = {**ARCHITECTURE, "_class_name": "WanModel"}
DIFFUSERS = {"_class_name": "WanTransformer3DModel", "in_channels": 36, "image_dim": 9}


@pytest.mark.parametrize(
    ("config", "named"),
    [
        ("{", "config.json"),
        ("[]", "config.json"),
        (WAN | {"num_heads": 0}, "ZeroDivisionError"),
        (WAN | {"num_heads": "2"}, "TypeError"),
        ({"_class_name": "UNet"}, "UNet"),
        (WAN | {"model_type": "t2v"}, "t2v"),
        ({"_class_name": "WanModel", "dim": 24}, "num_heads"),
        (WAN | {"text_len": 77}, "text_len"),
        (DIFFUSERS | {"nonsense": 1}, "nonsense"),
        (DIFFUSERS | {"image_dim": None}, "image_dim"),
        (DIFFUSERS | {"in_channels": 16}, "in_channels"),
        (WAN | {"num_layers": 3}, "blocks.2"),
    ],
)
def test_configurations_that_do_not_fit(toys, tmp_path: Path, config: Any, named: str) -> None:
    folder = toys.original_folder(tmp_path / "some")
    (folder / "config.json").write_text(config if isinstance(config, str) else json.dumps(config))
    assert_refused(folder, named)


# The other parts


def assembled(base: Path, dtype: str = "float32", **sizes: int) -> Any:
    import toys

    transformer = toys.make_tiny({**TOY, **sizes}).transformer
    return toys.assemble(transformer, base, getattr(toys.torch, dtype), toys.torch.float32)


def test_other_parts_load_as_they_were_saved_or_are_named(toys, tmp_path: Path) -> None:
    wanted, base = toys.make_tiny(TOY), tmp_path / "base"
    wanted.save_pretrained(base)
    found = assembled(base)
    for part in ("vae", "text_encoder", "image_encoder"):
        assert same(getattr(found, part), getattr(wanted, part).state_dict()), part
    assert found.embed_text("a ball").equal(wanted.embed_text("a ball"))
    found = assembled(base, "bfloat16")  # in which the image encoder is not run
    assert (str(found.text_encoder.dtype), str(found.image_encoder.dtype)) == ("torch.bfloat16", "torch.float32")
    assert found.embed_image(np.zeros((64, 128, 3), np.uint8), 128, 64, 5).embeds.isfinite().all()

    def assert_refused(*named: str, **sizes: int) -> None:
        with refused("checkpoint-invalid") as caught:
            assembled(base, **sizes)
        assert all(each in caught.value.detail for each in named)
        assert str(base) not in caught.value.detail

    changes: dict[str, Callable[[Weights, str], Any]] = {
        "vae": lambda weights, name: weights.pop(name),
        "text_encoder": lambda weights, name: weights.update(surprise=weights[name][0].clone()),
        "image_encoder": lambda weights, name: weights.update({name: weights[name][:3].clone()}),
    }
    for part, change in changes.items():
        file = next((base / part).glob("*.safetensors"))
        whole, weights = file.read_bytes(), toys.load_file(file)
        change(weights, max((n for n in weights if weights[n].ndim > 1), key=lambda n: weights[n].numel()))
        toys.save_file(weights, file, metadata={"format": "pt"})
        assert_refused(part)
        file.write_bytes(whole)
    file.write_bytes(whole[:100])
    assert_refused(part)
    file.write_bytes(whole)
    assert_refused("text_encoder", "16", "24", text_dim=24)
    (base / "tokenizer").rename(base / "elsewhere")
    assert_refused("tokenizer")


def test_the_sizes_in_the_manifests_are_those_of_the_model(toys) -> None:
    """Parameters are computed from the sizes, on no device at all."""
    for name in ("ati", "wan-move"):
        manifest = load_manifests()[name]
        with toys.torch.device("meta"):
            model = toys.WanTransformer3DModel(**toys.diffusers_config(manifest.architecture))
        assert sum(p.numel() for p in model.parameters()) == manifest.parameters["transformer"]
