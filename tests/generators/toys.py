"""Video models at toy size, whole and as bare transformers; and, for tests, all that imports PyTorch.

It takes seconds to import: tests do so in a fixture, whose value is this module.
"""

# ruff: noqa: F401

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKLWan, FlowMatchEulerDiscreteScheduler, WanImageToVideoPipeline, WanTransformer3DModel
from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers
from diffusers.models.attention_dispatch import attention_backend
from golden import figures, image_embeds, original_folder, original_weights, tensors
from safetensors.torch import load_file, save, save_file
from torch import Tensor
from torch.profiler import profile

from cow_service.generators.wan import acceleration, generator, loading, memory, ranks
from cow_service.generators.wan.acceleration import accelerate, pin, reset_cache
from cow_service.generators.wan.capabilities import (
    MINIMUM_VERSIONS,
    Capabilities,
    detect_capabilities,
    refusals,
)
from cow_service.generators.wan.checkpoints import add_lora, diffusers_config, load_transformer
from cow_service.generators.wan.conditioning import ati_condition, wan_move, wan_move_latent
from cow_service.generators.wan.generator import WanGenerator, latent_mask
from cow_service.generators.wan.loading import Weights, assemble
from cow_service.generators.wan.memory import check_machine, need_of, wait_until_done
from cow_service.generators.wan.pipeline import Conditioning, denoise, latent_shape, make_schedule
from cow_service.generators.wan.profiles import Acceleration, Sampling
from cow_service.generators.wan.ranks import Share, Sharing
from cow_service.generators.wan.tiny import make_tiny
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests

CPU = torch.device("cpu")
WIDTH = 24  # of the hidden states
LAYERS = 3
CLIP = [(seed, 1000.0 - 100 * seed) for seed in range(1, 6)]  # inputs of a clip's steps


def model(name: str, folder: Path, **settings: Any) -> WanGenerator:
    """The generator of a manifest, which is made anew; its data is in the folder."""
    create = getattr(loading, f"create_{name.replace('-', '_')}")
    return create(Settings(**{"data_dir": folder, "device": "cpu", "warmup": False, **settings}))


@contextmanager
def after_each_pass(made: WanGenerator, then: Callable[[], object]) -> Iterator[list[Tensor]]:
    """Calls a function after each pass of the transformer; collects what goes into it beside the noise, [20, T, h, w].

    The channels after the 16 of the noise, of a model that has them.
    """
    seen: list[Tensor] = []

    def hook(module: object, args: object, given: dict[str, Any], output: object) -> None:
        seen.append(given["hidden_states"][0, 16:].clone())
        then()

    handle = made.pipeline.transformer.register_forward_hook(hook, with_kwargs=True)
    try:
        yield seen
    finally:
        handle.remove()


def hidden_states() -> int:
    """How many numbers are held in tensors as wide as hidden states, weights aside."""
    gc.collect()
    # By `type`: `isinstance` asks for `__class__`, at which some objects warn.
    every = (each for each in gc.get_objects() if issubclass(type(each), Tensor))
    held = (each for each in every if type(each) is not torch.nn.Parameter and not each.is_meta)
    return sum(each.numel() for each in held if each.shape[-1:] == (WIDTH,))


def toy(vae: bool = False) -> WanImageToVideoPipeline:
    """A pipeline of the transformer, and where wanted the VAE. The same weights every time."""
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
    """The transformer of such a pipeline, with options of `Acceleration`."""
    pipeline = toy()
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
            encoder_hidden_states_image=torch.randn(1, 5, 32, generator=drawn),
            return_dict=False,
        )[0]


def clip(transformer: Any, branch: str = "cond") -> list[Tensor]:
    return [forward(transformer, seed, time, branch) for seed, time in CLIP]


def counted(pipeline: WanImageToVideoPipeline) -> list[int]:
    """How often each block has really been computed; to be called before anything is put around the blocks."""
    counts = [0] * LAYERS
    for index, block in enumerate(pipeline.transformer.blocks):

        @wraps(block.forward)
        def computed(*args: Any, _index: int = index, _forward: Any = block.forward, **kwargs: Any) -> Any:
            counts[_index] += 1
            return _forward(*args, **kwargs)

        block.forward = computed
    return counts


def same(ours: list[Tensor], theirs: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def error(ours: Tensor, theirs: Tensor) -> float:
    """How far off, as a share."""
    return ((ours - theirs).norm() / theirs.norm()).item()


# A clip that several processes share

TINY = load_manifests()["tiny-ati"]
NOISES = {
    tokens: torch.randn(latent_shape(*size), generator=torch.Generator().manual_seed(1))
    for tokens, size in {"even": (96, 64, 9), "odd": (80, 48, 5)}.items()
}


def conditioned(noise: Tensor) -> Conditioning:
    """Both passes differ in text and in condition."""
    drawn = torch.Generator().manual_seed(2)
    sizes: Any = TINY.architecture
    texts = [torch.randn(1, 512, sizes["text_dim"], generator=drawn) for _ in range(2)]
    conditions = [torch.randn(20, *noise.shape[2:], generator=drawn) for _ in range(2)]
    return Conditioning(*texts, torch.randn(1, 17, sizes["image_dim"], generator=drawn), *conditions)


def clip_of(transformer: Any, noise: Tensor, **how: Sharing) -> Tensor:
    """Latents of a clip, shared with other ranks or not."""
    sampling = Sampling(steps=4, shift=5.0, guidance_scale=5.0)
    return denoise(transformer, CPU, noise, conditioned(noise), sampling, lambda done, total: None, **how)


def be_a_rank(folder: str) -> None:
    """One of four processes, two for each pass, which split its tokens: leaves its clips in the folder."""
    # diffusers takes the rank modulo the number of accelerators.
    torch.accelerator.device_count = lambda: 1
    wanted, rank = Acceleration(context_parallel=2, guidance_parallel=True), int(os.environ["RANK"])
    transformer = make_tiny(TINY.architecture).transformer
    store = torch.distributed.FileStore(f"{folder}/store", wanted.ranks)
    sharing = Sharing(transformer, wanted, rank, CPU, store)
    found: list[Tensor] = []
    for noise in NOISES.values():
        sharing.prepare(noise)
        found.append(clip_of(transformer, noise, share=sharing))
    torch.save(found, f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()
