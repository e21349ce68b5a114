"""A video model that refines the compositor's clip: from full strength, where it is that clip, to none."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from drawn import floor
from filmed import BLUE, RED, World, ignore
from PIL import Image
from refusals import refused

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import CutoutGenerator, CutoutOptions
from cow_service.generators.interventions import with_put
from cow_service.generators.wan.profiles import Sampling, WanOptions
from cow_service.physics.tracks import at_rate
from cow_service.weights.manifests import load_manifests

if TYPE_CHECKING:
    from cow_service.generators.wan.generator import WanGenerator

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

MODELS = load_manifests()


@pytest.fixture
def refine(made) -> WanGenerator:
    return made("tiny-refine")


def clip(made: WanGenerator, given: GeneratorInput, indices: range = range(9), **options: Any) -> np.ndarray:
    return np.stack(list(made.render(replace(given, options=WanOptions(**options)), indices, ignore)))


def shrunk(frame: np.ndarray) -> np.ndarray:
    return cv2.resize(frame, (96, 64), interpolation=cv2.INTER_AREA)


def test_at_full_strength_the_clip_is_the_compositors_nearest_in_time(toys, refine, scene) -> None:
    """Of the model's 24 frames a second, at the 16 a second of a request; no pass is made."""
    own = replace(scene, trajectory=at_rate(scene.trajectory, 24, 13), options=CutoutOptions())
    drawn = [shrunk(frame) for frame in CutoutGenerator().render(own, range(13), ignore)]
    told: list[float] = []
    given = replace(scene, options=WanOptions(coarse_strength=1.0))
    with toys.after_each_pass(refine, lambda: None) as passes:
        found = list(refine.render(given, range(9), told.append))
    assert not passes
    assert told[-1] == 1
    for index, frame in enumerate(found):
        assert np.array_equal(frame, drawn[min(12, int(index * 1.5 + 0.5))]), index
    info = refine.describe(given)
    assert (info.steps, info.options["coarse_strength"]) == (0, 1)


def test_what_is_put_elsewhere_is_drawn_there_and_refined_from_the_image_on(refine) -> None:
    """The compositor draws it from the image in which it is still where it was: one frame earlier."""
    world = World(floor())
    seen, there = (-0.6, 0.15, 2.6), (0.3, 0.15, 2.4)
    world.ball(seen, RED, path=[seen, there])
    world.block((0.6, 0.15, 3.0), BLUE)
    as_it_is, blank = world.filmed(), World(floor())
    to_x, to_y, to_r = blank.ball(there, RED, path=[(there[0], there[1], there[2] - 0.05 * i) for i in range(9)])
    blank.block((0.6, 0.15, 3.0), BLUE)
    after = as_it_is.trajectory.model_copy(
        update={"paths": blank.filmed().trajectory.paths, "bodies": blank.filmed().trajectory.bodies}
    )
    given = with_put(replace(as_it_is, trajectory=after), as_it_is.trajectory)
    assert with_put(given, after) is given, "nothing is put elsewhere"
    assert given.before is not None
    assert given.grounding.bbox == pytest.approx((to_x - to_r, to_y - to_r, to_x + to_r, to_y + to_r))
    mask = given.scene.mover.full()
    expected = np.hypot(*(np.indices(mask.shape)[::-1] + 0.5 - np.array([to_x, to_y])[:, None, None])) < to_r
    assert np.count_nonzero(mask ^ expected) < 0.06 * np.count_nonzero(expected)
    image = given.scene.image.astype(int)
    reddish = image[..., 0] - image[..., 1] > 60
    assert np.count_nonzero(reddish ^ expected) < 0.06 * np.count_nonzero(expected)
    assert np.array_equal(given.obstacles[0].mask.full(), as_it_is.obstacles[0].mask.full())
    own = replace(given, before=replace(given.before, options=CutoutOptions()))
    first = next(iter(CutoutGenerator().render(own, [0], ignore)))
    assert np.abs(first.astype(int) - image).mean() < 1
    assert np.array_equal(clip(refine, given, range(1), coarse_strength=1.0)[0], shrunk(first))


