"""A video model that refines the compositor's clip: from full strength, where it is that clip, to none."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler
from PIL import Image
from test_wan_generator import simulate

from cow_service.errors import CheckpointInvalid
from cow_service.generators.wan.checkpoints import load_transformer
from cow_service.generators.wan.generator import WanGenerator, latent_mask
from cow_service.generators.wan.loading import assemble
from cow_service.generators.wan.pipeline import Conditioning, denoise, latent_shape, make_schedule
from cow_service.generators.wan.profiles import Sampling
from cow_service.generators.wan.ranks import Share
from cow_service.generators.wan.tiny import make_tiny
from cow_service.records import Simulation
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests

pytestmark = pytest.mark.slow

TOYS = ["tiny-refine", "tiny-ati"]
MODELS = load_manifests()
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Service:
    return Service(Settings(data_dir=tmp_path_factory.mktemp("toys")))


def frames_of(service: Service, simulation: Simulation) -> list[Any]:
    kept = (service.artifacts.read(frame.sha256) for frame in simulation.frames)
    return [cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) for data in kept]


PUT = (
    "If the blue mug is put to the left of the white mug and the yellow ball moves to the right, "
    "will it hit the blue mug?"
)


@pytest.mark.parametrize("question", [None, PUT])
@pytest.mark.parametrize("name", TOYS)
def test_at_full_strength_the_clip_is_the_compositors(toys: Service, name: str, question: str | None) -> None:
    rate, asked = int(MODELS[name].defaults["fps"]), {"video": False} | ({"question": question} if question else {})
    refined = simulate(toys, generator=name, fps=rate, generator_options={"coarse_strength": 1.0}, **asked)
    plain = simulate(toys, generator="cutout", fps=rate, **asked)
    assert (refined.generator.steps, refined.generator.options["coarse_strength"]) == (0, 1)
    pairs = zip(frames_of(toys, refined), frames_of(toys, plain), strict=True)
    for index, (found, expected) in enumerate(pairs):
        height, width = found.shape[:2]
        small = cv2.resize(expected, (width, height), interpolation=cv2.INTER_AREA)
        label = height // 2  # a toy says so itself in the upper half
        assert np.abs(found[label:].astype(int) - small[label:]).max() <= 1, index


def test_frames_are_those_nearest_in_time(toys: Service) -> None:
    """Of a model's 24 a second, at the 16 a second of a request."""
    options = {"coarse_strength": 1.0}
    own = frames_of(toys, simulate(
        toys, generator="tiny-refine", fps=24, num_frames=25, generator_options=options, video=False,
        frames={"indices": list(range(25)), "max_side": None},
    ))  # fmt: skip
    asked = frames_of(toys, simulate(toys, generator="tiny-refine", fps=16, generator_options=options, video=False))
    assert len(asked) == 17
    for index, frame in enumerate(asked):
        near = own[min(24, int(index * 1.5 + 0.5))].astype(int)
        # The world has its own frames at each rate: a pixel at an edge may fall on its other side.
        assert np.count_nonzero(np.abs(frame - near) > 12) <= 1, index
        assert index < 4 or np.abs(frame - own[index].astype(int)).max() > 30, index


@pytest.mark.parametrize("solver", ["unipc", "euler"])
def test_what_is_put_back_stays(solver: str) -> None:
    """A model that draws everything to 1, a clip of 0: where it is held, the next step begins with the clip's noise."""
    noise, shape, steps = torch.randn(1, 16, 1, 4, 4), (20, 1, 4, 4), 40
    seen: list[torch.Tensor] = []

    class Draws:
        dtype = torch.float32

        def cache_context(self, name: str) -> Any:
            return nullcontext()

        def _reset_stateful_cache(self) -> None:
            pass

        def __call__(self, hidden_states: torch.Tensor, timestep: torch.Tensor, **rest: Any) -> Any:
            latents = hidden_states[:, :16]
            seen.append(latents)
            return ((latents - 1) / (timestep / 1000),)

    moving = torch.ones(1, 1, 1, 4, 4, dtype=torch.bool)
    given = Conditioning(
        torch.zeros(1, 1, 1), None, None, torch.zeros(shape), torch.zeros(shape), torch.zeros_like(noise), moving
    )
    sampling = Sampling.model_validate(
        {"solver": solver, "steps": steps, "shift": 3.0, "guidance_scale": 1.0, "coarse_strength": 0.05,
         "object_strength": 0.5}
    )  # fmt: skip
    denoise(Draws(), CPU, noise, given, sampling, lambda done, total: None)
    schedule = make_schedule(sampling, CPU)
    assert len(seen) == steps - 2
    held, after = 20 - 2, 20 + 1 - 2  # by the passes that are made
    torch.testing.assert_close(seen[held], noise * float(schedule.sigmas[20]), atol=1e-4, rtol=1e-3)
    sigma, following = float(schedule.sigmas[20]), float(schedule.sigmas[21])
    one_step = noise * following + (1 - following / sigma)  # one step towards 1, from there
    assert (seen[after] - one_step).abs().mean() < 0.03


