"""LoRAs in every form in which they are published, added to the weights whole or not at all."""

from __future__ import annotations

import json
from contextlib import nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from refusals import refused

if TYPE_CHECKING:
    from torch import Tensor

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

Tensors = dict[str, "Tensor"]
WIDTH = 24  # of the toy's hidden states


def drawn(*shape: int, seed: int = 0) -> Tensor:
    import toys

    return toys.torch.randn(shape, generator=toys.torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def original() -> Tensors:
    """Pairs in the original's names."""
    down, up = drawn(2, WIDTH), drawn(WIDTH, 2, seed=1)
    wide = (drawn(3, WIDTH, seed=2), drawn(32, 3, seed=3))
    found: Tensors = {}
    for layer, pair in {"0.self_attn.q": (down, up), "1.cross_attn.k_img": (down, up), "2.ffn.0": wide}.items():
        found[f"diffusion_model.blocks.{layer}.lora_down.weight"] = pair[0]
        found[f"diffusion_model.blocks.{layer}.lora_up.weight"] = pair[1]
    return found


@pytest.fixture(scope="module")
def changed(original: Tensors) -> Tensors:
    """What they add."""
    down, up, _, _, wide_down, wide_up = original.values()
    return {
        "blocks.0.attn1.to_q.weight": up @ down,
        "blocks.1.attn2.add_k_proj.weight": up @ down,
        "blocks.2.ffn.net.0.proj.weight": wide_up @ wide_down,
    }


def saved(tensors: Tensors, folder: Path, said: dict[str, str] | None = None) -> Path:
    import toys

    file = folder / "lora.safetensors"
    toys.save_file({name: tensor.clone().contiguous() for name, tensor in tensors.items()}, file, said)
    return file


def assert_adds(tensors: Tensors, folder: Path, expected: Tensors) -> None:
    """To each parameter what is expected, and to no other anything."""
    import toys

    transformer = toys.toy().transformer
    before = {name: weight.clone() for name, weight in transformer.state_dict().items()}
    toys.add_lora(transformer, saved(tensors, folder))
    after = transformer.state_dict()
    assert {name for name in before if not before[name].equal(after[name])} == set(expected)
    for name, change in expected.items():
        toys.torch.testing.assert_close(after[name] - before[name], change, atol=1e-5, rtol=0)


def test_pairs_alpha_and_whole_differences_are_added(toys, tmp_path, original, changed) -> None:
    """As lightx2v's are written: diffusers would leave most of these out without a word."""
    vector, table = toys.torch.linspace(-1, 1, WIDTH), drawn(1, 6, WIDTH)
    whole = {
        "blocks.0.self_attn.q.diff_b": ("blocks.0.attn1.to_q.bias", vector),
        "blocks.0.cross_attn.norm_k_img.diff": ("blocks.0.attn2.norm_added_k.weight", vector),
        "blocks.0.norm3.diff": ("blocks.0.norm2.weight", vector),
        "blocks.0.norm3.diff_b": ("blocks.0.norm2.bias", vector),
        "blocks.0.diff_m": ("blocks.0.scale_shift_table", table),
        "head.diff_m": ("scale_shift_table", table[:, :2]),
        "head.head.diff": ("proj_out.weight", drawn(64, WIDTH)),
        "patch_embedding.diff": ("patch_embedding.weight", drawn(WIDTH, 36, 1, 2, 2)),
        "img_emb.proj.0.diff": ("condition_embedder.image_embedder.norm1.weight", drawn(32)),
        "time_projection.1.diff_b": ("condition_embedder.time_proj.bias", drawn(6 * WIDTH)),
    }
    tensors = original | {f"diffusion_model.{name}": tensor for name, (_, tensor) in whole.items()}
    assert_adds(tensors, tmp_path, changed | dict(whole.values()))
    halved = changed | {"blocks.0.attn1.to_q.weight": changed["blocks.0.attn1.to_q.weight"] / 2}
    alpha = {"diffusion_model.blocks.0.self_attn.q.alpha": toys.torch.tensor(1.0)}  # of a rank of 2
    assert_adds(original | alpha, tmp_path, halved)


def test_a_lora_in_the_names_of_diffusers(tmp_path: Path, original: Tensors) -> None:
    down, up, *_ = original.values()
    tensors = {
        "transformer.blocks.0.attn1.to_q.lora_A.weight": down,
        "transformer.blocks.0.attn1.to_q.lora_B.weight": up,
        "transformer.blocks.0.norm2.diff": down[0],  # which norm this is depends on whose names these are
    }
    assert_adds(tensors, tmp_path, {"blocks.0.attn1.to_q.weight": up @ down, "blocks.0.norm2.weight": down[0]})


@pytest.mark.skipif(find_spec("peft") is None, reason="peft is not installed")
def test_diffusers_and_peft_fuse_to_the_same_weights(toys, tmp_path: Path, original: Tensors) -> None:
    ours, theirs = toys.toy(), toys.toy()
    both = {name: tensor for name, tensor in original.items() if "k_img" not in name}  # they want v_img with k_img
    file = saved(both | {"diffusion_model.blocks.0.self_attn.q.alpha": toys.torch.tensor(1.0)}, tmp_path)
    toys.add_lora(ours.transformer, file)
    theirs.load_lora_weights(str(file), adapter_name="one")
    theirs.fuse_lora(adapter_names=["one"])
    theirs.unload_lora_weights()
    for name, weight in theirs.transformer.state_dict().items():
        toys.torch.testing.assert_close(ours.transformer.state_dict()[name], weight, atol=1e-6, rtol=0)


def test_a_lora_that_does_not_fit_is_named_and_changes_nothing(toys, tmp_path: Path, original: Tensors) -> None:
    transformer = toys.toy().transformer
    before = [weight.clone() for weight in transformer.parameters()]
    down, up, *_ = original.values()
    misfits: list[tuple[Tensors, str]] = [
        ({"blocks.0.foo.lora_down.weight": down}, "blocks.0.foo.weight"),
        ({"blocks.9.norm3.diff": down[0]}, "blocks.9.norm3.weight"),
        ({"text_encoder.q.lora_down.weight": down}, "text_encoder.q.weight"),
        ({"blocks.0.self_attn.q.dora_scale": down[0]}, "dora_scale"),
        ({"blocks.0.self_attn.q.lora_A.weight": down}, "blocks.0.self_attn.q.lora_"),  # a second one
        ({"blocks.0.self_attn.k.lora_down.weight": down}, "blocks.0.attn1.to_k"),
        ({"blocks.0.self_attn.k.alpha": down[0, 0]}, "blocks.0.attn1.to_k"),
        ({"blocks.0.norm3.diff": down[0, :5]}, "blocks.0.norm2.weight"),
        ({"blocks.2.ffn.0.lora_up.weight": up}, "blocks.2.ffn.net.0.proj.weight"),
        ({"blocks.1.norm3.diff": down[0] * float("inf")}, "blocks.1.norm3.diff"),
        ({f"x{i}.diff": down[0] for i in range(5)}, "x0.weight, x1.weight, x2.weight and 2 more"),
    ]
    for some, named in misfits:
        more = {f"diffusion_model.{name}": tensor for name, tensor in some.items()}
        with refused("checkpoint-invalid") as caught:
            toys.add_lora(transformer, saved(original | more, tmp_path))
        assert named in caught.value.detail
    toys.save_file({}, tmp_path / "empty.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"not a checkpoint at all")
    for file, code in (("none", "weights-unavailable"), ("empty", "checkpoint-invalid"), ("bad", "checkpoint-invalid")):
        with refused(code) as caught:
            toys.add_lora(transformer, tmp_path / f"{file}.safetensors")
        assert f"{file}.safetensors" in caught.value.detail
        assert str(tmp_path) not in caught.value.detail
    assert toys.same(list(transformer.parameters()), before)


def test_a_scale_hidden_in_the_metadata_is_refused(toys, tmp_path: Path, original: Tensors) -> None:
    for alpha, pattern, code in ((2, {}, None), (4, {}, "checkpoint-invalid"), (2, {"q": 8}, "checkpoint-invalid")):
        said = {"transformer.r": 2, "transformer.lora_alpha": alpha, "transformer.alpha_pattern": pattern}
        file = saved(original, tmp_path, {"lora_adapter_metadata": json.dumps(said)})
        with nullcontext() if code is None else refused(code):
            toys.add_lora(toys.toy().transformer, file)


@pytest.mark.skipif(find_spec("torchao") is None, reason="torchao is not installed")
def test_a_lora_comes_before_float8(toys, tmp_path: Path, original: Tensors) -> None:
    with refused("generator-unavailable"):
        toys.add_lora(toys.accelerated(fp8="weights"), saved(original, tmp_path))