@pytest.mark.parametrize("solver", ["unipc", "euler"])
def test_what_is_put_back_stays(toys, solver: str) -> None:
    """A model that draws everything to 1, a clip of 0: where it is held, the next step begins with the clip's noise."""
    noise, shape, steps = toys.torch.randn(1, 16, 1, 4, 4), (20, 1, 4, 4), 40
    seen: list[toys.torch.Tensor] = []

    class Draws:
        dtype = toys.torch.float32

        def cache_context(self, name: str) -> Any:
            return nullcontext()

        def _reset_stateful_cache(self) -> None:
            pass

        def __call__(self, hidden_states: Any, timestep: Any, **rest: Any) -> Any:
            latents = hidden_states[:, :16]
            seen.append(latents)
            return ((latents - 1) / (timestep / 1000),)

    moving = toys.torch.ones(1, 1, 1, 4, 4, dtype=toys.torch.bool)
    zeros = toys.torch.zeros
    given = toys.Conditioning(zeros(1, 1, 1), None, None, *zeros(2, *shape), zeros(noise.shape), moving)
    sampling = Sampling.model_validate(
        {"solver": solver, "steps": steps, "shift": 3.0, "guidance_scale": 1.0, "coarse_strength": 0.05,
         "object_strength": 0.5}
    )  # fmt: skip
    toys.denoise(Draws(), toys.CPU, noise, given, sampling, lambda done, total: None)
    schedule = toys.make_schedule(sampling, toys.CPU)
    assert len(seen) == steps - 2
    toys.torch.testing.assert_close(seen[0], noise * float(schedule.sigmas[2]), atol=1e-4, rtol=1e-3)
    held, after = 20 - 2, 20 + 1 - 2  # by the passes that are made
    toys.torch.testing.assert_close(seen[held], noise * float(schedule.sigmas[20]), atol=1e-4, rtol=1e-3)
    sigma, following = float(schedule.sigmas[20]), float(schedule.sigmas[21])
    one_step = noise * following + (1 - following / sigma)  # one step towards 1, from there
    assert (seen[after] - one_step).abs().mean() < 0.03


def test_the_stronger_the_closer_to_the_coarse_clip(toys, refine, scene, monkeypatch) -> None:
    seen, denoise = list[tuple[float, float]](), refine.pipeline.denoise

    def watched(noise: Any, given: Any, sampling: Sampling, on_step: Any) -> Any:
        """Notes squared distances of the latents from the coarse clip's: where something moves, and elsewhere."""
        latents = denoise(noise, given, sampling, on_step)
        assert given.moving is not None
        square, moving = (latents - given.coarse) ** 2, given.moving.expand_as(latents)
        seen.append((float(square[moving].mean()), float(square[~moving].mean())))
        return latents

    monkeypatch.setattr(refine.pipeline, "denoise", watched)
    for coarse, held in ((0.125, 0.0), (0.875, 0.0), (0.125, 0.875), (0.125, 1.0)):
        clip(refine, scene, range(1), steps=8, coarse_strength=coarse, object_strength=held)
    weak, strong, held, complete = seen
    assert sum(strong) < sum(weak)
    assert held[0] < 0.5 * weak[0]
    assert complete[0] == pytest.approx(0, abs=1e-5)
    assert complete[1] > 0.01


def test_cells_that_hold_a_part_of_what_moves(toys) -> None:
    moving = np.zeros((9, 32, 64), bool)
    moving[0, 0, 0] = moving[3, 20, 40] = moving[8, 31, 63] = True
    found = toys.latent_mask(moving, toys.latent_shape(64, 32, 9))[0, 0]
    assert found.nonzero().tolist() == [[0, 0, 0], [1, 2, 5], [2, 3, 7]]


