"""A compiled model is compiled before anybody waits for it: real blocks at toy size, counted graphs, no inductor."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from torch._dynamo.testing import CompileCounter

from cow_service.generators.wan import acceleration, conditioning, generator, loading
from cow_service.generators.wan.capabilities import detect_capabilities
from cow_service.generators.wan.generator import WanGenerator, compile_for
from cow_service.generators.wan.profiles import Acceleration, profile_of
from cow_service.settings import Settings
from cow_service.weights.device import cpu_threads
from cow_service.weights.manifests import load_manifests

COMPILED = profile_of(load_manifests()["tiny-ati"], "exact").model_copy(
    update={"acceleration": Acceleration(compile="regional")}
)


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> CompileCounter:
    """Counts what would be compiled, and runs it as it is."""
    counter, compiler = CompileCounter(), torch.compile
    able = detect_capabilities(torch.device("cpu")).model_copy(update={"compiler": True})
    monkeypatch.setattr(torch, "compile", lambda function: compiler(function, backend=counter))
    monkeypatch.setattr(acceleration, "detect_capabilities", lambda device: able)
    monkeypatch.setattr(loading, "profile_of", lambda manifest, name: COMPILED)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")  # so that it is as before afterwards
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR")
    torch._dynamo.reset()
    return counter


def loaded(folder: Path, *, warmup: bool) -> WanGenerator:
    return loading.load("tiny-ati", conditioning.ati, Settings(data_dir=folder, device="cpu", warmup=warmup))


@pytest.mark.slow
def test_no_clip_waits_for_the_compiler(
    graphs: CompileCounter, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, logger="cow_service"):
        model = loaded(tmp_path, warmup=True)
    told = [message.partition(" in ")[0] for message in caplog.messages if "compiled" in message]
    assert told == [
        "compiled for 112 x 64 px and 81 frames",
        "compiled for 112 x 64 px and 17 frames",
    ]
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(tmp_path / "compiled")
    compiled = graphs.frame_count
    assert compiled == 2, "for one size, then for any"
    sizes = (64, 112, 9), (128, 64, 81), (112, 64, 81), (96, 80, 33)
    with cpu_threads(model.threads):  # as for a clip: compiled code holds for a number of threads
        compile_for(model.pipeline, model.denoise, model.profile.sampling, sizes)
    assert graphs.frame_count == compiled


@pytest.mark.slow
def test_the_usual_size_runs_its_own_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also after code for any size, which would fit: it is compiled for more than is needed, and slower."""
    ran: list[int] = []
    compiled: list[int] = []

    def backend(graph: torch.fx.GraphModule, _: object) -> Any:
        number = len(compiled)
        compiled.append(number)

        def run(*args: Any) -> Any:
            ran.append(number)
            return graph(*args)

        return run

    compiler = torch.compile
    monkeypatch.setattr(torch, "compile", lambda function: compiler(function, backend=backend))
    able = detect_capabilities(torch.device("cpu")).model_copy(update={"compiler": True})
    monkeypatch.setattr(acceleration, "detect_capabilities", lambda device: able)
    monkeypatch.setattr(loading, "profile_of", lambda manifest, name: COMPILED)
    torch._dynamo.reset()
    model = loaded(tmp_path, warmup=True)
    assert compiled == [0, 1]
    for size, number in (((112, 64, 81), 0), ((112, 64, 9), 1), ((112, 64, 81), 0)):
        ran.clear()
        with cpu_threads(model.threads):
            compile_for(model.pipeline, model.denoise, model.profile.sampling, [size])
        assert set(ran) == {number}
    torch._dynamo.reset()


def test_it_can_be_left_to_the_first_clip(graphs: CompileCounter, tmp_path: Path) -> None:
    loaded(tmp_path, warmup=False)
    assert graphs.frame_count == 0


def test_a_size_that_does_not_fit_is_left_to_the_first_clip(
    graphs: CompileCounter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Shorter clips may fit: the model can be used all the same."""
    monkeypatch.setattr(generator, "compile_for", lambda *_: torch.empty(2**50, dtype=torch.float64))
    assert loaded(tmp_path, warmup=True).concurrency == 1
    assert "not compiled beforehand: A clip of 112 x 64 does not fit into memory" in caplog.text
