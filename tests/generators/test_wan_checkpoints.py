"""Every published form of the weights loads to the same model, and whatever does not fit is refused by name."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from golden import original_folder, original_weights
from safetensors.torch import load_file, save_file

from cow_service.errors import CheckpointInvalid
from cow_service.generators.wan.checkpoints import diffusers_config, load_transformer
from cow_service.generators.wan.loading import assemble
from cow_service.generators.wan.tiny import make_tiny
from cow_service.weights.manifests import load_manifests

CPU = torch.device("cpu")
PREFIX = "model.diffusion_model."
SHARD = "diffusion_pytorch_model.safetensors"
ARCHITECTURE = {
    "dim": 24, "ffn_dim": 32, "freq_dim": 32, "in_dim": 36, "num_heads": 2, "num_layers": 2, "out_dim": 16,
    "text_dim": 16,
}  # fmt: skip
TOY = load_manifests()["tiny-ati"].architecture
KEY = "blocks.0.self_attn.q.weight"


def loaded(path: Path, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    return load_transformer(path, ARCHITECTURE, dtype, CPU).state_dict()


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    return loaded(original_folder(tmp_path_factory.mktemp("truth")))


def same(found: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor]) -> bool:
    return found.keys() == wanted.keys() and all(torch.equal(found[key], wanted[key]) for key in wanted)


def single(folder: Path, weights: dict[str, torch.Tensor], prefix: str = "") -> Path:
    save_file({prefix + name: tensor.contiguous() for name, tensor in weights.items()}, folder / "one.safetensors")
    return folder / "one.safetensors"


def test_shards_and_index(tmp_path: Path, truth: dict[str, torch.Tensor]) -> None:
    folder = original_folder(tmp_path / "sharded", shards=4)
    files = sorted(path.name for path in folder.glob("*.safetensors"))
    names = {key: file for file in files for key in load_file(folder / file)}
    (folder / "diffusion_pytorch_model.safetensors.index.json").write_text(json.dumps({"weight_map": names}))
    assert same(loaded(folder), truth)


def test_a_diffusers_folder(tmp_path: Path, truth: dict[str, torch.Tensor]) -> None:
    model = load_transformer(original_folder(tmp_path / "original"), {}, torch.float32, CPU)
    model.save_pretrained(tmp_path / "whole" / "transformer", max_shard_size="1MB")
    assert len(list((tmp_path / "whole" / "transformer").glob("*.safetensors"))) > 1
    assert same(loaded(tmp_path / "whole" / "transformer"), truth)
    assert same(loaded(tmp_path / "whole"), truth)


@pytest.mark.parametrize("prefix", ["", PREFIX, "diffusion_model."])
def test_one_file(tmp_path: Path, truth: dict[str, torch.Tensor], prefix: str) -> None:
    assert same(loaded(single(tmp_path, original_weights(), prefix)), truth)


def test_one_file_in_diffusers_names(tmp_path: Path, truth: dict[str, torch.Tensor]) -> None:
    assert same(loaded(single(tmp_path, truth)), truth)


def test_half_precision(tmp_path: Path, truth: dict[str, torch.Tensor]) -> None:
    half = {name: tensor.half() for name, tensor in original_weights().items()}
    assert same(loaded(single(tmp_path, half)), {name: tensor.half().float() for name, tensor in truth.items()})


def test_fp8(tmp_path: Path, truth: dict[str, torch.Tensor]) -> None:
    """As published: matrices of the blocks in fp8, the rest in half precision."""
    small = {n: t.to(torch.float8_e4m3fn if matrix(n, t) else torch.float16) for n, t in original_weights().items()}
    found = loaded(single(tmp_path, small, PREFIX))
    for name, tensor in truth.items():
        assert (found[name] - tensor).abs().max() <= 0.07 * tensor.abs().max(), name
    assert found["blocks.0.attn1.to_q.weight"].dtype == torch.float32


def test_scaled_fp8(tmp_path: Path, truth: dict[str, torch.Tensor]) -> None:
    """Each fp8 matrix with the number that it is multiplied by: the values use the whole range of the type."""
    held = scaled_float8()
    found = loaded(single(tmp_path, held, PREFIX))
    for name, tensor in truth.items():
        assert (found[name] - tensor).abs().max() <= 0.07 * tensor.abs().max(), name
    unscaled = {n: t for n, t in held.items() if "scale" not in n or n == "scaled_fp8"}
    assert (loaded(single(tmp_path, unscaled))["blocks.0.attn1.to_q.weight"].abs().max() > 400).item()


def scaled_float8() -> dict[str, torch.Tensor]:
    held: dict[str, torch.Tensor] = {"scaled_fp8": torch.zeros(2, dtype=torch.float8_e4m3fn)}
    for name, tensor in original_weights().items():
        if matrix(name, tensor):
            scale = tensor.abs().max() / 448
            held[name] = (tensor / scale).to(torch.float8_e4m3fn)
            held[name.removesuffix("weight") + "scale_weight"] = scale.reshape(1)
            held[name.removesuffix("weight") + "scale_input"] = torch.ones(1)
        else:
            held[name] = tensor.half()
    return held


@pytest.mark.skipif(find_spec("torchao") is None, reason="torchao is not installed")
@pytest.mark.parametrize("is_scaled", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_float8_is_kept_where_asked(tmp_path: Path, is_scaled: bool, dtype: torch.dtype) -> None:
    """It computes what the same checkpoint does in the model's precision, and takes half of bfloat16's memory."""
    from torchao.quantization import Float8Tensor

    held = scaled_float8()
    if not is_scaled:
        held = {n: t.to(torch.float8_e4m3fn if matrix(n, t) else torch.float16) for n, t in original_weights().items()}
    file = single(tmp_path, held, PREFIX)
    kept = load_transformer(file, ARCHITECTURE, dtype, CPU, keep_float8="stored")
    usual = load_transformer(file, ARCHITECTURE, dtype, CPU)
    small = {name for name, weight in kept.named_parameters() if isinstance(weight, Float8Tensor)}
    assert small == {name for name, weight in usual.named_parameters() if matrix(name, weight)}
    assert all(kept.get_parameter(name).qdata.dtype == torch.float8_e4m3fn for name in small)
    assert all(torch.equal(kept.get_parameter(n).dequantize(), usual.get_parameter(n)) for n in small), "value by value"
    drawn = torch.Generator().manual_seed(1)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=drawn).to(dtype)

    given = {
        "hidden_states": random(1, 36, 2, 4, 4),
        "timestep": torch.tensor([500.0]),
        "encoder_hidden_states": random(1, 512, 16),
        "encoder_hidden_states_image": random(1, 17, 1280),
    }
    with torch.no_grad():
        ours, theirs = kept(**given).sample.float(), usual(**given).sample.float()
    assert (ours - theirs).norm() / theirs.norm() < (1e-6 if dtype == torch.float32 else 0.01)
    if dtype == torch.float32:
        return
    computing = load_transformer(file, ARCHITECTURE, dtype, CPU, keep_float8="stored-dynamic")
    with torch.no_grad():
        ours = computing(**given).sample.float()
    assert 1e-4 < (ours - theirs).norm() / theirs.norm() < 0.05, "its inputs are rounded to float8, too"


def matrix(name: str, tensor: torch.Tensor) -> bool:
    return name.startswith("blocks.") and tensor.ndim == 2 and name.endswith("weight")


def test_precision(tmp_path: Path) -> None:
    """What must stay float32 does, whatever the rest is."""
    found = loaded(original_folder(tmp_path), torch.bfloat16)
    assert found["blocks.0.attn1.to_q.weight"].dtype == torch.bfloat16
    for name in (
        "blocks.0.scale_shift_table",
        "blocks.0.norm2.weight",
        "condition_embedder.time_embedder.linear_1.weight",
    ):
        assert found[name].dtype == torch.float32, name


def remove(weights: dict[str, torch.Tensor]) -> None:
    del weights[KEY]


def add(weights: dict[str, torch.Tensor]) -> None:
    weights["blocks.7.surprise.weight"] = torch.zeros(2)


def transpose(weights: dict[str, torch.Tensor]) -> None:
    weights["blocks.0.ffn.0.weight"] = weights["blocks.0.ffn.0.weight"].T.contiguous()


def integers(weights: dict[str, torch.Tensor]) -> None:
    weights[KEY] = weights[KEY].to(torch.int8)


def orphan(weights: dict[str, torch.Tensor]) -> None:
    weights["blocks.9.self_attn.q.scale_weight"] = torch.ones(1)


BROKEN: dict[str, tuple[Callable[[dict[str, torch.Tensor]], None], str]] = {
    "missing": (remove, r"1 missing: blocks\.0\.attn1\.to_q\.weight"),
    "extra": (add, r"1 unknown: blocks\.7\.surprise\.weight"),
    "shape": (transpose, r"of another shape: blocks\.0\.ffn\.0\.weight is \[24, 32\], not \[32, 24\]"),
    "integers": (integers, rf"not floating-point: {KEY} is I8"),
    "orphan scale": (orphan, r"1 unknown: blocks\.9"),
}


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("form", ["folder", "file"])
def test_what_does_not_fit_is_named(tmp_path: Path, kind: str, form: str) -> None:
    breakage, said = BROKEN[kind]
    weights = dict(original_weights())
    breakage(weights)
    path = original_folder(tmp_path, weights=weights) if form == "folder" else single(tmp_path, weights)
    with pytest.raises(CheckpointInvalid, match=said):
        loaded(path)


def test_what_does_not_fit_in_diffusers_names(tmp_path: Path, truth: dict[str, torch.Tensor]) -> None:
    weights = dict(truth)
    add(weights)
    del weights["blocks.0.attn1.to_q.weight"]
    with pytest.raises(CheckpointInvalid, match=r"1 unknown: blocks\.7.*1 missing: blocks\.0\.attn1"):
        loaded(single(tmp_path, weights))


def test_a_whole_layer_that_is_missing_is_noticed(tmp_path: Path) -> None:
    weights = {name: tensor for name, tensor in original_weights().items() if not name.startswith("blocks.1.")}
    with pytest.raises(CheckpointInvalid, match=r"missing: blocks\.1\..* and \d+ more"):
        loaded(single(tmp_path, weights))


def test_the_same_name_with_and_without_prefix(tmp_path: Path) -> None:
    weights = original_weights() | {PREFIX + KEY: original_weights()[KEY].clone()}
    with pytest.raises(CheckpointInvalid, match=KEY):
        loaded(single(tmp_path, weights))


@pytest.mark.parametrize("left", [4, 1000, 100_000])
def test_a_truncated_shard(tmp_path: Path, left: int) -> None:
    folder = original_folder(tmp_path)
    (folder / SHARD).write_bytes((folder / SHARD).read_bytes()[:left])
    with pytest.raises(CheckpointInvalid, match="cut short or damaged"):
        loaded(folder)


def test_a_missing_shard(tmp_path: Path) -> None:
    folder = original_folder(tmp_path, shards=3)
    (folder / "diffusion_pytorch_model-00002-of-00003.safetensors").unlink()
    with pytest.raises(CheckpointInvalid, match=r"Shards are missing: diffusion_pytorch_model-00002"):
        loaded(folder)


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    torch.save({"w": torch.zeros(2)}, tmp_path / "model.pth")
    for path in (tmp_path / "model.pth", tmp_path):
        with pytest.raises(CheckpointInvalid, match="pickle"):
            loaded(path)


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ("{", "config.json cannot be read"),
        ("[]", "config.json is not a JSON object"),
        (
            json.dumps(ARCHITECTURE | {"_class_name": "WanModel", "num_heads": 0}),
            "does not make a Wan transformer: ZeroDivisionError",
        ),
        (
            json.dumps(ARCHITECTURE | {"_class_name": "WanModel", "num_heads": "2"}),
            "does not make a Wan transformer: TypeError",
        ),
        ('{"_class_name": "UNet"}', "UNet"),
        ('{"_class_name": "WanModel", "model_type": "t2v"}', "t2v"),
        ('{"_class_name": "WanModel", "dim": 24}', "num_heads"),
        (json.dumps(ARCHITECTURE | {"_class_name": "WanModel", "text_len": 77}), "text_len"),
        ('{"_class_name": "WanTransformer3DModel", "in_channels": 36, "image_dim": 9, "nonsense": 1}', "nonsense"),
        ('{"_class_name": "WanTransformer3DModel", "in_channels": 16}', "takes no image"),
        (json.dumps(ARCHITECTURE | {"_class_name": "WanModel", "num_layers": 3}), r"missing: blocks\.2"),
    ],
)
def test_configurations_that_do_not_fit(tmp_path: Path, config: str, said: str) -> None:
    folder = original_folder(tmp_path)
    (folder / "config.json").write_text(config)
    with pytest.raises(CheckpointInvalid, match=said):
        loaded(folder)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(CheckpointInvalid, match="absent"):
        loaded(tmp_path / "absent")
    with pytest.raises(CheckpointInvalid, match="no safetensors files: none"):
        loaded(tmp_path)


def test_a_scale_for_each_row_is_refused(tmp_path: Path) -> None:
    """It would be multiplied along the wrong side."""
    held = original_weights() | {KEY: original_weights()[KEY].to(torch.float8_e4m3fn)}
    held[KEY.removesuffix("weight") + "scale_weight"] = torch.ones(24)
    with pytest.raises(CheckpointInvalid, match=r"scale_weight is \[24\], not one number"):
        loaded(single(tmp_path, held))


def test_a_shard_that_points_nowhere(tmp_path: Path) -> None:
    folder = original_folder(tmp_path)
    (folder / "z.safetensors").symlink_to(tmp_path / "nowhere")
    with pytest.raises(CheckpointInvalid, match=r"z\.safetensors") as caught:
        loaded(folder)
    assert str(tmp_path) not in caught.value.detail


def test_errors_hold_no_path(tmp_path: Path) -> None:
    folder = original_folder(tmp_path)
    (folder / SHARD).write_bytes(b"12345678")
    with pytest.raises(CheckpointInvalid) as caught:
        loaded(folder)
    assert str(tmp_path) not in caught.value.detail


class TestTheOtherParts:
    @pytest.fixture
    def base(self, tmp_path: Path) -> Path:
        make_tiny(TOY).save_pretrained(tmp_path / "base")
        return tmp_path / "base"

    def transformer(self):
        return make_tiny(TOY).transformer

    def test_they_load_as_they_were_saved(self, base: Path) -> None:
        found = assemble(self.transformer(), base, torch.float32, torch.float32)
        wanted = make_tiny(TOY)
        for part in ("vae", "text_encoder", "image_encoder"):
            assert same(getattr(found, part).state_dict(), getattr(wanted, part).state_dict()), part
        assert torch.equal(found.embed_text("a ball"), wanted.embed_text("a ball"))

    def test_the_image_encoder_is_not_run_in_bfloat16(self, base: Path) -> None:
        found = assemble(self.transformer(), base, torch.bfloat16, torch.float32)
        assert (found.text_encoder.dtype, found.image_encoder.dtype) == (torch.bfloat16, torch.float32)
        assert found.embed_image(np.zeros((64, 128, 3), np.uint8), 128, 64, 5).embeds.isfinite().all()

    @pytest.mark.parametrize("part", ["vae", "text_encoder", "image_encoder"])
    @pytest.mark.parametrize("breakage", ["missing", "unknown", "of another shape", "damaged"])
    def test_what_does_not_fit_is_named(self, base: Path, part: str, breakage: str) -> None:
        file = next((base / part).glob("*.safetensors"))
        weights = load_file(file)
        name = max((n for n in weights if weights[n].ndim > 1), key=lambda n: weights[n].numel())
        if breakage == "missing":
            del weights[name]
        elif breakage == "unknown":
            weights["surprise"] = torch.zeros(2)
        elif breakage == "of another shape":
            weights[name] = torch.zeros(3, 3)
        save_file(weights, file, metadata={"format": "pt"})
        if breakage == "damaged":
            file.write_bytes(file.read_bytes()[:100])
        with pytest.raises(CheckpointInvalid, match=part) as caught:
            assemble(self.transformer(), base, torch.float32, torch.float32)
        assert str(base) not in caught.value.detail

    def test_parts_of_another_width(self, base: Path) -> None:
        wider = TOY | {"text_dim": 24}
        with pytest.raises(CheckpointInvalid, match="'text_encoder' is 16 wide, and the transformer takes 24"):
            assemble(make_tiny(wider).transformer, base, torch.float32, torch.float32)

    def test_a_part_that_is_not_there(self, base: Path) -> None:
        (base / "tokenizer").rename(base / "elsewhere")
        with pytest.raises(CheckpointInvalid, match="tokenizer"):
            assemble(self.transformer(), base, torch.float32, torch.float32)


def test_the_sizes_in_the_manifests_are_those_of_the_model() -> None:
    """Parameters are computed from the sizes, on no device at all."""
    from diffusers import WanTransformer3DModel

    for name in ("ati", "wan-move"):
        manifest = load_manifests()[name]
        with torch.device("meta"):
            model = WanTransformer3DModel(**diffusers_config(manifest.architecture))
        assert sum(p.numel() for p in model.parameters()) == manifest.parameters["transformer"]
