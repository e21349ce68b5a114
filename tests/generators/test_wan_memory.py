"""What weights take of memory, before they are read: computed from headers, compared with what loads."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from refusals import refused

from cow_service.generators.wan.profiles import profile_of
from cow_service.weights.manifests import load_manifests

if TYPE_CHECKING:
    from cow_service.generators.wan.memory import Need

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

ATI = load_manifests()["ati"]
TINY = load_manifests()["tiny-ati"]


@pytest.fixture(scope="module")
def checkpoint(toys, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy as diffusers saves it: transformer and base in one folder."""
    folder = tmp_path_factory.mktemp("toy")
    toys.make_tiny(TINY.architecture).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def needs(toys) -> dict[str, Need]:
    """What each profile of ATI would take of the toy: its parameters counted in memory."""
    made = toys.make_tiny(TINY.architecture)
    counts = {part: sum(p.numel() for p in getattr(made, part).parameters()) for part in ATI.parameters}
    return {name: toys.need_of(profile_of(ATI, name), counts, 40) for name in ATI.profiles}


@pytest.fixture
def machine(toys, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[int, int | str], None]:
    """There is no GPU here: one that can do all is a fake. Sets its bytes, and those of its container."""
    container, room = tmp_path / "memory.max", [10**12]
    monkeypatch.setattr(toys.memory, "CGROUP", container)
    monkeypatch.setattr(toys.memory, "refusals", lambda wanted, machine: ())
    monkeypatch.setattr(toys.torch.cuda, "device_count", lambda: 1)
    gpu = partial(SimpleNamespace, name="GPU", major=9, minor=0)
    monkeypatch.setattr(toys.torch.cuda, "get_device_properties", lambda device: gpu(total_memory=room[0]))

    def has(device: int = 10**12, host: int | str = "max") -> None:
        room[0] = device
        container.write_text(f"{host}\n")

    return has


def check(profile: str, transformer: Path, base: Path, device: str = "cuda:0") -> None:
    import toys

    toys.check_machine(ATI, profile, {"transformer": transformer, "base": base}, toys.torch.device(device))


def test_what_weights_take_is_what_the_loaded_parts_do(toys, checkpoint: Path, needs: dict[str, Need]) -> None:
    published = {"exact": (47.2, 0), "turbo": (46.9, 0), "fast": (30.8, 47.2), "small": (2.1, 63.5)}
    published |= {"small-turbo": (1.9, 63.3), "small-float8": (16.4, 30.8), "exact-8": (47.2, 0)}  # GB: GPU, host
    for name, gigabytes in published.items():
        need = toys.need_of(profile_of(ATI, name), ATI.parameters, 40)
        assert (need.device / 1e9, need.host / 1e9) == pytest.approx(gigabytes, abs=0.1)
    transformer = toys.make_tiny(TINY.architecture).transformer.to(toys.torch.bfloat16)
    parts = toys.assemble(transformer, checkpoint, toys.torch.bfloat16, toys.torch.float32)
    models = [part for part in parts.components.values() if isinstance(part, toys.torch.nn.Module)]
    taken = sum(weight.numel() * weight.element_size() for each in models for weight in each.parameters())
    assert needs["exact"].device == pytest.approx(taken, rel=0.03)


def refusal(*how: Any) -> str:
    with refused("generator-unavailable") as caught:
        check(*how)
    return caught.value.detail


def test_what_does_not_fit_is_refused_and_what_fits_is_named(checkpoint, needs, machine, tmp_path) -> None:
    for name in ("exact", "fast"):
        machine(needs[name].device)
        check(name, checkpoint, checkpoint)
        machine(needs[name].device - 1)
        refusal(name, checkpoint, checkpoint)
    room, host = needs["fast"].device, needs["small"].host
    machine(room, host)
    told = refusal("exact", checkpoint, checkpoint)
    able = {
        name for name, need in needs.items()
        if need.device <= room and need.host <= host and not profile_of(ATI, name).acceleration.keeps_float8
    }  # fmt: skip
    assert {"fast", "small"} <= able
    assert set(re.findall(r"[\w-]+", told)) & needs.keys() == able | {"exact"}
    check("small", checkpoint, checkpoint)
    machine(room, host - 1)
    refusal("small", checkpoint, checkpoint)
    machine(1)
    assert "COW_PROFILE" not in refusal("turbo", checkpoint, checkpoint), "none would do"
    both = max(needs["portable"].device, needs["portable"].host)
    machine(1, both)
    check("portable", checkpoint, checkpoint, "cpu")
    machine(1, both - 1)
    refusal("portable", checkpoint, checkpoint, "cpu")
    assert "cow models pull ati" in refusal("small-float8", tmp_path, tmp_path), "missing weights are told, too"


def test_float8_is_kept_only_where_there_is_some(toys, checkpoint, tmp_path, machine) -> None:
    machine()
    assert "COW_CHECKPOINTS" in refusal("small-float8", checkpoint, checkpoint)
    weights = toys.load_file(next((checkpoint / "transformer").glob("*.safetensors")))
    small = {name: each.to(toys.torch.float8_e4m3fn) for name, each in weights.items()}
    toys.save_file(small, tmp_path / "one.safetensors")
    check("small-float8", tmp_path / "one.safetensors", checkpoint)


def test_what_cannot_be_read_is_left_to_loading(checkpoint: Path, tmp_path: Path, machine) -> None:
    machine(1)
    check("exact", tmp_path, checkpoint)
    (tmp_path / "text_encoder").mkdir()
    (tmp_path / "text_encoder" / "model.safetensors").write_bytes(b"damaged")
    check("exact", checkpoint, tmp_path)
