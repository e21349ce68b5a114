"""`attention: auto`: real backends timed on the CPU, what is chosen of them, and what a GPU would be offered."""

from __future__ import annotations

import logging
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from diffusers.models import attention_dispatch
from hypothesis import given
from hypothesis import strategies as st

from cow_service.generators.wan import attention
from cow_service.generators.wan.attention import AttentionShape, TimedBackend, fastest, shape_of, time_backends
from cow_service.generators.wan.capabilities import (
    EXACT_BACKENDS,
    Capabilities,
    backends_for_auto,
    refusals,
)
from cow_service.generators.wan.profiles import Acceleration, profile_of
from cow_service.weights.manifests import load_manifests

CPU = torch.device("cpu")
ATI, TINY = load_manifests()["ati"], load_manifests()["tiny-ati"]
SMALL = AttentionShape(tokens=48, heads=2, width=12)


def gpu(major: int, minor: int, *packages: str) -> Capabilities:
    return Capabilities(
        device="cuda",
        name="GPU",
        compute_capability=(major, minor),
        memory=80_000_000_000,
        gpus=1,
        packages=packages,
        compiler=True,
    )


def test_backends_that_work_are_timed_and_the_others_say_why_not() -> None:
    timed = {one.name: one for one in time_backends(("native", "_native_math", "flash"), SMALL, torch.float32, CPU)}
    assert timed["native"].error == 0
    assert timed["_native_math"].usable
    assert all((timed[name].seconds or 0) > 0 for name in ("native", "_native_math"))
    assert not timed["flash"].usable
    assert "flash" in (timed["flash"].reason or "").lower()


def test_a_backend_that_cannot_attend_to_the_picture_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def attend(name: str, *tensors: torch.Tensor) -> torch.Tensor:
        if name != "native" and tensors[1].shape[1] == 257:
            raise RuntimeError("No kernel for 257 keys.")
        return tensors[0]

    monkeypatch.setattr(attention, "_attended", attend)
    longer = SMALL._replace(tokens=600)
    found = time_backends(("native", "_native_math"), longer, torch.float32, CPU)
    assert [(one.usable, one.reason) for one in found] == [
        (True, None),
        (False, "RuntimeError: No kernel for 257 keys."),
    ]


def test_a_gpu_that_fails_is_no_missing_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str, *tensors: Any) -> Any:
        if name != "native":
            raise torch.AcceleratorError("CUDA error: an illegal memory access was encountered")
        return tensors[0]

    monkeypatch.setattr(attention, "_attended", fail)
    with pytest.raises(torch.AcceleratorError):
        time_backends(("native", "_native_cudnn"), SMALL, torch.float32, CPU)


@given(
    st.lists(
        st.tuples(st.floats(0.001, 1), st.sampled_from([0.0, 0.01, 0.03, float("nan")])),
        min_size=1,
        max_size=5,
    )
)
def test_the_fastest_that_computes_the_same_is_chosen(others: list[tuple[float, float]]) -> None:
    native = TimedBackend("native", 0.1, 0.0)
    timed = [native, *(TimedBackend(f"other-{i}", seconds, error) for i, (seconds, error) in enumerate(others))]
    chosen = next(one for one in timed if one.name == fastest(timed))
    exact = [one.seconds or 0 for one in timed if one.error is not None and one.error <= attention.MAX_ERROR]
    assert chosen.usable
    assert (chosen.seconds or 0) <= attention.MARGIN * min(exact), "none is clearly faster"
    before = [one.seconds or 0 for one in timed[: timed.index(chosen)] if one.usable]
    assert all(seconds > attention.MARGIN * min(exact) for seconds in before), "the first of about the same"
    assert fastest([TimedBackend("native", None, None, "memory")]) == "native"


