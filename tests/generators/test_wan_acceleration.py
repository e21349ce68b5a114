"""Every way to run the model faster or smaller, on the real class at toy size; and every reason not to.

Graphics cards are described, never needed: what only they can do is tested as a refusal.
"""

from __future__ import annotations

import gc
import json
import subprocess
import sys
from collections.abc import Iterator
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import AutoencoderKLWan, FlowMatchEulerDiscreteScheduler, WanImageToVideoPipeline, WanTransformer3DModel
from diffusers.models import attention_dispatch
from pydantic import ValidationError
from safetensors.torch import save_file
from torch import Tensor

from cow_service.errors import CheckpointInvalid, GeneratorUnavailable, WeightsUnavailable
from cow_service.generators.wan import acceleration as subject
from cow_service.generators.wan.acceleration import accelerate, cached_pass, reset_cache
from cow_service.generators.wan.capabilities import (
    EXACT_BACKENDS,
    MINIMUM_VERSIONS,
    Capabilities,
    detect_capabilities,
    refusals,
)
from cow_service.generators.wan.checkpoints import add_lora
from cow_service.generators.wan.profiles import Acceleration, profile_of
from cow_service.weights.manifests import load_manifests

pytestmark = pytest.mark.slow

CPU = torch.device("cpu")
WIDTH = 24  # of the toy's hidden states
LAYERS = 3
H200 = Capabilities(
    device="cuda",
    name="NVIDIA H200",
    compute_capability=(9, 0),
    memory=150_000_000_000,
    gpus=8,
    packages=tuple(MINIMUM_VERSIONS),
    compiler=True,
)
BARE = Capabilities(device="cpu", name="x86_64", memory=1, gpus=0, compiler=False)

with_torchao = pytest.mark.skipif(find_spec("torchao") is None, reason="torchao is not installed")
with_accelerate = pytest.mark.skipif(find_spec("accelerate") is None, reason="accelerate is not installed")


@pytest.fixture(autouse=True)
def _same_attention_afterwards() -> Iterator[None]:
    """diffusers' choice of a backend holds for the whole process."""
    registry = attention_dispatch._AttentionBackendRegistry
    before = registry._active_backend
    yield
    registry.set_active_backend(before)


def toy(vae: bool = False) -> WanImageToVideoPipeline:
    """The same weights every time."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        transformer = WanTransformer3DModel(
            num_attention_heads=2, attention_head_dim=WIDTH // 2, in_channels=36, out_channels=16, text_dim=16,
            freq_dim=32, ffn_dim=32, num_layers=LAYERS, image_dim=32, added_kv_proj_dim=WIDTH, rope_max_seq_len=32,
        )  # fmt: skip
        small: Any = {"base_dim": 4, "z_dim": 16, "dim_mult": [1, 1, 1, 1], "num_res_blocks": 1}
        decoder = AutoencoderKLWan(**small, temperal_downsample=[False, True, True]) if vae else None
    return WanImageToVideoPipeline(
        tokenizer=None, text_encoder=None, image_encoder=None, image_processor=None,
        vae=decoder, scheduler=FlowMatchEulerDiscreteScheduler(), transformer=transformer.eval(),
    )  # fmt: skip


def accelerated(**options: Any) -> Any:
    pipeline = toy(vae=options.get("vae_tiling", False))
    accelerate(pipeline, Acceleration(**options), CPU)
    return pipeline.transformer


def forward(transformer: Any, seed: int = 1, time: float = 500.0, branch: str = "cond") -> Tensor:
    """The model's answer to inputs drawn from a seed."""
    drawn = torch.Generator().manual_seed(seed)
    with torch.no_grad(), transformer.cache_context(branch):
        return transformer(
            hidden_states=torch.randn(1, 36, 2, 4, 4, generator=drawn),
            timestep=torch.tensor([time]),
            encoder_hidden_states=torch.randn(1, 512, 16, generator=drawn),
            encoder_hidden_states_image=torch.randn(1, 257, 32, generator=drawn),
            return_dict=False,
        )[0]


def counted(pipeline: WanImageToVideoPipeline) -> list[int]:
    """How often each block has really been computed; to be called before anything is put around the blocks."""
    counts = [0] * LAYERS
    for index, block in enumerate(pipeline.transformer.blocks):

        @wraps(block.forward)  # cache-dit reads its signature
        def computed(*args: Any, _index: int = index, _forward: Any = block.forward, **kwargs: Any) -> Any:
            counts[_index] += 1
            return _forward(*args, **kwargs)

        block.forward = computed
    return counts


