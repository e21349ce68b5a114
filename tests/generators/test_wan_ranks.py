"""Several processes that share a clip: real ones over gloo, the real model at toy size, and what happens to each."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
from conftest import TESTS
from servers import BODY, Served
from torch import Tensor
from waiting import eventually

from cow_service.errors import (
    Canceled,
    CheckpointInvalid,
    DeviceFailed,
    GeneratorOutOfMemory,
    GeneratorUnavailable,
    WorkerEnded,
)
from cow_service.generators.wan import conditioning, loading
from cow_service.generators.wan.generator import WanGenerator
from cow_service.generators.wan.pipeline import Conditioning, denoise, latent_shape
from cow_service.generators.wan.profiles import Acceleration, Profile, Sampling, profile_of
from cow_service.generators.wan.ranks import MODULE, RankGroup, Sharing
from cow_service.generators.wan.tiny import make_tiny
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests

pytestmark = pytest.mark.slow

CPU = torch.device("cpu")
TINY = load_manifests()["tiny-ati"]
NOISE = torch.randn(latent_shape(96, 64, 9), generator=torch.Generator().manual_seed(1))


def model(folder: Path, profile: str) -> WanGenerator:
    settings = Settings(data_dir=folder, device="cpu", profile=profile, warmup=False)
    return loading.load("tiny-ati", conditioning.ati, settings)


def group_of(loaded: WanGenerator) -> RankGroup:
    assert loaded.group is not None
    return loaded.group


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> WanGenerator:
    return model(tmp_path_factory.mktemp("alone"), "exact")


_shared: list[WanGenerator] = []  # the one of the fixture: a process has one group at a time


def close_shared() -> None:
    while _shared:
        group_of(_shared.pop()).close()


@pytest.fixture(scope="module", autouse=True)
def _closed_afterwards() -> Iterator[None]:
    yield
    close_shared()


def shared_in(folder: Path) -> WanGenerator:
    if not _shared:
        _shared.append(model(folder, "exact-2"))
    return _shared[0]


@pytest.fixture
def shared(tmp_path_factory: pytest.TempPathFactory) -> WanGenerator:
    """Made once, and again after a test that had a group of its own, or broke this one."""
    return shared_in(tmp_path_factory.mktemp("shared"))


def given() -> Conditioning:
    """Both passes differ in text and in condition."""
    drawn = torch.Generator().manual_seed(2)
    sizes: Any = TINY.architecture
    texts = [torch.randn(1, 512, sizes["text_dim"], generator=drawn) for _ in range(2)]
    conditions = [torch.randn(20, *NOISE.shape[2:], generator=drawn) for _ in range(2)]
    return Conditioning(*texts, torch.randn(1, 17, sizes["image_dim"], generator=drawn), *conditions)


def latents(loaded: WanGenerator, on_step: Callable[[int, int], None] = lambda done, total: None, **how: Any) -> Tensor:
    return loaded.denoise(NOISE, given(), loaded.profile.sampling.model_copy(update=how), on_step)


@pytest.mark.parametrize("how", [{}, {"guidance_scale": 1.0}, {"solver": "euler", "steps": 3}])
def test_two_processes_make_the_same_clip(alone: WanGenerator, shared: WanGenerator, how: dict[str, Any]) -> None:
    """In steps with guidance and without: also with the solver's state and the rank that has nothing to compute."""
    passes: list[int] = []
    handle = shared.pipeline.transformer.register_forward_hook(lambda *_: passes.append(1))
    heard: list[int] = []
    found = latents(shared, lambda done, total: heard.append(done), **how)
    handle.remove()
    assert torch.equal(found, latents(alone, **how))
    assert heard == list(range(1, len(heard) + 1))
    assert len(passes) == len(heard), "the unconditional passes were computed elsewhere"


def test_a_clip_that_is_canceled_leaves_the_others_in_step(alone: WanGenerator, shared: WanGenerator) -> None:
    def stop(done: int, total: int) -> None:
        if done == 2:
            raise Canceled("no more")

    for _ in range(2):
        with pytest.raises(Canceled):
            latents(shared, stop)
    assert torch.equal(latents(shared), latents(alone))


def test_a_rank_that_cannot_load_says_why(tmp_path: Path) -> None:
    profile = profile_of(TINY, "exact-2")
    group = RankGroup("ati", profile, Settings(data_dir=tmp_path, weights_dir=tmp_path, device="cpu"), CPU)
    with pytest.raises(CheckpointInvalid, match="There is no checkpoint"):
        group.join(torch.nn.Linear(1, 1))
    with pytest.raises(CheckpointInvalid, match="There is no checkpoint"):
        group.denoise(NOISE, given(), profile.sampling, lambda done, total: None)


def broken(loaded: WanGenerator, on_step: Callable[[WanGenerator], None]) -> Exception:
    """What a clip raises in whose second step something happens. The clips after it say that a worker is replaced."""
    _shared.remove(loaded)
    with pytest.raises(Exception) as caught:  # noqa: PT011
        latents(loaded, lambda done, total: on_step(loaded) if done == 2 else None)
    with pytest.raises(DeviceFailed, match="The GPUs can no longer share clips"):
        latents(loaded)
    assert not torch.distributed.is_initialized()
    return caught.value


def process_of(loaded: WanGenerator) -> subprocess.Popen[bytes]:
    return group_of(loaded)._ranks[0]._spawned.process


def test_a_rank_that_has_no_memory_says_so_once(alone: WanGenerator, shared: WanGenerator, tmp_path: Path) -> None:
    def run_out(loaded: WanGenerator) -> None:
        group_of(loaded)._ranks[0].error = GeneratorOutOfMemory("A share of a clip does not fit.")
        process_of(loaded).kill()

    begun = time.monotonic()
    assert isinstance(broken(shared, run_out), GeneratorOutOfMemory)
    assert time.monotonic() - begun < 60, "far less than ranks wait for each other"
    assert torch.equal(latents(shared_in(tmp_path)), latents(alone)), "a new group"
    with pytest.raises(GeneratorUnavailable, match="another model of this process"):
        model(tmp_path, "exact-2")


def test_an_error_of_rank_0_stays_its_own(shared: WanGenerator) -> None:
    def fail(loaded: WanGenerator) -> None:
        def forward(*_: object) -> None:
            raise RuntimeError("a fault of the code")

        loaded.pipeline.transformer.register_forward_pre_hook(forward)

    assert str(broken(shared, fail)) == "a fault of the code"


@pytest.mark.soak  # twelve seconds of waiting
def test_a_rank_that_dies_before_it_is_met_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    met = RankGroup._met

    def lost(group: RankGroup, transformer: object) -> Any:
        group._ranks[0]._spawned.process.kill()
        return met(group, transformer)

    close_shared()
    monkeypatch.setattr(RankGroup, "_met", lost)
    begun = time.monotonic()
    with pytest.raises(WorkerEnded, match="process of one of the GPUs ended"):
        model(tmp_path, "exact-2")
    assert time.monotonic() - begun < 60


# In a server

SLOW_CLIP = {
    **BODY,
    "generator": "tiny-ati",
    "num_frames": 17,
    "generator_options": {"steps": 150},
}


def ranks_of(served: Served) -> list[psutil.Process]:
    assert served.process is not None
    below = psutil.Process(served.process.pid).children(recursive=True)
    return [one for one in below if one.status() != psutil.STATUS_ZOMBIE and MODULE in one.cmdline()]


