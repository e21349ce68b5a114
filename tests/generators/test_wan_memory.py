"""What weights take of memory, before they are read: computed from headers, compared with what loads."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

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
def machine(toys, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> SimpleNamespace:
    """There is no GPU here: one that can do all is a fake, `room` bytes large; its container has `host` bytes."""

    class Machine(SimpleNamespace):
        def __setattr__(self, name: str, value: object) -> None:
            super().__setattr__(name, value)
            if name == "host":
                (tmp_path / "memory.max").write_text(f"{value}\n")

    has = Machine(room=10**12, host="max")
    monkeypatch.setattr(toys.memory, "CGROUP", tmp_path / "memory.max")
    monkeypatch.setattr(toys.memory, "refusals", lambda wanted, machine: ())
    monkeypatch.setattr(toys.torch.cuda, "device_count", lambda: 1)
    gpu = partial(SimpleNamespace, name="GPU", major=9, minor=0)
    monkeypatch.setattr(toys.torch.cuda, "get_device_properties", lambda device: gpu(total_memory=has.room))
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


def test_what_does_not_fit_is_refused_and_what_fits_is_named(checkpoint, needs, machine, tmp_path) -> None:
    for name in ("exact", "fast"):
        machine.room = needs[name].device
        check(name, checkpoint, checkpoint)
        machine.room -= 1
        with refused("generator-unavailable"):
            check(name, checkpoint, checkpoint)
    machine.room, machine.host = needs["fast"].device, needs["small"].host
    with refused("generator-unavailable") as caught:
        check("exact", checkpoint, checkpoint)
    able = {
        name
        for name, need in needs.items()
        if need.device <= machine.room and need.host <= machine.host
        and not profile_of(ATI, name).acceleration.keeps_float8
    }  # fmt: skip
    assert {"fast", "small"} <= able
    assert set(re.findall(r"[\w-]+", caught.value.detail)) & needs.keys() == able | {"exact"}
    check("small", checkpoint, checkpoint)
    machine.host -= 1
    with refused("generator-unavailable"):
        check("small", checkpoint, checkpoint)
    machine.room = 1
    with refused("generator-unavailable") as caught:
        check("turbo", checkpoint, checkpoint)
    assert "COW_PROFILE" not in caught.value.detail, "none would do"
    machine.host = max(needs["portable"].device, needs["portable"].host)
    check("portable", checkpoint, checkpoint, "cpu")
    machine.host -= 1
    with refused("generator-unavailable"):
        check("portable", checkpoint, checkpoint, "cpu")
    with refused("generator-unavailable") as caught:  # also where weights are missing, which are told, too
        machine.host = "max"
        check("small-float8", tmp_path, tmp_path)
    assert "cow models pull ati" in caught.value.detail


def test_float8_is_kept_only_where_there_is_some(toys, checkpoint, tmp_path, machine) -> None:
    with refused("generator-unavailable") as caught:
        check("small-float8", checkpoint, checkpoint)
    assert "COW_CHECKPOINTS" in caught.value.detail
    weights = toys.load_file(next((checkpoint / "transformer").glob("*.safetensors")))
    small = {name: each.to(toys.torch.float8_e4m3fn) for name, each in weights.items()}
    toys.save_file(small, tmp_path / "one.safetensors")
    check("small-float8", tmp_path / "one.safetensors", checkpoint)


def test_what_cannot_be_read_is_left_to_loading(checkpoint: Path, tmp_path: Path, machine: SimpleNamespace) -> None:
    machine.room = 1
    check("exact", tmp_path, checkpoint)
    check("exact", checkpoint, tmp_path)
    (tmp_path / "text_encoder").mkdir()
    (tmp_path / "text_encoder" / "model.safetensors").write_bytes(b"damaged")
    check("exact", checkpoint, tmp_path)