CLIP = [(seed, 1000.0 - 100 * seed) for seed in range(1, 6)]


def clip(transformer: Any, branch: str = "cond") -> list[Tensor]:
    return [forward(transformer, seed, time, branch) for seed, time in CLIP]


def same(ours: list[Tensor], theirs: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_every_option_says_what_it_does():
    assert all(len(field.description or "") > 60 for field in Acceleration.model_fields.values())


@pytest.mark.parametrize("bad", [{"cache_threshold": -1}, {"context_parallel": 0}, {"fp8": "int4"}, {"speed": 9}])
def test_unknown_options_are_refused(bad: dict[str, Any]):
    with pytest.raises(ValidationError):
        Acceleration(**bad)


# Attention, tiling


def test_native_attention_changes_nothing():
    assert same(clip(accelerated()), clip(toy().transformer))


def test_another_backend_really_is_used():
    transformer = accelerated(attention="_native_math")
    assert transformer.blocks[0].attn1.processor._attention_backend == "_native_math"
    assert torch.allclose(forward(transformer), forward(toy().transformer), atol=1e-5)


def test_the_vae_tiles_where_asked():
    pipeline = toy(vae=True)
    accelerate(pipeline, Acceleration(), CPU)
    assert not pipeline.vae.use_tiling
    pipeline = toy(vae=True)
    accelerate(pipeline, Acceleration(vae_tiling=True), CPU)
    assert pipeline.vae.use_tiling


# Caches

FIRST_BLOCK = {"cache": "first-block", "cache_threshold": 1e9}


def test_a_cache_that_allows_no_change_is_exact():
    assert same(clip(accelerated(**{**FIRST_BLOCK, "cache_threshold": 0.0})), clip(toy().transformer))


def test_a_cache_skips_blocks():
    pipeline = toy()
    counts = counted(pipeline)
    accelerate(pipeline, Acceleration(**FIRST_BLOCK), CPU)
    frames = clip(pipeline.transformer)
    assert counts == [5, 1, 1], "the first block decides, the others run in the first step only"
    assert torch.equal(frames[0], clip(toy().transformer)[0])
    assert not torch.equal(frames[1], clip(toy().transformer)[1])


def test_nothing_of_one_clip_enters_the_next():
    transformer = accelerated(**FIRST_BLOCK)
    first = clip(transformer)
    reset_cache(transformer)
    assert same(clip(transformer), first)
    reset_cache(transformer)
    forward(transformer, seed=1)
    reset_cache(transformer)  # after a clip that was stopped in the middle
    assert torch.equal(forward(transformer, seed=9), forward(toy().transformer, seed=9))


def test_guidance_branches_do_not_mix():
    alone, plain, both = (accelerated(**FIRST_BLOCK) for _ in range(3))
    mixed = [
        (forward(both, seed, time), forward(both, seed + 50, time, "uncond")) for seed, time in CLIP
    ]  # as in a step: one branch after the other
    assert same([cond for cond, _ in mixed], clip(alone))
    assert same([uncond for _, uncond in mixed], [forward(plain, seed + 50, time, "uncond") for seed, time in CLIP])


def test_without_a_cache_there_is_nothing_to_forget():
    transformer = accelerated()
    reset_cache(transformer, 40)
    assert torch.equal(forward(transformer), forward(toy().transformer))


def test_a_pipeline_is_accelerated_once():
    pipeline = toy()
    accelerate(pipeline, Acceleration(**FIRST_BLOCK), CPU)
    with pytest.raises(GeneratorUnavailable, match=r"`cache: first-block` does not work here: .*already been enabled"):
        accelerate(pipeline, Acceleration(**FIRST_BLOCK), CPU)


# MagCache, whose ratios say beforehand which steps are skipped


def test_magcache_skips_by_the_ratios_of_each_pass():
    """The guided pass changes little in the second half of its steps, the other one all the time."""
    ratios = [ratio for step in range(10) for ratio in (0.99 if step >= 5 else 0.5, 0.5)]
    pipeline, plain = toy(), toy()
    counts = counted(pipeline)
    accelerate(pipeline, Acceleration(cache="magcache", cache_threshold=0.1, mag_ratios=tuple(ratios)), CPU)
    transformer = pipeline.transformer

    def clip_of(steps: int, first: int = 0) -> list[list[Tensor]]:
        found: list[list[Tensor]] = []
        for model in (transformer, plain.transformer):
            reset_cache(model, steps, 2, first)
            passes = [(step, branch) for step in range(first, steps) for branch in ("cond", "uncond")]
            made: list[Tensor] = []
            for step, branch in passes:
                with cached_pass(model, branch):
                    made.append(forward(model, 1, 1000.0 - 10 * step, branch))
            reset_cache(model, steps, 2, first)
            found.append(made)
        return found

    for steps, first, skipped in ((10, 0, 4), (20, 0, 8), (10, 4, 4)):
        counts[:] = [0] * LAYERS
        ours, exact = clip_of(steps, first)
        assert counts == [2 * (steps - first) - skipped] * LAYERS, (steps, first)
        assert same(ours[1::2], exact[1::2]), "the unconditional pass is computed each time"
        assert not same(ours[::2], exact[::2])
        assert all(error(mine, theirs) < 0.05 for mine, theirs in zip(ours, exact, strict=True))


def test_the_shipped_ratios_skip_half_of_the_steps():
    """Of 40 steps; a profile that skips nothing, or nearly all, has the ratios of another model."""
    pipeline, wanted = toy(), profile_of(load_manifests()["refine"], "fast-magcache").acceleration
    counts, here = counted(pipeline), {"fp8": "none", "compile": "none", "attention": "native"}
    accelerate(pipeline, wanted.model_copy(update=here), CPU)
    reset_cache(pipeline.transformer, 40, 2)
    for step in range(40):
        for branch in ("cond", "uncond"):
            with cached_pass(pipeline.transformer, branch):
                forward(pipeline.transformer, 1, 1000.0 - step, branch)
    assert 32 <= counts[0] <= 48, counts


@pytest.mark.parametrize(
    "bad", [{"cache": "magcache"}, {"cache": "magcache", "mag_ratios": (1.0,)}, {"mag_ratios": (1.0, 1.0)}]
)
def test_ratios_and_their_cache_go_together(bad: dict[str, Any]):
    with pytest.raises(ValidationError, match="two for each step"):
        Acceleration(**bad)


# DBCache, which counts passes: whole clips

DB = {"cache": "dbcache", "cache_threshold": 1e9}
with_cache_dit = pytest.mark.skipif(find_spec("cache_dit") is None, reason="cache-dit is not installed")


def dbcached(pipeline: Any, steps: int, branches: int = 2, apart: float = 20.0) -> list[Tensor]:
    """The passes of a clip; what is near in time is near in its inputs, as in a real one."""
    reset_cache(pipeline.transformer, steps, branches)
    found: list[Tensor] = []
    for step in range(steps):
        for branch in ("cond", "uncond")[:branches]:
            seed = 1 if branch == "cond" else 2
            found.append(forward(pipeline.transformer, seed, 1000.0 - apart * step, branch))
    reset_cache(pipeline.transformer, steps, branches)
    return found


@with_cache_dit
def test_dbcache_skips_blocks_within_its_limits_and_forgets_between_clips():
    pipeline, plain = toy(), toy()
    counts = counted(pipeline)
    accelerate(pipeline, Acceleration(**DB), CPU)
    for steps, branches, computed in ((10, 2, 8), (5, 1, 2), (10, 2, 8)):
        counts[:] = [0] * LAYERS
        found, wanted = dbcached(pipeline, steps, branches), dbcached(plain, steps, branches)
        assert counts == [steps * branches, computed, computed], (steps, branches)
        warm = -(-steps // 5) * branches
        assert same(found[:warm], wanted[:warm]), "the first fifth"
        assert not same(found[warm:], wanted[warm:])
        assert all(error(ours, theirs) < 0.05 for ours, theirs in zip(found, wanted, strict=True)), "branches are apart"


@with_cache_dit
def test_dbcache_that_allows_no_change_is_exact():
    exact = toy()
    accelerate(exact, Acceleration(**{**DB, "cache_threshold": 0.0}), CPU)
    assert same(dbcached(exact, 6), dbcached(toy(), 6))


@with_cache_dit
@pytest.mark.parametrize("order", [pytest.param(0, marks=pytest.mark.soak), 1])
def test_dbcache_keeps_nothing_between_clips(order: int):
    def kept() -> int:
        gc.collect()
        # By `type`: `isinstance` asks for `__class__`, at which some objects warn.
        tensors = (each for each in gc.get_objects() if issubclass(type(each), Tensor))
        held = (each for each in tensors if type(each) is not torch.nn.Parameter)
        return sum(each.numel() for each in held if each.shape[-1:] == (WIDTH,))

    pipeline = toy()
    accelerate(pipeline, Acceleration(**DB, cache_taylor_order=order), CPU)
    before = kept()
    dbcached(pipeline, 10)
    assert kept() == before


@with_cache_dit
def test_what_is_extrapolated_is_nearer():
    """A clip whose inputs change evenly: by TaylorSeer the skipped passes follow the change."""
    wanted = dbcached(toy(), 10, 1, apart=0.05)
    off: list[float] = []
    for order in (0, 1):
        pipeline = toy()
        accelerate(pipeline, Acceleration(**DB, cache_taylor_order=order), CPU)
        found = dbcached(pipeline, 10, 1, apart=0.05)
        off.append(sum(error(ours, theirs) for ours, theirs in zip(found, wanted, strict=True)))
    assert 0 < off[1] < off[0]


# Compiled blocks


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, FIRST_BLOCK], ids=["none", "first-block"])
def test_all_blocks_share_one_compiled_graph(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch):
    """Without inductor, whose C++ takes half a minute; what is compiled, and how often, is the same."""
    from torch._dynamo.testing import CompileCounter

    graphs, compiler = CompileCounter(), torch.compile
    torch._dynamo.reset()
    monkeypatch.setattr(torch, "compile", lambda function: compiler(function, backend=graphs, fullgraph=True))
    monkeypatch.setattr(subject, "detect_capabilities", lambda device: BARE.model_copy(update={"compiler": True}))
    transformer = accelerated(compile="regional", **options)
    assert same(clip(transformer), clip(accelerated(**options)))
    reset_cache(transformer)
    assert same(clip(transformer, "uncond"), clip(accelerated(**options)))
    assert graphs.frame_count == 1
    torch._dynamo.reset()


