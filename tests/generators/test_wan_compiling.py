"""A compiled model is compiled before anybody waits for it."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from cow_service.generators.wan.profiles import Acceleration, profile_of
from cow_service.weights.manifests import load_manifests

if TYPE_CHECKING:
    from cow_service.generators.wan.generator import WanGenerator

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

COMPILED = profile_of(load_manifests()["tiny-ati"], "exact").model_copy(
    update={"acceleration": Acceleration(compile="regional")}
)


@pytest.fixture
def able(toys, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with a compiler, and a profile that wants one."""
    able = toys.detect_capabilities(toys.CPU).model_copy(update={"compiler": True})
    monkeypatch.setattr(toys.acceleration, "detect_capabilities", lambda device: able)
    monkeypatch.setattr(toys.loading, "profile_of", lambda manifest, name: COMPILED)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")  # so that it is as before afterwards
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR")


@pytest.fixture
def tokens(toys, able: None, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Of a clip, for each call of a block: PyTorch's compiler is replaced by one that compiles nothing."""
    called: list[int] = []

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        def run(states: toys.torch.Tensor, *rest: Any) -> Any:
            called.append(states.shape[1])
            return function(states, *rest)

        return run

    monkeypatch.setattr(toys.torch, "compile", compiled)
    return called


def test_no_clip_waits_for_the_compiler(toys, tokens, tmp_path, caplog) -> None:
    """One guided step of the longest clip and one of a short one, through both blocks: 28 tokens a latent frame."""
    with caplog.at_level(logging.INFO, logger="cow_service"):
        toys.model("tiny-ati", tmp_path)
        assert not tokens, "it can be left to the first clip"
        toys.model("tiny-ati", tmp_path, warmup=True)
    assert tokens == [28 * 21] * 4 + [28 * 5] * 4
    told = [message.partition(" in ")[0] for message in caplog.messages if "compiled" in message]
    assert told == ["compiled for 112 x 64 px and 81 frames", "compiled for 112 x 64 px and 17 frames"]
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(tmp_path / "compiled")


def test_a_size_that_does_not_fit_is_left_to_the_first_clip(toys, tokens, tmp_path, monkeypatch, caplog) -> None:
    """Shorter clips may fit: the model can be used all the same. Any other failure is one."""
    monkeypatch.setattr(toys.generator, "compile_for", lambda *_: toys.torch.empty(2**50, dtype=toys.torch.float64))
    assert toys.model("tiny-ati", tmp_path, warmup=True).concurrency == 1
    told = [each for each in caplog.records if (each.name, each.levelno) == ("cow_service", logging.WARNING)]
    assert ["112 x 64" in each.getMessage() for each in told] == [True]

    def fail(*_: object) -> None:
        raise RuntimeError("a fault")

    monkeypatch.setattr(toys.generator, "compile_for", fail)
    with pytest.raises(RuntimeError, match="a fault"):
        toys.model("tiny-ati", tmp_path, warmup=True)


@pytest.mark.soak  # it compiles in earnest, without inductor
@pytest.mark.usefixtures("able")
def test_the_usual_size_runs_its_own_code(toys, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also after code for any size, which would fit: it is compiled for more than is needed, and slower."""
    ran, compiled, compiler = list[int](), list[int](), toys.torch.compile

    def backend(graph: Callable[..., Any], _: object) -> Any:
        number = len(compiled)
        compiled.append(number)
        return lambda *args: (ran.append(number), graph(*args))[1]

    monkeypatch.setattr(toys.torch, "compile", lambda function: compiler(function, backend=backend))
    toys.torch.compiler.reset()
    made: WanGenerator = toys.model("tiny-ati", tmp_path, warmup=True)
    for size, number in (((112, 64, 81), 0), ((112, 64, 9), 1), ((64, 112, 33), 1), ((112, 64, 81), 0)):
        ran.clear()
        with toys.cpu_threads(made.threads):  # as for a clip: compiled code holds for a number of threads
            toys.compile_for(made.pipeline, made.denoise, made.profile.sampling, [size])
        assert set(ran) == {number}
    assert compiled == [0, 1], "for one size, then for any"
    toys.torch.compiler.reset()
