"""A compiled model is compiled before anybody waits for it."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from typing import Any

import pytest

from cow_service.generators.wan.profiles import Acceleration, profile_of
from cow_service.weights.manifests import load_manifests

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

COMPILED = profile_of(load_manifests()["tiny-ati"], "exact").model_copy(
    update={"acceleration": Acceleration(compile="regional")}
)


@pytest.fixture
def tokens(toys, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Of a clip, for each call of a block: PyTorch's compiler is replaced by one that compiles nothing.

    On a machine with a compiler, and with a profile that wants one.
    """
    able = toys.detect_capabilities(toys.CPU).model_copy(update={"compiler": True})
    monkeypatch.setattr(toys.acceleration, "detect_capabilities", lambda device: able)
    monkeypatch.setattr(toys.loading, "profile_of", lambda manifest, name: COMPILED)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")  # so that it is as before afterwards
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR")
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
