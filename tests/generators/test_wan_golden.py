"""Numerically equal to the public implementations: tracks, conditions, one forward pass, a whole sampling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from golden import figures, image_embeds, original_folder, tensors

from cow_service.generators.wan.checkpoints import load_transformer
from cow_service.generators.wan.conditioning import ati_condition, wan_move, wan_move_latent
from cow_service.generators.wan.pipeline import Conditioning, WanTrackPipeline, make_schedule
from cow_service.generators.wan.profiles import Sampling
from cow_service.generators.wan.tiny import make_tiny
from cow_service.generators.wan.tracks import Tracks, to_ati_tensor
from cow_service.weights.manifests import load_manifests

CPU = torch.device("cpu")


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((found - wanted).norm() / wanted.norm()).item()


@pytest.mark.parametrize("name", ["ati_a", "ati_b", "ati_c"])
def test_ati_tracks_and_condition(name: str) -> None:
    golden = figures(name)
    width, height = (int(side) for side in golden["image_size"])
    tracks = to_ati_tensor(golden["track121"], width, height)
    np.testing.assert_allclose(tracks, golden["tracks81"], atol=1e-5, rtol=0)
    found = ati_condition(torch.from_numpy(golden["condition_in"]), torch.from_numpy(tracks))
    np.testing.assert_allclose(found.numpy(), golden["condition_out"], atol=1e-5, rtol=0)


def test_wan_move_latent() -> None:
    golden = tensors("wan_move_a")
    found = wan_move_latent(golden["latent_in"], golden["tracks"], golden["visibility"])
    assert torch.equal(found, golden["latent_out"])
    mask = torch.rand(4, *golden["latent_in"].shape[1:])
    plain = torch.cat([mask, golden["latent_in"]])
    tracks = Tracks(golden["tracks"].numpy(), golden["visibility"].numpy())
    guided, unconditional = wan_move(plain, tracks, 8 * plain.shape[3], 8 * plain.shape[2])
    assert torch.equal(guided, torch.cat([mask, golden["latent_out"]]))
    assert torch.equal(unconditional, plain)


def test_the_condition_of_the_sampling() -> None:
    golden = figures("tiny_denoise")
    width, height = (int(side) for side in golden["image_size"])
    tracks = torch.from_numpy(to_ati_tensor(golden["track121"], width, height))
    found = ati_condition(torch.from_numpy(golden["condition_before"]), tracks)
    np.testing.assert_allclose(found.numpy(), golden["condition_after"], atol=1e-5, rtol=0)


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> WanTrackPipeline:
    """The toy transformer of the public implementation, through the public loader from its original form."""
    folder: Path = original_folder(tmp_path_factory.mktemp("original"), shards=3)
    made = make_tiny(load_manifests()["tiny-ati"].architecture)
    made.transformer = load_transformer(folder, {}, torch.float32, CPU)
    return made


def guide() -> Conditioning:
    golden = tensors("tiny_denoise")
    condition = golden["condition_after"]
    return Conditioning(
        golden["prompt_embeds"][None], golden["negative_prompt_embeds"][None], image_embeds(), condition, condition
    )


def test_one_forward_pass(pipeline: WanTrackPipeline) -> None:
    golden = tensors("tiny_denoise")
    with torch.no_grad():
        states = torch.cat([golden["noise"], golden["condition_after"]])[None]
        found = pipeline.transformer(
            hidden_states=states,
            timestep=torch.tensor([500]),
            encoder_hidden_states=golden["prompt_embeds"][None],
            encoder_hidden_states_image=image_embeds(),
        ).sample[0]
    assert relative(found, golden["velocity_t500"]) < 1e-5


def test_the_whole_sampling(pipeline: WanTrackPipeline) -> None:
    golden = tensors("tiny_denoise")
    sampling = Sampling(steps=4, shift=5.0, guidance_scale=5.0)
    heard: list[tuple[int, int]] = []
    found = pipeline.denoise(golden["noise"][None], guide(), sampling, lambda done, steps: heard.append((done, steps)))
    assert relative(found[0], golden["latents_s4_shift5.0_g5.0"]) < 5e-3
    # The schedule is the reference's own, so that far less is lost than the tolerance allows.
    assert relative(found[0], golden["latents_s4_shift5.0_g5.0"]) < 1e-5
    assert heard == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_the_schedule() -> None:
    found = make_schedule(Sampling(steps=4, shift=5.0, guidance_scale=5.0), CPU).timesteps
    assert found.tolist() == tensors("tiny_denoise")["timesteps_s4_shift5.0"].tolist()


@pytest.mark.parametrize(("solver", "steps", "shift"), [("unipc", 100, 12), ("unipc", 40, 1e-9), ("euler", 60, 50)])
def test_steps_whose_times_round_to_the_same(solver: str, steps: int, shift: float) -> None:
    schedule = make_schedule(Sampling(solver=solver, steps=steps, shift=shift, guidance_scale=1.0), CPU)
    sample = torch.ones(1, 1, 1, 2, 2)
    for time in schedule.timesteps:
        sample = schedule.step(torch.zeros_like(sample), time, sample, return_dict=False)[0]
    assert len(schedule.timesteps) == steps
    assert torch.isfinite(sample).all()


def test_without_guidance_each_step_takes_one_pass(pipeline: WanTrackPipeline) -> None:
    golden = tensors("tiny_denoise")
    unguided = Sampling(steps=4, shift=5.0, guidance_scale=1.0)
    passes: list[int] = []
    hook = pipeline.transformer.register_forward_hook(lambda *_: passes.append(1))
    try:
        found = pipeline.denoise(golden["noise"][None], guide(), unguided, lambda done, steps: None)
    finally:
        hook.remove()
    assert len(passes) == 4
    assert relative(found[0], golden["latents_s4_shift5.0_g5.0"]) > 1e-4


def test_wan_move_guides_with_two_conditions(pipeline: WanTrackPipeline) -> None:
    """The unconditional pass sees the plain condition: with it changed, the result changes."""
    golden = tensors("tiny_denoise")
    sampling = Sampling(steps=2, shift=5.0, guidance_scale=5.0)
    seen: list[torch.Tensor] = []
    hook = pipeline.transformer.register_forward_pre_hook(
        lambda module, args, kwargs: seen.append(kwargs["hidden_states"][0, 16:]), with_kwargs=True
    )
    same = guide()
    split = Conditioning(same.prompt, same.negative_prompt, same.image, same.condition, golden["condition_before"])
    try:
        pipeline.denoise(golden["noise"][None], split, sampling, lambda done, steps: None)
    finally:
        hook.remove()
    assert all(torch.equal(condition, golden["condition_after"]) for condition in seen[::2])
    assert all(torch.equal(condition, golden["condition_before"]) for condition in seen[1::2])