# Float8


def error(ours: Tensor, theirs: Tensor) -> float:
    return ((ours - theirs).norm() / theirs.norm()).item()


@with_torchao
def test_weights_become_float8_in_the_blocks_alone():
    from torchao.quantization import Float8Tensor

    pipeline = toy()
    before = sum(parameter.numel() for parameter in pipeline.transformer.blocks.parameters())
    accelerate(pipeline, Acceleration(fp8="weights"), CPU)
    transformer = pipeline.transformer
    small = {name for name, weight in transformer.named_parameters() if isinstance(weight, Float8Tensor)}
    assert small == {
        f"{name}.weight" for name, layer in transformer.named_modules()
        if isinstance(layer, torch.nn.Linear) and name.startswith("blocks.")
    }  # fmt: skip
    assert len(small) == LAYERS * 12
    assert all(transformer.get_parameter(name).qdata.dtype == torch.float8_e4m3fn for name in small)
    assert sum(parameter.numel() for parameter in transformer.blocks.parameters()) == before
    assert transformer.dtype == torch.float32
    assert 1e-4 < error(forward(transformer), forward(toy().transformer)) < 0.05


@with_torchao
def test_a_cache_skips_float8_blocks_too():
    exact = clip(accelerated(fp8="weights"))
    assert same(clip(accelerated(fp8="weights", **{**FIRST_BLOCK, "cache_threshold": 0.0})), exact)
    assert not same(clip(accelerated(fp8="weights", **FIRST_BLOCK)), exact)


