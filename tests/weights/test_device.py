"""Where weights run, and how PyTorch says that memory ran out."""

from __future__ import annotations

import pytest
from refusals import refused

from cow_service.errors import GeneratorUnavailable


@pytest.mark.parametrize(("gpus", "auto"), [(0, "cpu"), (2, "cuda:0")])
def test_a_device_is_one_that_there_is(monkeypatch: pytest.MonkeyPatch, gpus: int, auto: str) -> None:
    """GPUs are fakes."""
    import torch

    from cow_service.weights.device import choose_device

    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    assert choose_device("auto", GeneratorUnavailable) == torch.device(auto)
    assert choose_device("cpu", GeneratorUnavailable) == torch.device("cpu")
    for number, name in enumerate(("cuda", "cuda:1", "cuda:2")):
        if number < gpus:
            assert choose_device(name, GeneratorUnavailable) == torch.device("cuda", number)
        else:
            with refused("generator-unavailable") as caught:
                choose_device(name, GeneratorUnavailable)
            assert name in caught.value.detail


def test_threads_are_as_before_afterwards() -> None:
    import torch

    from cow_service.weights.device import cpu_threads

    before = torch.get_num_threads()
    for count, there in ((before + 1, before + 1), (None, before)):
        with cpu_threads(count):
            assert torch.get_num_threads() == there
        assert torch.get_num_threads() == before


def test_what_says_that_memory_ran_out() -> None:
    import torch

    from cow_service.weights.device import is_out_of_memory

    gpu, other = (torch.AcceleratorError("CUDA error") for _ in range(2))
    gpu.error_code, other.error_code = 2, 719
    with pytest.raises(RuntimeError) as real:
        torch.empty(2**50, dtype=torch.float64)
    out = (torch.OutOfMemoryError("x"), gpu, real.value, RuntimeError("CUBLAS_STATUS_ALLOC_FAILED when calling"))
    assert [is_out_of_memory(error) for error in out] == [True] * 4
    others = (other, RuntimeError("a fault"), ValueError("can't allocate memory"))
    assert [is_out_of_memory(error) for error in others] == [False] * 3


def test_names_and_reasons_for_messages() -> None:
    from cow_service.errors import listed
    from cow_service.weights.device import reason_of

    assert listed(["a", "b"], 2) == "a, b"
    assert listed([str(i) for i in range(10)]) == "0, 1, 2, 3, 4, 5, 6, 7 and 2 more"
    told = reason_of(OSError("no /home/me/x.so\nnor a/b " + "y" * 400))
    assert told == ("OSError: no … nor a/b " + "y" * 400)[: 300 + len("OSError: ")]
