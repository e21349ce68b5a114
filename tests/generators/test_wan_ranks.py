"""Several processes that share a clip: real ones over gloo, the real model at toy size, and what happens to each."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from multiprocessing import Pipe
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from refusals import refused
from tables import rows

from cow_service.concurrency import Spawned, spawn
from cow_service.errors import Canceled, CheckpointInvalid, CowError, GeneratorOutOfMemory
from cow_service.generators.wan.profiles import profile_of
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests

if TYPE_CHECKING:
    from torch import Tensor

    from cow_service.generators.wan.generator import WanGenerator
    from cow_service.generators.wan.ranks import RankGroup

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

TINY = load_manifests()["tiny-ati"]


class Rank:
    """The other process, as it is spawned, and its pipe: what comes out of it last can be given."""

    def __init__(self, spawned: Spawned) -> None:
        self.process, self.pipe = spawned.process, self
        self._pipe, self.last_words = spawned.pipe, list[CowError]()
        self.kill_at: type | None = None  # a message, which comes too late

    def send(self, message: object) -> None:
        if type(message) is self.kill_at:
            self.process.kill()
        self._pipe.send(message)

    def recv(self) -> object:
        try:
            return self._pipe.recv()
        except (EOFError, OSError):
            if self.last_words:
                return self.last_words.pop()
            raise


@pytest.fixture
def ranks(toys, monkeypatch: pytest.MonkeyPatch) -> list[Rank]:
    """Those that are spawned in a test."""
    spawned: list[Rank] = []

    def note(module: str) -> Rank:
        spawned.append(Rank(spawn(module)))
        return spawned[-1]

    monkeypatch.setattr(toys.ranks, "spawn", note)
    return spawned


@pytest.fixture
def shared(toys, ranks: list[Rank], tmp_path: Path) -> Iterator[WanGenerator]:
    """The model in two processes: a group of them takes seconds to start."""
    model = toys.model("tiny-ati", tmp_path, profile="exact-2")
    yield model
    model.close()


@pytest.fixture(scope="module")
def alone(toys, tmp_path_factory: pytest.TempPathFactory) -> WanGenerator:
    return toys.model("tiny-ati", tmp_path_factory.mktemp("alone"))


def latents(made: WanGenerator, on_step: Callable[[int, int], None] = lambda done, total: None, **how: Any) -> Tensor:
    import toys

    noise = toys.NOISES["even"]
    return made.denoise(noise, toys.conditioned(noise), made.profile.sampling.model_copy(update=how), on_step)


def assert_works(toys, alone: WanGenerator, shared: WanGenerator) -> None:
    """In steps with guidance and without: also with the solver's state and the rank that has nothing to compute."""
    for how in ({}, {"guidance_scale": 1.0}, {"solver": "euler", "steps": 3}):
        heard: list[int] = []
        with toys.after_each_pass(shared, lambda: None) as passes:
            found = latents(shared, lambda done, total, heard=heard: heard.append(done), **how)
        assert found.equal(latents(alone, **how)), how
        assert len(passes) == len(heard) == how.get("steps", 4), "the unconditional passes were computed elsewhere"


@pytest.mark.parametrize("struck_by", rows({"a rank without memory": "memory"}, ["death", "a fault"]))
def test_two_processes_make_the_same_clip_until_one_fails(toys, alone, shared, ranks, tmp_path, struck_by) -> None:
    """One that is canceled leaves them in step; one that fails in a step says why, and the next one that they end."""
    assert_works(toys, alone, shared)

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise Canceled("no more")

    for _ in range(2):
        with pytest.raises(Canceled):
            latents(shared, stop)
    assert latents(shared).equal(latents(alone))
    with refused("generator-unavailable"):  # another model of this process
        toys.model("tiny-ati", tmp_path, profile="exact-2")

    def fail(*_: object) -> None:
        raise RuntimeError("a fault of the code")

    def strike(done: int, total: int) -> None:
        if done == 2 and struck_by == "a fault":
            shared.pipeline.transformer.register_forward_pre_hook(fail)
        elif done == 2:
            ranks[0].last_words += [GeneratorOutOfMemory("A share does not fit.")] if struck_by == "memory" else []
            ranks[0].process.kill()

    with pytest.raises(Exception) as caught:  # noqa: PT011
        latents(shared, strike)
    code = {"memory": "generator-out-of-memory", "death": "device-failed", "a fault": None}[struck_by]
    assert getattr(caught.value, "code", None) == code
    assert code is not None or str(caught.value) == "a fault of the code"
    with refused("device-failed"):
        latents(shared)
    assert ranks[0].process.poll() is not None
    assert not toys.torch.distributed.is_initialized()


def group_of(toys, folder: Path) -> RankGroup:
    return toys.ranks.RankGroup("ati", profile_of(TINY, "exact-2"), Settings(data_dir=folder, device="cpu"), toys.CPU)


def test_a_rank_that_dies_before_it_is_met_is_noticed(toys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says that it has loaded, and dies when it is told where to go: rank 0 would wait there for minutes."""

    def doomed(module: str) -> Rank:
        ours, theirs = Pipe()
        with theirs:
            theirs.send("loaded")
            command = [sys.executable, "-c", "input()"]
            process = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[theirs.fileno()])
        rank = Rank(Spawned(process, ours))
        rank.kill_at = int  # the port
        return rank

    monkeypatch.setattr(toys.ranks, "spawn", doomed)
    with refused("worker-ended"):
        group_of(toys, tmp_path).join(toys.torch.nn.Linear(1, 1))


def test_a_rank_that_cannot_load_says_why(toys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its process is a fake, which says so and ends."""

    def refuse(module: str) -> Spawned:
        ours, theirs = Pipe()
        with theirs:
            theirs.send(CheckpointInvalid("There is none."))
        return Spawned(subprocess.Popen([sys.executable, "-c", ""]), ours)

    monkeypatch.setattr(toys.ranks, "spawn", refuse)
    group, noise = group_of(toys, tmp_path), toys.NOISES["even"]
    with refused("checkpoint-invalid"):
        group.join(toys.torch.nn.Linear(1, 1))
    with refused("checkpoint-invalid"):
        group.denoise(noise, toys.conditioned(noise), profile_of(TINY, "exact").sampling, lambda done, total: None)


@pytest.mark.soak  # no test with two processes splits tokens
def test_four_processes_compute_what_one_does(toys, tmp_path: Path) -> None:
    """Over gloo: every rank holds the whole result, also for a number of tokens that is odd."""
    command = [sys.executable, "-c", "import sys, toys; toys.be_a_rank(sys.argv[1])", str(tmp_path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    ranks = [subprocess.Popen(command, env=environment | {"RANK": str(rank)}) for rank in range(4)]
    assert [rank.wait() for rank in ranks] == [0] * 4
    transformer = toys.make_tiny(TINY.architecture).transformer
    wanted = [toys.clip_of(transformer, noise) for noise in toys.NOISES.values()]
    for rank in range(4):
        toys.torch.testing.assert_close(toys.torch.load(tmp_path / f"{rank}.pt"), wanted, atol=1e-4, rtol=0)