@with_torchao
def test_what_a_library_raises_is_told_with_the_option(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(subject, "detect_capabilities", lambda device: H200)
    with pytest.raises(GeneratorUnavailable, match=r"`fp8: dynamic` does not work here: AssertionError: .*COW_PROFILE"):
        accelerate(toy(), Acceleration(fp8="dynamic"), CPU)


def test_no_folder_is_told(monkeypatch: pytest.MonkeyPatch):
    pipeline = toy()

    def fail(backend: str) -> None:
        raise OSError(f"cannot open /home/secret/lib/kernel.so for {backend}\n  at /home/secret/x.py")

    pipeline.transformer.set_attention_backend = fail
    with pytest.raises(GeneratorUnavailable) as caught:
        accelerate(pipeline, Acceleration(), CPU)
    assert caught.value.detail.startswith("`attention: native` does not work here: OSError: cannot open kernel.so for")
    assert "secret" not in caught.value.detail


# Offloading: the CPU in the place of the GPU.


@with_accelerate
@pytest.mark.parametrize("offload", ["model", "group"])
@pytest.mark.parametrize(
    "options", [{}, FIRST_BLOCK, pytest.param({"fp8": "weights"}, marks=with_torchao)], ids=lambda o: str([*o])
)
def test_offloaded_parts_compute_the_same(offload: str, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch):
    kept = accelerated(**options)
    monkeypatch.setattr(subject, "detect_capabilities", lambda device: H200)
    offloaded = accelerated(offload=offload, **options)
    for _ in range(2):
        assert same(clip(offloaded), clip(kept))
        reset_cache(offloaded)
        reset_cache(kept)


def test_weights_are_pinned_one_by_one(monkeypatch: pytest.MonkeyPatch):
    """Pinned memory needs a GPU, so copies stand for it: each one is complete before the next one is made."""
    block: Any = toy().transformer.blocks[0]
    weights, before = list(block.parameters()), [weight.clone() for weight in block.parameters()]
    pinned: list[Tensor] = []

    def pin_memory(tensor: Tensor) -> Tensor:
        assert all(weight.data_ptr() == copy.data_ptr() for weight, copy in zip(weights, pinned, strict=False))
        pinned.append(tensor.clone())
        return pinned[-1]

    monkeypatch.setattr(Tensor, "pin_memory", pin_memory)
    subject.pin(block)
    assert len(pinned) == len(weights)
    assert [weight.data_ptr() for weight in block.parameters()] == [copy.data_ptr() for copy in pinned]
    assert all(torch.equal(one, other) for one, other in zip(weights, before, strict=True))


# LoRA


def pair(out: int = WIDTH, into: int = WIDTH, rank: int = 2, seed: int = 0) -> tuple[Tensor, Tensor]:
    drawn = torch.Generator().manual_seed(seed)
    return torch.randn(rank, into, generator=drawn), torch.randn(out, rank, generator=drawn)


DOWN, UP = pair()
WIDE_DOWN, WIDE_UP = pair(32, WIDTH, 3, seed=1)
VECTOR = torch.linspace(-1, 1, WIDTH)
ORIGINAL = {
    "diffusion_model.blocks.0.self_attn.q.lora_down.weight": DOWN,
    "diffusion_model.blocks.0.self_attn.q.lora_up.weight": UP,
    "diffusion_model.blocks.1.cross_attn.k_img.lora_down.weight": DOWN,
    "diffusion_model.blocks.1.cross_attn.k_img.lora_up.weight": UP,
    "diffusion_model.blocks.2.ffn.0.lora_down.weight": WIDE_DOWN,
    "diffusion_model.blocks.2.ffn.0.lora_up.weight": WIDE_UP,
}
CHANGED = {
    "blocks.0.attn1.to_q.weight": UP @ DOWN,
    "blocks.1.attn2.add_k_proj.weight": UP @ DOWN,
    "blocks.2.ffn.net.0.proj.weight": WIDE_UP @ WIDE_DOWN,
}


def saved(tensors: dict[str, Tensor], folder: Path, said: dict[str, str] | None = None) -> Path:
    file = folder / "lora.safetensors"
    save_file({name: tensor.clone().contiguous() for name, tensor in tensors.items()}, file, said)
    return file


def changes(tensors: dict[str, Tensor], folder: Path) -> dict[str, Tensor]:
    pipeline = toy()
    before = {name: weight.clone() for name, weight in pipeline.transformer.state_dict().items()}
    add_lora(pipeline.transformer, saved(tensors, folder))
    after = pipeline.transformer.state_dict()
    return {name: after[name] - before[name] for name in before if not torch.equal(before[name], after[name])}


def assert_changed(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert set(found) == set(expected)
    for name, change in expected.items():
        torch.testing.assert_close(found[name], change, atol=1e-5, rtol=0)


def test_a_lora_in_the_original_names(tmp_path: Path):
    assert_changed(changes(ORIGINAL, tmp_path), CHANGED)


def test_a_lora_in_the_names_of_diffusers(tmp_path: Path):
    layer, names = "transformer.blocks.0.attn1.to_q", ("lora_A", "lora_B")
    tensors = {f"{layer}.{name}.weight": tensor for name, tensor in zip(names, (DOWN, UP), strict=True)}
    # Which norm this is depends on whose names these are.
    tensors["transformer.blocks.0.norm2.diff"] = VECTOR
    assert_changed(
        changes(tensors, tmp_path), {"blocks.0.attn1.to_q.weight": UP @ DOWN, "blocks.0.norm2.weight": VECTOR}
    )


def test_a_lora_with_alpha(tmp_path: Path):
    found = changes({**ORIGINAL, "diffusion_model.blocks.0.self_attn.q.alpha": torch.tensor(1.0)}, tmp_path)
    assert_changed(found, {**CHANGED, "blocks.0.attn1.to_q.weight": UP @ DOWN / 2})


def test_a_distilled_lora_with_whole_differences(tmp_path: Path):
    """As lightx2v's are written: diffusers would leave most of these out without a word."""
    table, patch = torch.randn(1, 6, WIDTH), torch.randn(WIDTH, 36, 1, 2, 2)
    whole = {
        "blocks.0.self_attn.q.diff_b": ("blocks.0.attn1.to_q.bias", VECTOR),
        "blocks.1.self_attn.v.diff_b": ("blocks.1.attn1.to_v.bias", VECTOR),
        "blocks.0.self_attn.norm_k.diff": ("blocks.0.attn1.norm_k.weight", VECTOR),
        "blocks.0.cross_attn.norm_k_img.diff": ("blocks.0.attn2.norm_added_k.weight", VECTOR),
        "blocks.0.norm3.diff": ("blocks.0.norm2.weight", VECTOR),
        "blocks.0.norm3.diff_b": ("blocks.0.norm2.bias", VECTOR),
        "blocks.0.diff_m": ("blocks.0.scale_shift_table", table),
        "head.diff_m": ("scale_shift_table", table[:, :2]),
        "head.head.diff": ("proj_out.weight", torch.randn(64, WIDTH)),
        "patch_embedding.diff": ("patch_embedding.weight", patch),
        "img_emb.proj.0.diff": ("condition_embedder.image_embedder.norm1.weight", torch.randn(32)),
        "time_projection.1.diff_b": ("condition_embedder.time_proj.bias", torch.randn(6 * WIDTH)),
    }
    found = changes({**ORIGINAL, **{f"diffusion_model.{k}": tensor for k, (_, tensor) in whole.items()}}, tmp_path)
    assert_changed(found, {**CHANGED, **dict(whole.values())})


@pytest.mark.skipif(find_spec("peft") is None, reason="peft is not installed")
def test_diffusers_own_way_gives_the_same_weights(tmp_path: Path):
    ours, theirs = toy(), toy()
    both = {name: tensor for name, tensor in ORIGINAL.items() if "k_img" not in name}  # it wants v_img with k_img
    file = saved({**both, "diffusion_model.blocks.0.self_attn.q.alpha": torch.tensor(1.0)}, tmp_path)
    add_lora(ours.transformer, file)
    theirs.load_lora_weights(str(file), adapter_name="one")
    theirs.fuse_lora(adapter_names=["one"])
    theirs.unload_lora_weights()
    for name, weight in theirs.transformer.state_dict().items():
        torch.testing.assert_close(ours.transformer.state_dict()[name], weight, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("extra", "reason"),
    [
        ({"diffusion_model.blocks.0.foo.lora_down.weight": DOWN}, "no place for blocks.0.foo.weight"),
        ({"diffusion_model.blocks.9.norm3.diff": VECTOR}, "no place for blocks.9.norm3.weight"),
        ({"text_encoder.q.lora_down.weight": DOWN}, "no place for text_encoder.q.weight"),
        ({"diffusion_model.blocks.0.self_attn.q.dora_scale": VECTOR}, "no place for .*dora_scale"),
        ({"blocks.0.self_attn.q.lora_A.weight": DOWN}, "no place for .*blocks.0.self_attn.q.lora_down.weight"),
        ({f"diffusion_model.x{i}.diff": VECTOR for i in range(5)}, "x0.weight, x1.weight, x2.weight and 2 more"),
        ({"diffusion_model.blocks.0.self_attn.k.lora_down.weight": DOWN}, "half of a pair .* blocks.0.attn1.to_k"),
        ({"diffusion_model.blocks.0.self_attn.k.alpha": torch.tensor(1.0)}, "half of a pair .* blocks.0.attn1.to_k"),
        ({"diffusion_model.blocks.0.norm3.diff": VECTOR[:5]}, "another shape for blocks.0.norm2.weight"),
        ({"diffusion_model.blocks.2.ffn.0.lora_up.weight": UP}, "another shape for blocks.2.ffn.net.0.proj.weight"),
        ({"diffusion_model.blocks.0.norm3.diff": VECTOR * torch.inf}, "infinite or undefined values"),
    ],
)
def test_a_lora_that_does_not_fit_changes_nothing(extra: dict[str, Tensor], reason: str, tmp_path: Path):
    pipeline = toy()
    with pytest.raises(CheckpointInvalid, match=reason):
        add_lora(pipeline.transformer, saved({**ORIGINAL, **extra}, tmp_path))
    assert torch.equal(forward(pipeline.transformer), forward(toy().transformer))


def test_a_file_that_is_no_lora(tmp_path: Path):
    with pytest.raises(WeightsUnavailable, match=r"no LoRA 'none\.safetensors'") as caught:
        add_lora(toy().transformer, tmp_path / "none.safetensors")
    assert str(tmp_path) not in caught.value.detail
    (tmp_path / "bad.safetensors").write_bytes(b"not a checkpoint at all")
    with pytest.raises(CheckpointInvalid, match=r"'bad\.safetensors' is not a readable safetensors file"):
        add_lora(toy().transformer, tmp_path / "bad.safetensors")
    with pytest.raises(CheckpointInvalid, match="no place for an empty one"):
        add_lora(toy().transformer, saved({}, tmp_path))


def test_a_scale_hidden_in_the_metadata(tmp_path: Path):
    for said, refused in (({"r": 2, "lora_alpha": 2}, False), ({"r": 2, "lora_alpha": 4}, True)):
        adapter = json.dumps({f"transformer.{key}": value for key, value in said.items()})
        file = saved(ORIGINAL, tmp_path, {"lora_adapter_metadata": adapter})
        if refused:
            with pytest.raises(CheckpointInvalid, match="scaled by its metadata"):
                add_lora(toy().transformer, file)
        else:
            add_lora(toy().transformer, file)


@with_torchao
def test_a_lora_comes_before_float8(tmp_path: Path):
    pipeline = toy()
    accelerate(pipeline, Acceleration(fp8="weights"), CPU)
    with pytest.raises(GeneratorUnavailable, match="before the weights are made float8"):
        add_lora(pipeline.transformer, saved(ORIGINAL, tmp_path))


# Refusals


def without(*names: str) -> Capabilities:
    return H200.model_copy(update={"packages": tuple(name for name in MINIMUM_VERSIONS if name not in names)})


def with_capability(major: int, minor: int) -> Capabilities:
    return H200.model_copy(update={"name": "GPU", "compute_capability": (major, minor)})


@pytest.mark.parametrize(
    ("options", "machine", "sentence"),
    [
        (
            {"attention": "_flash_3"},
            with_capability(10, 0),
            "attention: '_flash_3' needs another GPU, or only one, and this device is GPU of compute capability 10.0; "
            "choose native.",
        ),
        (
            {"attention": "_flash_3", "context_parallel": 2},
            H200,
            "attention: '_flash_3' needs another GPU, or only one, and this device is NVIDIA H200 of compute "
            "capability 9.0; choose native.",
        ),
        (
            {"compile": "regional"},
            without("triton"),
            "compile: regional needs the package triton 3.0.0 or newer, which is not installed; install it, or choose "
            "none.",
        ),
        (
            {"compile": "regional"},
            BARE,
            "compile: regional needs a C++ compiler and Python's headers; install them, or choose none.",
        ),
        (
            {"cache": "dbcache"},
            without("cache-dit"),
            "cache: dbcache needs the package cache-dit 1.5.0 or newer, which is not installed; install it, or choose "
            "first-block.",
        ),
        (
            {"cache": "first-block", "context_parallel": 2},
            H200,
            "cache: GPUs that share a video would not skip the same steps with first-block; choose none.",
        ),
        (
            {"fp8": "weights"},
            BARE,
            "fp8: weights needs the package torchao 0.15.0 or newer, which is not installed; install it, or choose "
            "none.",
        ),
        (
            {"fp8": "dynamic"},
            with_capability(8, 0),
            "fp8: dynamic needs a GPU of compute capability 8.9 or more, and this device is GPU of compute capability "
            "8.0; choose none.",
        ),
        *(
            (
                {"offload": offload},
                BARE,
                f"offload: {offload} needs a GPU to move weights to, and this device is the CPU; choose none.",
            )
            for offload in ("model", "group")
        ),
        (
            {"context_parallel": 8, "guidance_parallel": True},
            H200,
            "16 GPUs are to share a clip, from that of COW_DEVICE on, and there are 8.",
        ),
        (
            {"context_parallel": 2},
            BARE,
            "context_parallel: 2 needs GPUs, and this device is the CPU; choose 1.",
        ),
    ],
)
def test_what_a_machine_cannot_do_is_said_with_reason_and_remedy(
    options: dict[str, Any], machine: Capabilities, sentence: str
):
    assert refusals(Acceleration(**options), machine) == (sentence,)


@pytest.mark.parametrize(
    "options",
    [
        {"attention": "_flash_3", "compile": "regional", "fp8": "dynamic", "cache": "first-block"},
        {"attention": "sage", "compile": "regional", "fp8": "weights", "offload": "group", "vae_tiling": True},
        {"offload": "model", "fp8": "weights"},
        {"guidance_parallel": True, "context_parallel": 4, "compile": "regional"},
    ],
)
def test_a_good_machine_can_do_it(options: dict[str, Any]):
    assert refusals(Acceleration(**options), H200) == ()


def test_everything_is_refused_at_once_and_nothing_is_changed():
    pipeline = toy()
    with pytest.raises(GeneratorUnavailable) as caught:
        accelerate(pipeline, Acceleration(offload="model", cache="first-block", context_parallel=2), CPU)
    for option in ("offload", "cache", "context_parallel"):
        assert f"{option}: " in caught.value.detail
    assert not pipeline.transformer.is_cache_enabled


def test_a_device_that_is_not_there():
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(GeneratorUnavailable, match="`device: cuda:7` does not work here"):
        accelerate(toy(), Acceleration(), torch.device("cuda:7"))


def test_the_machine_is_seen_as_it_is(monkeypatch: pytest.MonkeyPatch):
    machine = detect_capabilities(CPU)
    assert machine.device == "cpu"
    assert machine.compute_capability is None
    assert machine.memory > 1e8
    assert ("torchao" in machine.packages) == (find_spec("torchao") is not None)
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setenv("PATH", "")
    assert not detect_capabilities(CPU).compiler


def test_an_old_package_counts_as_none(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.metadata.version", lambda name: "0.14.9.post2" if name == "torchao" else "99")
    assert set(detect_capabilities(CPU).packages) == set(MINIMUM_VERSIONS) - {"torchao"}


@pytest.mark.parametrize("name", ["quick", "sage", "sage_hub"])
def test_a_backend_that_diffusers_refuses_is_told_before_weights_are_read(name: str):
    with pytest.raises(GeneratorUnavailable, match=rf"`attention: {name}` does not work here: .*{name}.*COW_PROFILE"):
        subject.check_device(Acceleration(attention=name), CPU)


def test_our_table_is_that_of_diffusers():
    known = {backend.value for backend in attention_dispatch.AttentionBackendName}
    splits = attention_dispatch._AttentionBackendRegistry._supports_context_parallel
    assert set(EXACT_BACKENDS) <= known
    sharing = {name for name, backend in EXACT_BACKENDS.items() if backend.context_parallel}
    assert sharing == splits & set(EXACT_BACKENDS)


@pytest.mark.slow
def test_nothing_optional_is_imported_before_it_is_needed():
    suspects = ("torchao", "peft", "accelerate", "cache_dit")
    code = f"import sys, {subject.__name__}; print(*[m for m in {suspects} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == []
