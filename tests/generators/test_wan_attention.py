"""`attention: auto`: real backends timed on the CPU, what is chosen of them, and what a GPU would be offered."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cow_service.generators.wan.profiles import Acceleration, profile_of
from cow_service.weights.manifests import load_manifests

if TYPE_CHECKING:
    from torch import Tensor

    from cow_service.generators.wan.attention import TimedBackend

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

ATI, TINY = load_manifests()["ati"], load_manifests()["tiny-ati"]
SHAPE = (600, 2, 12)  # tokens, heads, width
AUTO = profile_of(TINY, "exact").model_copy(update={"acceleration": Acceleration(attention="auto", vae_tiling=True)})


def gpu(major: int, minor: int) -> Any:
    import toys

    given = {"device": "cuda", "name": "GPU", "memory": 80_000_000_000, "gpus": 1, "compiler": True}
    return toys.Capabilities(compute_capability=(major, minor), **given)


def timed(*names: str) -> dict[str, TimedBackend]:
    import toys

    found = toys.time_backends(names, toys.AttentionShape(*SHAPE), toys.torch.float32, toys.CPU)
    return {one.name: one for one in found}


@pytest.fixture
def attends(toys, monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[str, Tensor], Tensor]], None]:
    """Puts a function of a backend's name, queries and keys in place of diffusers' attention."""
    current = ["native"]

    @contextmanager
    def named(name: str) -> Generator[None]:
        current[0] = name
        yield

    def put(attend: Callable[..., Tensor]) -> None:
        monkeypatch.setattr(toys.attention, "attention_backend", named)
        monkeypatch.setattr(toys.attention, "dispatch_attention_fn", lambda q, k, v: attend(current[0], q, k))

    return put


def test_backends_that_work_are_timed_and_the_others_say_why_not() -> None:
    found = timed("native", "_native_math", "flash")
    assert found["native"].error == 0
    assert found["_native_math"].usable
    assert all((found[name].seconds or 0) > 0 for name in ("native", "_native_math"))
    assert not found["flash"].usable
    assert "flash" in (found["flash"].reason or "").lower()


@pytest.mark.parametrize("keys", [600, 512, 257])
def test_a_backend_must_attend_to_clip_text_and_picture_and_compute_the_same(toys, attends, keys: int) -> None:
    def attend(name: str, q: Tensor, k: Tensor) -> Tensor:
        if name == "lacks a shape" and k.shape[1] == keys:
            raise RuntimeError(f"No kernel for {keys} keys.\nAt some length.")
        return q * (0.9 if name == "is off" and k.shape[1] == keys else 1)

    attends(attend)
    found = timed("native", "lacks a shape", "is off")
    assert [one.usable for one in found.values()] == [True, False, False]
    assert found["lacks a shape"].reason == f"RuntimeError: No kernel for {keys} keys."
    assert found["is off"].error == pytest.approx(0.1, rel=1e-4)

    def fail(name: str, q: Tensor, k: Tensor) -> Tensor:
        if name != "native":
            raise toys.torch.AcceleratorError("CUDA error: an illegal memory access was encountered")
        return q

    attends(fail)
    with pytest.raises(toys.torch.AcceleratorError):  # a GPU that fails is no missing backend
        timed("native", "_native_cudnn")


@given(st.lists(st.tuples(st.floats(0.001, 1), st.sampled_from([0.0, 0.01, 0.03, float("nan")])), max_size=5))
def test_the_fastest_that_computes_the_same_is_chosen(toys, others: list[tuple[float, float]]) -> None:
    native = toys.TimedBackend("native", 0.1, 0.0)
    some = [native, *(toys.TimedBackend(f"other-{i}", seconds, error) for i, (seconds, error) in enumerate(others))]
    exact = [one for one in some if one.error in (0.0, 0.01)]
    assert [one for one in some if one.usable] == exact
    best = min(one.seconds or 0 for one in exact)
    assert toys.fastest(some) == next(one.name for one in exact if (one.seconds or 0) <= 1.05 * best)
    assert toys.fastest([toys.TimedBackend("native", None, None, "memory")]) == "native"


def test_the_next_start_chooses_the_same(toys, tmp_path, monkeypatch) -> None:
    """Whatever the second timing would say; another set of backends, or a damaged file, is timed again."""
    kept, asked = tmp_path / "data" / "attention.json", list[tuple[str, ...]]()
    lacking: set[str] = set()

    def time_them(names: tuple[str, ...], *_: object) -> tuple[toys.TimedBackend, ...]:
        """The first time the first one is the fastest, then the second, and so on."""
        asked.append(names)
        return tuple(
            toys.TimedBackend(name, None if name in lacking else 1.0 if len(asked) == 1 + i else 2.0, 0.0)
            for i, name in enumerate(names)
        )

    monkeypatch.setattr(toys.attention, "time_backends", time_them)

    def chosen(*names: str) -> str:
        monkeypatch.setattr(toys.attention, "backends_for_auto", lambda *_: names)
        found = toys.attention.with_attention(AUTO, TINY.architecture, 64, 32, toys.CPU, kept).acceleration
        assert found == AUTO.acceleration.model_copy(update={"attention": found.attention}), "so that a clip names it"
        return found.attention

    assert [chosen("native", "_native_math") for _ in range(3)] == ["native"] * 3
    assert len(asked) == 1
    assert chosen("native", "_native_math", "_native_flash") == "_native_math"
    assert chosen("native", "_native_math") == "native"
    assert chosen("native") == "native"
    assert len(asked) == 2, "there is nothing to choose of one"
    kept.write_text("{damaged")
    chosen("_native_efficient", "_native_math", "_native_flash")
    assert len(asked) == 3
    assert sorted(each.name for each in kept.parent.iterdir()) == ["attention.json"]
    before = kept.read_text()
    lacking.add("_native_flash")  # which may be there the next time: such a choice is not kept
    assert chosen("_native_math", "_native_flash") == "_native_math"
    assert kept.read_text() == before
    as_it_is = profile_of(TINY, "exact")
    assert toys.attention.with_attention(as_it_is, TINY.architecture, 64, 32, toys.CPU) is as_it_is


def test_kernels_of_the_hub_are_fetched_beforehand(toys, monkeypatch: pytest.MonkeyPatch) -> None:
    """The GPU, and what diffusers does to fetch them, are fakes. One that cannot be fetched is not chosen."""
    asked: list[str] = []

    @contextmanager
    def fetch(name: str) -> Generator[None]:
        asked.append(name)
        if name == "flash_hub":
            raise OSError("no build of it for this version of torch\nat some length")
        yield

    monkeypatch.setattr(toys.attention, "attention_backend", fetch)
    monkeypatch.setattr(toys.attention, "detect_capabilities", lambda device: gpu(9, 0))
    fetched = toys.attention.fetch_kernels([profile_of(ATI, name).acceleration for name in ATI.profiles], toys.CPU)
    reason = "OSError: no build of it for this version of torch"
    assert fetched == {"flash_hub": reason, "_flash_3_hub": None, "flash_4_hub": None}
    assert sorted(asked) == sorted(fetched), "each once"
    timed = list[str]()
    monkeypatch.setattr(toys.attention, "time_backends", lambda names, *_: timed.extend(names) or ())
    toys.attention.with_attention(AUTO, TINY.architecture, 64, 32, toys.CPU)
    assert "_flash_3_hub" in timed
    assert "flash_hub" not in timed


def test_only_what_is_exact_and_there_is_tried_at_the_shape_of_the_transformer(toys) -> None:
    assert toys.shape_of(ATI.architecture, 832, 480) == (32760, 40, 128)
    auto, natives = AUTO.acceleration, ("native", "_native_flash", "_native_cudnn", "_native_efficient")
    ampere, hopper = (*natives, "flash", "flash_hub"), ("_flash_3", "_flash_3_hub")
    assert toys.backends_for_auto(auto, gpu(7, 5)) == ("native", "_native_efficient", "xformers")
    assert toys.backends_for_auto(auto, gpu(8, 0)) == (*ampere, "xformers")
    assert toys.backends_for_auto(auto, gpu(9, 0)) == (*ampere, *hopper, "flash_4_hub", "xformers")
    assert toys.backends_for_auto(auto, gpu(10, 0)) == (*ampere, "flash_4_hub", "xformers")
    shared = toys.backends_for_auto(Acceleration(attention="auto", context_parallel=2), gpu(9, 0))
    assert shared == (*natives[:3], "flash", "flash_hub", "_flash_3_hub")