def distances(toys: Service, name: str, monkeypatch: pytest.MonkeyPatch, **strengths: float) -> tuple[float, float]:
    """Squared distances of the clip's latents from the coarse clip's: where something moves, and elsewhere."""
    generator = toys.generators.get(name)
    assert isinstance(generator, WanGenerator)
    pipeline, seen = generator.pipeline, list[Any]()
    denoise = pipeline.denoise

    def watched(noise: Any, given: Conditioning, sampling: Sampling, on_step: Any) -> Any:
        latents = denoise(noise, given, sampling, on_step)
        seen.append(((latents - given.coarse) ** 2, given.moving))
        return latents

    monkeypatch.setattr(pipeline, "denoise", watched)
    options = {"steps": 8, "object_strength": 0.0, **strengths}
    simulate(toys, generator=name, video=False, generator_options=options, frames={"indices": [0]})
    ((square, moving),) = seen
    assert moving.any()
    assert not moving.all()
    return float(square[moving.expand_as(square)].mean()), float(square[~moving.expand_as(square)].mean())


@pytest.mark.parametrize("name", TOYS)
def test_the_stronger_the_closer_to_the_coarse_clip(toys: Service, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    grades = (0.125, 0.375, 0.625, 0.875)
    whole = [sum(distances(toys, name, monkeypatch, coarse_strength=grade)) for grade in grades]
    assert whole == sorted(whole, reverse=True)
    held = [distances(toys, name, monkeypatch, coarse_strength=0.125, object_strength=grade)[0] for grade in grades]
    assert held == sorted(held, reverse=True)
    assert held[-1] < 0.5 * held[0]
    complete = distances(toys, name, monkeypatch, coarse_strength=0.125, object_strength=1.0)
    assert complete[0] == pytest.approx(0, abs=1e-5)
    assert complete[1] > 0.01


def test_progress_and_seed(toys: Service) -> None:
    told: list[float] = []
    options = {"steps": 8, "coarse_strength": 0.5}

    def run(seed: int) -> Simulation:
        return simulate(
            toys,
            lambda stage, done: told.append(done) if stage == "generation" else None,
            generator="tiny-refine", seed=seed, video=False, generator_options=options,
        )  # fmt: skip

    first = run(1)
    steps = sorted({round(each, 4) for each in told if 0 < each < 0.95})
    assert [round(0.9 * k / 4, 4) for k in (1, 2, 3, 4)] == [step for step in steps if step <= 0.9]
    assert [f.sha256 for f in run(2).frames] != [f.sha256 for f in first.frames]


def test_cells_that_hold_a_part_of_what_moves() -> None:
    moving = np.zeros((9, 32, 64), bool)
    moving[0, 0, 0] = moving[3, 20, 40] = moving[8, 31, 63] = True
    found = latent_mask(moving, latent_shape(64, 32, 9))[0, 0]
    assert found.nonzero().tolist() == [[0, 0, 0], [1, 2, 5], [2, 3, 7]]


class Spread(FlowMatchEulerDiscreteScheduler):
    """diffusers' Euler solver at the noise levels that ours takes."""

    def set_timesteps(self, num_inference_steps: int, device: Any = None, **rest: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().set_timesteps(sigmas=[1 - i / num_inference_steps for i in range(num_inference_steps)], device=device)


@torch.no_grad()
def test_without_a_coarse_clip_it_is_diffusers_own_sampling() -> None:
    """Wan2.2-TI2V: the first latent frame is the picture's and has no noise, and each token carries its noise level."""
    pipeline = make_tiny(MODELS["tiny-refine"].architecture)
    width, height, frames, steps = 96, 64, 9, 3
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    noise = torch.randn(latent_shape(width, height, frames, 48, 16), generator=torch.Generator().manual_seed(0))
    given = Conditioning(
        pipeline.embed_text("a ball"), pipeline.embed_text("bad"), None,
        *[pipeline.embed_image(picture, width, height, frames).condition] * 2,
    )  # fmt: skip
    told: list[int] = []
    sampling = Sampling(solver="euler", steps=steps, shift=5.0, guidance_scale=4.0)
    found = pipeline.denoise(noise, given, sampling, lambda done, total: told.append(done))
    pipeline.scheduler = Spread(shift=5.0)
    pipeline.set_progress_bar_config(disable=True)
    expected = pipeline(
        image=Image.fromarray(picture), prompt="a ball", negative_prompt="bad", height=height, width=width,
        num_frames=frames, num_inference_steps=steps, guidance_scale=4.0, latents=noise, output_type="latent",
    ).frames  # fmt: skip
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=1e-4)
    assert told == [1, 2, 3]


def test_what_is_decoded_in_bfloat16_is_off_by_less_than_a_grey_level() -> None:
    pipeline = make_tiny(MODELS["tiny-ati"].architecture)
    latents = torch.randn(latent_shape(64, 32, 9), generator=torch.Generator().manual_seed(0))
    exact, found = pipeline.decode(latents).astype(int), pipeline.decode(latents, torch.bfloat16).astype(int)
    assert found.shape == exact.shape == (9, 32, 64, 3)
    assert 0 < np.abs(found - exact).mean() < 1
    assert np.abs(found - exact).max() <= 20
    assert pipeline.vae.dtype == torch.float32


def test_a_checkpoint_is_loaded_and_another_kind_refused(tmp_path: Path) -> None:
    architecture = MODELS["tiny-refine"].architecture
    pipeline = make_tiny(architecture)
    for part in ("transformer", "vae", "text_encoder", "tokenizer"):
        getattr(pipeline, part).save_pretrained(tmp_path / part)
    loaded = load_transformer(tmp_path, architecture, torch.float32, CPU)
    made = assemble(loaded, tmp_path, torch.float32, torch.float32)
    assert made.image_encoder is None
    for ours, theirs in zip(pipeline.transformer.parameters(), made.transformer.parameters(), strict=True):
        assert torch.equal(ours, theirs)
    with pytest.raises(CheckpointInvalid, match="takes no image"):
        load_transformer(tmp_path, MODELS["tiny-ati"].architecture, torch.float32, CPU)
    other = make_tiny(MODELS["tiny-ati"].architecture)
    other.transformer.save_pretrained(tmp_path / "other")
    with pytest.raises(CheckpointInvalid, match="not of the type 'ti2v'"):
        load_transformer(tmp_path / "other", architecture, torch.float32, CPU)
    other.vae.save_pretrained(tmp_path / "vae")
    with pytest.raises(CheckpointInvalid, match="'vae' is 16 wide, and the transformer takes 48"):
        assemble(loaded, tmp_path, torch.float32, torch.float32)


def test_a_rank_is_sent_the_coarse_clip() -> None:
    some = Conditioning(
        torch.rand(1, 512, 4), None, None, torch.rand(48, 1, 2, 2), torch.rand(48, 1, 2, 2), torch.rand(1, 48, 2, 2, 2),
        torch.rand(1, 1, 2, 2, 2) > 0.5,
    )  # fmt: skip
    noise, back = Share.pack(torch.rand(1, 48, 2, 2, 2), some, Sampling(steps=1, shift=1, guidance_scale=1)).unpack()
    assert noise.shape == (1, 48, 2, 2, 2)
    for name, value in vars(some).items():
        assert value is getattr(back, name) is None or torch.equal(value, getattr(back, name)), name