def test_a_profile_names_what_was_chosen(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """So that a clip's description and its fingerprint do."""
    monkeypatch.setattr(attention, "backends_for_auto", lambda *_: ("native", "_native_math"))
    given_ = profile_of(TINY, "exact")
    assert attention.with_attention(given_, TINY.architecture, 128, 64, CPU) is given_
    auto = given_.model_copy(update={"acceleration": Acceleration(attention="auto", vae_tiling=True)})
    with caplog.at_level(logging.INFO, logger="cow_service"):
        found = attention.with_attention(auto, TINY.architecture, 128, 64, CPU).acceleration
    assert found.attention in {"native", "_native_math"}
    assert found == Acceleration(attention=found.attention, vae_tiling=True)
    (told,) = caplog.messages
    assert told.startswith(f"attention: {found.attention}; native ")
    assert "_native_math" in told


def test_the_next_start_chooses_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the second timing would say; another set of backends, or a damaged file, is timed again."""
    kept, timed = tmp_path / "data" / "attention.json", list[tuple[str, ...]]()

    def time_them(names: tuple[str, ...], *_: object) -> tuple[TimedBackend, ...]:
        timed.append(names)
        return tuple(TimedBackend(name, 1.0 if len(timed) == 1 + i else 2.0, 0.0) for i, name in enumerate(names))

    monkeypatch.setattr(attention, "time_backends", time_them)
    auto = profile_of(TINY, "exact").model_copy(update={"acceleration": Acceleration(attention="auto")})

    def chosen(*names: str) -> str:
        monkeypatch.setattr(attention, "backends_for_auto", lambda *_: names)
        return attention.with_attention(auto, TINY.architecture, 128, 64, CPU, kept).acceleration.attention

    assert [chosen("native", "_native_math") for _ in range(3)] == ["native"] * 3
    assert len(timed) == 1
    assert chosen("native", "_native_math", "_native_flash") == "_native_math"
    assert chosen("native", "_native_math") == "native"
    monkeypatch.setattr(attention, "_fetched", lambda name: "offline" if name == "native" else None)
    chosen("native", "_native_math", "_native_flash")
    assert timed[2:] == [("_native_math", "_native_flash")], (
        "where one cannot be fetched, it is chosen among the others"
    )
    monkeypatch.setattr(attention, "_fetched", lambda name: None)
    kept.write_text("{damaged")
    chosen("native", "_native_math", "_native_flash")
    assert len(timed) == 4
    assert sorted(each.name for each in kept.parent.iterdir()) == ["attention.json"]


def test_a_choice_is_kept_only_where_all_were_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel that could not be fetched this time may be there the next time."""
    timed = (TimedBackend("native", 1.0, 0.0), TimedBackend("_native_math", None, None, "offline"))
    monkeypatch.setattr(attention, "time_backends", lambda *_: timed)
    monkeypatch.setattr(attention, "backends_for_auto", lambda *_: ("native", "_native_math"))
    auto = profile_of(TINY, "exact").model_copy(update={"acceleration": Acceleration(attention="auto")})
    found = attention.with_attention(auto, TINY.architecture, 128, 64, CPU, tmp_path / "kept.json")
    assert found.acceleration.attention == "native"
    assert not (tmp_path / "kept.json").exists()


def test_kernels_of_the_hub_are_fetched_beforehand(monkeypatch: pytest.MonkeyPatch) -> None:
    """The package `kernels` and the GPU are fakes; what diffusers does with them is its own."""
    asked: list[str] = []

    class Kernel:
        flash_attn_func = staticmethod(lambda *_: None)

        class flash_attn_interface:
            _flash_attn_forward = _flash_attn_backward = staticmethod(lambda *_: None)

    def get_kernel(repository: str, **_: object) -> type[Kernel]:
        asked.append(repository)
        if "attn3" not in repository:
            raise OSError("no build of it for this version of torch\nat some length")
        return Kernel

    package: Any = ModuleType("kernels")
    package.get_kernel, package.__spec__ = get_kernel, ModuleSpec("kernels", None)
    monkeypatch.setitem(sys.modules, "kernels", package)
    monkeypatch.setattr(attention_dispatch, "_CAN_USE_FLASH_ATTN_4", True, raising=False)
    monkeypatch.setattr(attention_dispatch, "is_kernels_available", lambda: True)
    monkeypatch.setattr(attention_dispatch, "is_kernels_version", lambda *_: True)
    trusted = SimpleNamespace(trustedKernelPublisher=True)
    monkeypatch.setattr(attention_dispatch, "get_organization_overview", lambda publisher: trusted)
    monkeypatch.setattr(attention, "detect_capabilities", lambda device: gpu(9, 0, "kernels", "torchao", "triton"))
    for config in attention_dispatch._HUB_KERNELS_REGISTRY.values():
        for name in ("kernel_fn", "wrapped_forward_fn", "wrapped_backward_fn"):
            monkeypatch.setattr(config, name, None)
    profiles = (profile_of(ATI, name).acceleration for name in ATI.profiles)
    fetched = attention.fetch_kernels(profiles, CPU)
    assert fetched["_flash_3_hub"] is None
    assert fetched["flash_hub"] == "OSError: no build of it for this version of torch"
    assert "sage_hub" not in fetched, "no profile names it"
    assert "kernels-community/flash-attn3" in asked
    only = Acceleration(attention="sage_hub"), Acceleration(attention="native"), Acceleration(attention="flash")
    assert set(attention.fetch_kernels(only, CPU)) == {"sage_hub"}


def test_the_shape_is_that_of_the_transformer() -> None:
    assert shape_of(ATI.architecture, 832, 480) == (32760, 40, 128)


def test_only_what_is_exact_and_there_is_tried() -> None:
    auto = Acceleration(attention="auto")
    natives = ("native", "_native_flash", "_native_cudnn", "_native_efficient")
    assert backends_for_auto(auto, gpu(8, 0)) == (*natives, "flash", "flash_hub", "xformers")
    assert backends_for_auto(auto, gpu(7, 5)) == ("native", "_native_efficient", "xformers")
    everything = backends_for_auto(auto, gpu(9, 0))
    assert {"_flash_3", "_flash_3_hub", "flash_4_hub", "xformers"} <= set(everything)
    assert not {"_flash_3", "_flash_3_hub"} & set(backends_for_auto(auto, gpu(10, 0)))
    assert not [name for name in everything if "sage" in name or name == "_native_math"]
    shared = backends_for_auto(Acceleration(attention="auto", context_parallel=2), gpu(9, 0))
    assert all(EXACT_BACKENDS[name].context_parallel for name in shared)


def test_auto_needs_a_gpu() -> None:
    assert refusals(Acceleration(attention="auto"), gpu(9, 0)) == ()
    bare = Capabilities(device="cpu", name="x86_64", memory=1, gpus=0, compiler=False)
    assert refusals(Acceleration(attention="auto"), bare) == (
        "attention: auto needs a GPU, whose backends it times, and this device is the CPU; choose native.",
    )
