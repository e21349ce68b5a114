"""Numerically equal to the public implementations: tracks, conditions, one forward pass, a whole sampling."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from cow_service.generators.wan.profiles import Sampling
from cow_service.generators.wan.tracks import Tracks, to_ati_tensor
from cow_service.weights.manifests import load_manifests

if TYPE_CHECKING:
    import torch

    from cow_service.generators.wan.pipeline import Conditioning, WanTrackPipeline

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

SAMPLING = Sampling(steps=4, shift=5.0, guidance_scale=5.0)


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return ((found - wanted).norm() / wanted.norm()).item()


@pytest.mark.parametrize("name", ["ati_a", "ati_b", "ati_c"])
def test_ati_tracks_and_condition(toys, name: str) -> None:
    golden = toys.figures(name)
    width, height = (int(side) for side in golden["image_size"])
    tracks = to_ati_tensor(golden["track121"], width, height)
    np.testing.assert_allclose(tracks, golden["tracks81"], atol=1e-5, rtol=0)
    found = toys.ati_condition(toys.torch.from_numpy(golden["condition_in"]), toys.torch.from_numpy(tracks))
    np.testing.assert_allclose(found.numpy(), golden["condition_out"], atol=1e-5, rtol=0)
    rounded = toys.ati_condition(
        toys.torch.from_numpy(golden["condition_in"]).bfloat16(), toys.torch.from_numpy(tracks)
    )
    assert rounded.dtype == toys.torch.bfloat16
    np.testing.assert_allclose(rounded.float().numpy(), golden["condition_out"], atol=3e-2, rtol=3e-2)


def test_wan_move_latent(toys) -> None:
    golden = toys.tensors("wan_move_a")
    found = toys.wan_move_latent(golden["latent_in"], golden["tracks"], golden["visibility"])
    assert toys.torch.equal(found, golden["latent_out"])
    mask = toys.torch.rand(4, *golden["latent_in"].shape[1:])
    plain = toys.torch.cat([mask, golden["latent_in"]])
    tracks = Tracks(golden["tracks"].numpy(), golden["visibility"].numpy())
    guided, unconditional = toys.wan_move(plain, tracks, 8 * plain.shape[3], 8 * plain.shape[2])
    assert toys.torch.equal(guided, toys.torch.cat([mask, golden["latent_out"]]))
    assert toys.torch.equal(unconditional, plain)


@pytest.fixture(scope="module")
def pipeline(toys, tmp_path_factory: pytest.TempPathFactory) -> WanTrackPipeline:
    """The toy transformer of the public implementation, through the public loader from its original form."""
    folder: Path = toys.original_folder(tmp_path_factory.mktemp("original"), shards=3)
    made = toys.make_tiny(load_manifests()["tiny-ati"].architecture)
    made.transformer = toys.load_transformer(folder, {}, toys.torch.float32, toys.torch.device("cpu"))
    return made


@pytest.fixture
def golden(toys) -> dict[str, Any]:
    return toys.tensors("tiny_denoise")


@pytest.fixture
def guide(toys, golden: dict[str, Any]) -> Conditioning:
    condition = golden["condition_after"]
    return toys.Conditioning(
        golden["prompt_embeds"][None], golden["negative_prompt_embeds"][None], toys.image_embeds(), condition, condition
    )


def test_the_condition_of_the_sampling_and_one_forward_pass(toys, pipeline, golden, guide) -> None:
    width, height = (int(side) for side in golden["image_size"])
    tracks = toys.torch.from_numpy(to_ati_tensor(golden["track121"].numpy(), width, height))
    found = toys.ati_condition(golden["condition_before"], tracks)
    np.testing.assert_allclose(found.numpy(), golden["condition_after"], atol=1e-5, rtol=0)
    states = toys.torch.cat([golden["noise"], golden["condition_after"]])[None]
    with toys.torch.no_grad():
        found = pipeline.transformer(states, toys.torch.tensor([500]), guide.prompt, guide.image).sample[0]
    assert relative(found, golden["velocity_t500"]) < 1e-5


def test_the_whole_sampling(pipeline: WanTrackPipeline, golden: dict[str, Any], guide: Conditioning) -> None:
    """The schedule is the reference's own, so that next to nothing is lost."""
    heard: list[tuple[int, int]] = []
    found = pipeline.denoise(golden["noise"][None], guide, SAMPLING, lambda done, steps: heard.append((done, steps)))
    assert relative(found[0], golden["latents_s4_shift5.0_g5.0"]) < 1e-5
    assert heard == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_the_schedule(toys, golden: dict[str, Any]) -> None:
    found = toys.make_schedule(SAMPLING, toys.torch.device("cpu")).timesteps
    assert found.tolist() == golden["timesteps_s4_shift5.0"].tolist()


@pytest.mark.parametrize(("solver", "steps", "shift"), [("unipc", 100, 12), ("unipc", 40, 1e-9), ("euler", 60, 50)])
def test_steps_whose_times_round_to_the_same(toys, solver: Any, steps: int, shift: float) -> None:
    schedule = toys.make_schedule(
        Sampling(solver=solver, steps=steps, shift=shift, guidance_scale=1.0), toys.torch.device("cpu")
    )
    sample = toys.torch.ones(1, 1, 1, 2, 2)
    for time in schedule.timesteps:
        sample = schedule.step(toys.torch.zeros_like(sample), time, sample, return_dict=False)[0]
    assert len(schedule.timesteps) == steps
    assert toys.torch.isfinite(sample).all()
