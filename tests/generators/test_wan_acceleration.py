"""Every way to run the model faster or smaller, on the real class at toy size; and every reason not to.

Graphics cards are described, never needed: what only they can do is tested as a refusal.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError
from refusals import refused

from cow_service.generators.wan.profiles import Acceleration

if TYPE_CHECKING:
    from torch import Tensor

    from cow_service.generators.wan.capabilities import Capabilities

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

with_torchao = pytest.mark.skipif(find_spec("torchao") is None, reason="torchao is not installed")
with_accelerate = pytest.mark.skipif(find_spec("accelerate") is None, reason="accelerate is not installed")


def machine(**changes: Any) -> Capabilities:
    """An H200, but for what is given."""
    import toys

    gpu = {"device": "cuda", "name": "GPU", "compute_capability": (9, 0), "memory": 150_000_000_000, "gpus": 8}
    able = {"packages": tuple(toys.MINIMUM_VERSIONS), "compiler": True}
    return toys.Capabilities.model_validate({**gpu, **able, **changes})


def bare() -> Capabilities:
    return machine(device="cpu", compute_capability=None, gpus=0, packages=(), compiler=False)


def test_options_that_make_no_sense_are_refused() -> None:
    for bad in ({"cache_threshold": -1}, {"context_parallel": 0}, {"fp8": "int4"}, {"speed": 9}, {"cache": "other"}):
        with pytest.raises(ValidationError):
            Acceleration.model_validate(bad)


def test_the_attention_that_is_named_is_used_and_native_changes_nothing(toys) -> None:
    with toys.attention_backend("native"):  # diffusers' choice holds for the whole process: afterwards it is as before
        exact = toys.forward(toys.toy().transformer)
        assert toys.forward(toys.accelerated()).equal(exact)
        other = toys.accelerated(attention="_native_math")
        with toys.profile() as seen:
            assert toys.error(toys.forward(other), exact) < 1e-5
        names = {event.key for event in seen.key_averages()}
        assert "aten::_scaled_dot_product_attention_math" in names
        assert not {name for name in names if "flash" in name}


# Caches

FIRST_BLOCK: dict[str, Any] = {"cache": "first-block", "cache_threshold": 1e9}


def test_a_cache_skips_blocks_and_keeps_nothing_for_the_next_clip(toys) -> None:
    exact = toys.clip(toys.toy().transformer)
    assert toys.same(toys.clip(toys.accelerated(cache="first-block", cache_threshold=0.0)), exact), "none is allowed"
    pipeline = toys.toy()
    counts = toys.counted(pipeline)
    toys.accelerate(pipeline, Acceleration(**FIRST_BLOCK), toys.CPU)
    first = toys.clip(pipeline.transformer)
    assert counts == [5, 1, 1], "the first block decides, the others run in the first step only"
    assert first[0].equal(exact[0])
    assert not first[1].equal(exact[1])
    toys.reset_cache(pipeline.transformer)
    assert toys.same(toys.clip(pipeline.transformer), first)
    with refused("generator-unavailable") as caught:  # it is accelerated once
        toys.accelerate(pipeline, Acceleration(**FIRST_BLOCK), toys.CPU)
    assert "cache: first-block" in caught.value.detail


# Compiled blocks


def test_all_blocks_share_one_compiled_graph(toys, monkeypatch) -> None:
    """Also with a cache around it. Without inductor, whose C++ takes half a minute: what is compiled is the same."""
    graphs, compiler = list[Any](), toys.torch.compile
    backend = lambda graph, _: (graphs.append(graph), graph)[1]  # noqa: E731
    toys.torch.compiler.reset()
    monkeypatch.setattr(toys.torch, "compile", lambda function: compiler(function, backend=backend, fullgraph=True))
    able = bare().model_copy(update={"compiler": True})
    monkeypatch.setattr(toys.acceleration, "detect_capabilities", lambda device: able)
    transformer, plain = toys.accelerated(compile="regional", **FIRST_BLOCK), toys.accelerated(**FIRST_BLOCK)
    assert toys.same(toys.clip(transformer), toys.clip(plain))
    assert len(graphs) == 1
    toys.torch.compiler.reset()


# Float8


def test_weights_become_float8_in_the_blocks_alone(toys) -> None:
    from torchao.quantization import Float8Tensor

    transformer = toys.accelerated(fp8="weights")
    small = {name for name, weight in transformer.named_parameters() if isinstance(weight, Float8Tensor)}
    assert small == {
        f"{name}.weight" for name, layer in transformer.named_modules()
        if isinstance(layer, toys.torch.nn.Linear) and name.startswith("blocks.")
    }  # fmt: skip
    assert transformer.dtype == toys.torch.float32
    assert 1e-4 < toys.error(toys.forward(transformer), toys.forward(toys.toy().transformer)) < 0.05
    cached = toys.clip(toys.accelerated(fp8="weights", **FIRST_BLOCK))
    assert not toys.same(cached, toys.clip(transformer)), "a cache skips such blocks, too"


def test_what_a_library_raises_is_told_with_the_option_and_without_folders(toys, monkeypatch) -> None:
    pipeline = toys.toy()

    def fail(backend: str) -> None:
        raise OSError(f"cannot open /home/secret/lib/kernel.so for {backend}\n  at /home/secret/x.py")

    monkeypatch.setattr(pipeline.transformer, "set_attention_backend", fail)
    with refused("generator-unavailable") as caught:
        toys.accelerate(pipeline, Acceleration(), toys.CPU)
    assert "attention: native" in caught.value.detail
    assert "cannot open kernel.so for native" in caught.value.detail
    assert "secret" not in caught.value.detail


# Offloading: the CPU in the place of the GPU.


@with_accelerate
@pytest.mark.parametrize("offload", ["model", "group"])
def test_offloaded_parts_compute_the_same(toys, offload, monkeypatch) -> None:
    kept = toys.accelerated(**FIRST_BLOCK)
    monkeypatch.setattr(toys.acceleration, "detect_capabilities", lambda device: machine())
    offloaded = toys.accelerated(offload=offload, **FIRST_BLOCK)
    for _ in range(2):
        assert toys.same(toys.clip(offloaded), toys.clip(kept))
        toys.reset_cache(offloaded)
        toys.reset_cache(kept)


def test_weights_are_pinned_one_by_one(toys, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pinned memory needs a GPU, so copies stand for it: each one is complete before the next one is made."""
    block: Any = toys.toy().transformer.blocks[0]
    weights, before = list(block.parameters()), [weight.clone() for weight in block.parameters()]
    pinned: list[Tensor] = []

    def pin_memory(tensor: Tensor) -> Tensor:
        assert all(weight.data_ptr() == copy.data_ptr() for weight, copy in zip(weights, pinned, strict=False))
        pinned.append(tensor.clone())
        return pinned[-1]

    monkeypatch.setattr(toys.Tensor, "pin_memory", pin_memory)
    toys.pin(block)
    assert [weight.data_ptr() for weight in weights] == [copy.data_ptr() for copy in pinned]
    assert toys.same(weights, before)