def test_without_a_coarse_clip_it_is_diffusers_own_sampling(toys) -> None:
    """Wan2.2-TI2V: the first latent frame is the picture's and has no noise, and each token carries its noise level."""

    class Spread(toys.FlowMatchEulerDiscreteScheduler):
        """diffusers' Euler solver at the noise levels that ours takes."""

        def set_timesteps(self, num_inference_steps: int, device: Any = None, **rest: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            levels = [1 - i / num_inference_steps for i in range(num_inference_steps)]
            super().set_timesteps(sigmas=levels, device=device)

    pipeline = toys.make_tiny(MODELS["tiny-refine"].architecture)
    width, height, frames, steps = 96, 64, 9, 3
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    drawn, shape = toys.torch.Generator().manual_seed(0), toys.latent_shape(width, height, frames, 48, 16)
    noise = toys.torch.randn(shape, generator=drawn)
    given = toys.Conditioning(
        pipeline.embed_text("a ball"), pipeline.embed_text("bad"), None,
        *[pipeline.embed_image(picture, width, height, frames).condition] * 2,
    )  # fmt: skip
    told: list[int] = []
    sampling = Sampling(solver="euler", steps=steps, shift=5.0, guidance_scale=4.0)
    with toys.torch.no_grad():
        found = pipeline.denoise(noise, given, sampling, lambda done, total: told.append(done))
        pipeline.scheduler = Spread(shift=5.0)
        pipeline.set_progress_bar_config(disable=True)
        expected = pipeline(
            image=Image.fromarray(picture), prompt="a ball", negative_prompt="bad", height=height, width=width,
            num_frames=frames, num_inference_steps=steps, guidance_scale=4.0, latents=noise, output_type="latent",
        ).frames  # fmt: skip
    toys.torch.testing.assert_close(found, expected, atol=2e-5, rtol=1e-4)
    assert told == [1, 2, 3]


def test_a_checkpoint_is_loaded_and_another_kind_refused(toys, tmp_path: Path) -> None:
    architecture, tracked = (MODELS[name].architecture for name in ("tiny-refine", "tiny-ati"))
    pipeline, other = toys.make_tiny(architecture), toys.make_tiny(tracked)
    for part in ("transformer", "vae", "text_encoder", "tokenizer"):
        getattr(pipeline, part).save_pretrained(tmp_path / part)
    loaded = toys.load_transformer(tmp_path, architecture, toys.torch.float32, toys.CPU)
    made = toys.assemble(loaded, tmp_path, toys.torch.float32, toys.torch.float32)
    assert made.image_encoder is None
    assert toys.same(list(pipeline.transformer.parameters()), list(made.transformer.parameters()))
    with refused("checkpoint-invalid"):
        toys.load_transformer(tmp_path, tracked, toys.torch.float32, toys.CPU)
    other.transformer.save_pretrained(tmp_path / "other")
    with refused("checkpoint-invalid"):
        toys.load_transformer(tmp_path / "other", architecture, toys.torch.float32, toys.CPU)
    other.vae.save_pretrained(tmp_path / "vae")
    with refused("checkpoint-invalid") as caught:
        toys.assemble(loaded, tmp_path, toys.torch.float32, toys.torch.float32)
    assert all(each in caught.value.detail for each in ("vae", "16", "48"))


def test_a_rank_is_sent_the_coarse_clip(toys) -> None:
    rand = toys.torch.rand
    two, coarse, moving = rand(2, 48, 1, 2, 2), rand(1, 48, 2, 2, 2), rand(1, 1, 2, 2, 2) > 0.5
    some = toys.Conditioning(rand(1, 512, 4), None, None, *two, coarse, moving)
    given = toys.torch.rand(1, 48, 2, 2, 2)
    noise, back = toys.Share.pack(given, some, Sampling(steps=1, shift=1, guidance_scale=1)).unpack()
    assert noise.equal(given)
    for name, value in vars(some).items():
        assert value is getattr(back, name) is None or toys.torch.equal(value, getattr(back, name)), name