@pytest.mark.soak  # a minute: another test covers what the pool does with the error
@pytest.mark.timeout(300)  # it loads the model twice, in two processes each
def test_a_server_replaces_a_lost_rank_and_ends_it_with_its_worker(tmp_path: Path) -> None:
    with Served(tmp_path, COW_WORKERS="true", COW_GENERATOR="tiny-ati", COW_PROFILE="exact-2") as served:
        job = served.submit(SLOW_CLIP)
        eventually(lambda: bool(ranks_of(served)))
        served.rendering(job["id"])
        [first] = ranks_of(served)
        first.kill()
        ended = served.ended(job["id"])
        assert ended["status"] == "succeeded", ended
        [second] = ranks_of(served)
        assert second.pid != first.pid
        assert ended["result"]["generator"]["options"]["guidance_parallel"] is True
        worker = second.parent()
        assert worker is not None
        worker.send_signal(signal.SIGKILL)
        eventually(lambda: not second.is_running() or second.status() == psutil.STATUS_ZOMBIE)


# Context parallelism

RANK = """
import sys, torch
sys.path.insert(0, sys.argv[1])
import test_wan_ranks as toy

# diffusers takes the rank modulo the number of accelerators.
torch.accelerator.device_count = lambda: 1
torch.save(toy.shared_by_ranks(sys.argv[2]), f"{sys.argv[2]}/{torch.distributed.get_rank()}.pt")
torch.distributed.destroy_process_group()
"""
SAMPLING = Sampling(steps=4, shift=5.0, guidance_scale=5.0)
SIZES = {"even": NOISE, "odd": torch.randn(latent_shape(80, 48, 5), generator=torch.Generator().manual_seed(3))}


def clip_of(noise: Tensor, transformer: Any, **how: Any) -> Tensor:
    full = given()
    condition = torch.zeros(20, *noise.shape[2:])
    inputs = Conditioning(full.prompt, full.negative_prompt, full.image, condition, condition)
    return denoise(transformer, CPU, noise, inputs, SAMPLING, lambda done, total: None, **how)


def shared_by_ranks(folder: str) -> dict[str, Tensor]:
    """Each clip, on this rank of four: two for each pass, which split its tokens."""
    wanted = Acceleration(context_parallel=2, guidance_parallel=True)
    rank = int(os.environ["RANK"])
    transformer = make_tiny(TINY.architecture).transformer
    store = torch.distributed.FileStore(f"{folder}/store", wanted.ranks)
    sharing = Sharing(transformer, wanted, rank, CPU, store)
    found: dict[str, Tensor] = {}
    for size, noise in SIZES.items():
        sharing.prepare(noise)
        found[size] = clip_of(noise, transformer, share=sharing)
    return found


@pytest.mark.soak
def test_four_processes_compute_what_one_does(tmp_path: Path) -> None:
    """Over gloo: every rank holds the whole result, also for a number of tokens that is odd."""
    (tmp_path / "rank.py").write_text(RANK)
    command = [sys.executable, str(tmp_path / "rank.py"), str(TESTS), str(tmp_path)]
    ranks = [
        subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1", "RANK": str(rank)}, stderr=subprocess.PIPE)
        for rank in range(4)
    ]
    for rank in ranks:
        _, said = rank.communicate(timeout=100)
        assert rank.returncode == 0, said[-3000:]
    for rank in range(4):
        found = torch.load(tmp_path / f"{rank}.pt")
        for size, noise in SIZES.items():
            wanted = clip_of(noise, make_tiny(TINY.architecture).transformer)
            torch.testing.assert_close(found[size], wanted, atol=1e-4, rtol=0)


def test_a_profile_says_how_many_gpus_it_takes() -> None:
    ranks = {
        name: {profile: profile_of(manifest, profile).acceleration.ranks for profile in manifest.profiles}
        for name, manifest in load_manifests().items()
        if manifest.architecture and manifest.role == "generator"
    }
    for name in ("ati", "wan-move"):
        assert {profile: count for profile, count in ranks[name].items() if count > 1} == {"exact-2": 2, "exact-8": 8}
    assert Profile.model_validate(TINY.profiles["exact-2"]).sampling == profile_of(TINY, "exact").sampling