# Refusals


@pytest.mark.parametrize(
    ("options", "changes", "named"),
    [
        ({"compile": "regional"}, {"packages": ("torchao",)}, ("compile: ", "triton 3.0.0")),
        ({"compile": "regional"}, None, ("compile: ", "C++")),
        ({"cache": "first-block", "context_parallel": 2}, {}, ("cache: ", "first-block")),
        ({"fp8": "weights"}, None, ("fp8: weights ", "torchao 0.15.0")),
        ({"fp8": "dynamic"}, {"compute_capability": (8, 0)}, ("fp8: dynamic ", "8.9", "8.0")),
        ({"fp8": "stored-dynamic"}, {"compute_capability": None}, ("fp8: stored-dynamic ", "8.9")),
        ({"offload": "model"}, None, ("offload: model ", "CPU")),
        ({"offload": "group"}, None, ("offload: group ", "CPU")),
        ({"context_parallel": 8, "guidance_parallel": True}, {}, ("16 ", " 8.")),
        ({"context_parallel": 2}, None, ("context_parallel: 2 ", "CPU")),
    ],
)
def test_what_a_machine_cannot_do_is_said_of_each_option(toys, options, changes, named) -> None:
    (told,) = toys.refusals(Acceleration(**options), bare() if changes is None else machine(**changes))
    assert told.startswith(named[0])
    assert all(each in told for each in named)


def test_a_good_machine_can_do_it(toys) -> None:
    for options in (
        {"attention": "_flash_3", "compile": "regional", "fp8": "dynamic", "cache": "first-block"},
        {"attention": "sage", "compile": "regional", "fp8": "weights", "offload": "group"},
        {"guidance_parallel": True, "context_parallel": 4, "compile": "regional"},
    ):
        assert toys.refusals(Acceleration.model_validate(options), machine()) == ()
    assert toys.refusals(Acceleration(fp8="dynamic"), machine(compute_capability=(8, 9))) == ()
    assert toys.refusals(Acceleration(compile="regional"), bare().model_copy(update={"compiler": True})) == ()


def test_everything_is_refused_at_once_and_nothing_is_changed(toys) -> None:
    pipeline = toys.toy(vae=True)
    for options, device, named in (
        ({"offload": "model", "context_parallel": 2}, "cpu", ("offload: ", "context_parallel: ")),
        ({"attention": "quick"}, "cpu", ("attention: quick",)),  # what diffusers refuses
        ({}, "cuda:7", ("device: cuda:7",)),
    ):
        with refused("generator-unavailable") as caught:
            wanted = Acceleration.model_validate({"cache": "first-block", "vae_tiling": True, **options})
            toys.accelerate(pipeline, wanted, toys.torch.device(device))
        assert all(each in caught.value.detail for each in named)
    assert not pipeline.transformer.is_cache_enabled
    toys.accelerate(pipeline, Acceleration(), toys.CPU)
    assert not pipeline.vae.use_tiling
    toys.accelerate(pipeline, Acceleration(vae_tiling=True), toys.CPU)
    assert pipeline.vae.use_tiling


def test_the_machine_is_seen_as_it_is(toys, monkeypatch: pytest.MonkeyPatch) -> None:
    found = toys.detect_capabilities(toys.CPU)
    assert (found.device, found.compute_capability) == ("cpu", None)
    assert found.memory > 1e8
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setenv("PATH", "")
    assert not toys.detect_capabilities(toys.CPU).compiler
    versions = {"torchao": "0.14.9.post2", "triton": toys.MINIMUM_VERSIONS["triton"]}
    monkeypatch.setattr("importlib.metadata.version", lambda name: versions.get(name, "99"))
    packages = toys.detect_capabilities(toys.CPU).packages
    assert set(packages) == set(toys.MINIMUM_VERSIONS) - {"torchao"}, "an old one counts as none"
