"""The benchmark that times attention backends, on the CPU."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any

import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st

if TYPE_CHECKING:
    from torch import Tensor

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

sys.path.insert(0, str(ROOT / "benchmarks"))
SHAPE = (600, 2, 12)  # tokens, heads, width


@pytest.fixture(scope="module")
def bench(toys) -> ModuleType:
    import wan_attention

    return wan_attention


def timed(bench: ModuleType, *names: str) -> dict[str, Any]:
    import toys

    found = bench.time_backends(names, bench.AttentionShape(*SHAPE), toys.torch.float32, toys.CPU)
    return {one.name: one for one in found}


@pytest.fixture
def attends(bench, monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[str, Tensor], Tensor]], None]:
    """Puts a function of a backend's name, queries and keys in place of diffusers' attention."""
    current = ["native"]

    @contextmanager
    def named(name: str) -> Generator[None]:
        current[0] = name
        yield

    def put(attend: Callable[..., Tensor]) -> None:
        monkeypatch.setattr(bench, "attention_backend", named)
        monkeypatch.setattr(bench, "dispatch_attention_fn", lambda q, k, v: attend(current[0], q, k))

    return put


def test_backends_that_work_are_timed_and_the_others_say_why_not(bench) -> None:
    found = timed(bench, "native", "_native_math", "flash")
    assert found["native"].error == 0
    assert found["_native_math"].usable
    assert all((found[name].seconds or 0) > 0 for name in ("native", "_native_math"))
    assert not found["flash"].usable
    assert "flash" in (found["flash"].reason or "").lower()


@pytest.mark.parametrize("keys", [600, 512, 257])
def test_a_backend_must_attend_to_clip_text_and_picture_and_compute_the_same(toys, bench, attends, keys: int) -> None:
    def attend(name: str, q: Tensor, k: Tensor) -> Tensor:
        if name == "lacks a shape" and k.shape[1] == keys:
            raise RuntimeError(f"No kernel for {keys} keys.\nAt some length.")
        return q * (0.9 if name == "is off" and k.shape[1] == keys else 1)

    attends(attend)
    found = timed(bench, "native", "lacks a shape", "is off")
    assert [one.usable for one in found.values()] == [True, False, False]
    assert found["lacks a shape"].reason == f"RuntimeError: No kernel for {keys} keys."
    assert found["is off"].error == pytest.approx(0.1, rel=1e-4)

    def fail(name: str, q: Tensor, k: Tensor) -> Tensor:
        if name != "native":
            raise toys.torch.AcceleratorError("CUDA error: an illegal memory access was encountered")
        return q

    attends(fail)
    with pytest.raises(toys.torch.AcceleratorError):  # a GPU that fails is no missing backend
        timed(bench, "native", "_native_cudnn")


@given(st.lists(st.tuples(st.floats(0.001, 1), st.sampled_from([0.0, 0.01, 0.03, float("nan")])), max_size=5))
def test_the_fastest_that_computes_the_same_is_chosen(bench, others: list[tuple[float, float]]) -> None:
    native = bench.TimedBackend("native", 0.1, 0.0)
    some = [native, *(bench.TimedBackend(f"other-{i}", seconds, error) for i, (seconds, error) in enumerate(others))]
    exact = [one for one in some if one.error in (0.0, 0.01)]
    assert [one for one in some if one.usable] == exact
    best = min(one.seconds or 0 for one in exact)
    assert bench.fastest(some) == next(one.name for one in exact if (one.seconds or 0) <= 1.05 * best)
    assert bench.fastest([bench.TimedBackend("native", None, None, "memory")]) == "native"
