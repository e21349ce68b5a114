"""What weights take of memory, before they are read: computed from headers, compared with what loads."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from cow_service.errors import GeneratorUnavailable
from cow_service.generators.wan import memory
from cow_service.generators.wan.loading import assemble
from cow_service.generators.wan.memory import check_machine, need_of
from cow_service.generators.wan.profiles import profile_of
from cow_service.generators.wan.tiny import make_tiny
from cow_service.weights.manifests import load_manifests

ATI = load_manifests()["ati"]
TOY = load_manifests()["tiny-ati"].architecture
GPU = torch.device("cuda", 0)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy as diffusers saves it: transformer and base in one folder."""
    folder = tmp_path_factory.mktemp("toy")
    make_tiny(TOY).save_pretrained(folder)
    return folder


def here(checkpoint: Path) -> dict[str, Path]:
    return {"transformer": checkpoint, "base": checkpoint}


@pytest.mark.parametrize(
    ("profile", "device", "host"),
    [
        ("exact", 47.2, 0),
        ("turbo", 46.9, 0),
        ("fast", 30.8, 47.2),
        ("small", 2.1, 63.5),
        ("small-turbo", 1.9, 63.3),
        ("small-float8", 16.4, 30.8),
    ],
)
def test_what_the_published_weights_take(profile: str, device: float, host: float) -> None:
    need = need_of(profile_of(ATI, profile), ATI.parameters, 40)
    assert (need.device / 1e9, need.host / 1e9) == (pytest.approx(device, abs=0.1), pytest.approx(host, abs=0.1))


def test_it_is_what_the_loaded_parts_take(checkpoint: Path) -> None:
    parts = assemble(make_tiny(TOY).transformer.to(torch.bfloat16), checkpoint, torch.bfloat16, torch.float32)
    models = [part for part in parts.components.values() if isinstance(part, torch.nn.Module)]
    taken = sum(weight.numel() * weight.element_size() for model in models for weight in model.parameters())
    parameters, _ = memory._read_headers(here(checkpoint), tuple(ATI.parameters))
    assert need_of(profile_of(ATI, "exact"), parameters, 2).device == pytest.approx(taken, rel=0.03)


def test_weights_that_are_missing_too_are_told(tmp_path: Path) -> None:
    with pytest.raises(GeneratorUnavailable, match=r"run `cow models pull ati`.*`generator: cutout`"):
        check_machine(ATI, "exact", here(tmp_path), torch.device("cpu"))


def test_what_does_not_fit_is_refused_and_what_fits_is_named(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no GPU here: its size, and what it can do, are fakes."""
    monkeypatch.setattr(memory, "detect_capabilities", lambda device: None)
    monkeypatch.setattr(memory, "refusals", lambda wanted, machine: ())
    parameters, _ = memory._read_headers(here(checkpoint), tuple(ATI.parameters))
    need = {name: need_of(profile_of(ATI, name), parameters, ATI.architecture["num_layers"]) for name in ATI.profiles}
    monkeypatch.setattr(memory, "_room", lambda device: need["fast"].device)
    monkeypatch.setattr(memory, "_host", lambda: need["small"].host)
    check_machine(ATI, "fast", here(checkpoint), GPU)
    with pytest.raises(GeneratorUnavailable, match=r"'exact': .* of the GPU's memory.*can run: fast, .*small"):
        check_machine(ATI, "exact", here(checkpoint), GPU)
    monkeypatch.setattr(memory, "_host", lambda: need["small"].host - 1)
    with pytest.raises(GeneratorUnavailable, match=r"of this machine's memory.*can run: fast, .*turbo"):
        check_machine(ATI, "small", here(checkpoint), GPU)
    monkeypatch.setattr(memory, "_room", lambda device: min(each.device for each in need.values()) - 1)
    with pytest.raises(GeneratorUnavailable, match="can run none of its profiles"):
        check_machine(ATI, "turbo", here(checkpoint), GPU)
    monkeypatch.setattr(memory, "_host", lambda: need["portable"].device - 1)
    with pytest.raises(GeneratorUnavailable, match="of this machine's memory"):
        check_machine(ATI, "portable", here(checkpoint), torch.device("cpu"))


def test_float8_is_kept_only_where_there_is_some(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Told before anything is read, and no such profile is recommended."""
    monkeypatch.setattr(memory, "detect_capabilities", lambda device: None)
    monkeypatch.setattr(memory, "refusals", lambda wanted, machine: ())
    monkeypatch.setattr(memory, "_room", lambda device: 10**12)
    with pytest.raises(GeneratorUnavailable, match=r"'small-float8': .*needs a checkpoint .* float8.*COW_CHECKPOINTS"):
        check_machine(ATI, "small-float8", here(checkpoint), GPU)
    monkeypatch.setattr(memory, "_room", lambda device: 20_000)
    with pytest.raises(GeneratorUnavailable) as caught:
        check_machine(ATI, "exact", here(checkpoint), GPU)
    assert "small-float8" not in caught.value.detail
    weights = load_file(next((checkpoint / "transformer").glob("*.safetensors")))
    save_file({name: each.to(torch.float8_e4m3fn) for name, each in weights.items()}, tmp_path / "one.safetensors")
    monkeypatch.setattr(memory, "_room", lambda device: 10**12)
    check_machine(ATI, "small-float8", {"transformer": tmp_path / "one.safetensors", "base": checkpoint}, GPU)


def test_what_cannot_be_read_is_left_to_loading(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "detect_capabilities", lambda device: None)
    monkeypatch.setattr(memory, "refusals", lambda wanted, machine: ())
    check_machine(ATI, "exact", {}, GPU)
    check_machine(ATI, "exact", {"transformer": tmp_path, "base": checkpoint}, GPU)
    (tmp_path / "text_encoder").mkdir()
    (tmp_path / "text_encoder" / "model.safetensors").write_bytes(b"damaged")
    check_machine(ATI, "exact", {"transformer": checkpoint, "base": tmp_path}, GPU)
