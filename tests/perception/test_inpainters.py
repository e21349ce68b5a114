"""Inpainters, with the real network at toy size and random weights: what is painted where, and what is refused."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from refusals import refused

from cow_service.errors import Canceled
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests
from cow_service.weights.repositories import Lock, LockedFile, folder_of, write_lock

pytestmark = pytest.mark.slow

SIZES = {"ngf": 4, "n_blocks": 2, "ratio_gin": 0.75}
FILE, REPOSITORY = "big-lama.safetensors", "michaelgold/big-lama"
Load = Callable[[dict[str, Any] | None], Any]


def ignore(done: float) -> None:
    """There is no listener."""


@pytest.fixture(scope="module")
def inpainters() -> ModuleType:
    from cow_service.perception import inpainters

    return inpainters


@pytest.fixture
def weights(inpainters: ModuleType) -> dict[str, Any]:
    with inpainters.torch.random.fork_rng(devices=[]):
        inpainters.torch.manual_seed(0)
        state = inpainters.Lama(4, 2, 0.75).state_dict()
    # Larger than those that PyTorch draws, with which every picture would be grey.
    return {inpainters.PREFIX + name: 2.5 * tensor if tensor.ndim > 1 else tensor for name, tensor in state.items()}


@pytest.fixture
def load(inpainters: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Load:
    """Has the factory load these weights, as `cow models pull` would have left them."""
    from safetensors.torch import save_file

    tiny = load_manifests()["lama"].model_copy(update={"architecture": SIZES})
    monkeypatch.setattr(inpainters, "load_manifests", lambda: {"lama": tiny})

    def loaded(weights: dict[str, Any] | None) -> Any:
        if weights is not None:
            folder = folder_of(tmp_path, REPOSITORY)
            folder.mkdir()
            save_file(weights, folder / FILE)
            data = (folder / FILE).read_bytes()
            file = LockedFile(path=FILE, size=len(data), algorithm="sha256", digest=hashlib.sha256(data).hexdigest())
            write_lock(tmp_path, Lock(repository=REPOSITORY, revision="0" * 40, patterns=(FILE,), files=(file,)))
        return inpainters.create_lama(Settings(data_dir=tmp_path, models_dir=tmp_path, device="cpu"))

    return loaded


@pytest.mark.parametrize(
    ("height", "width", "hole", "colours"),
    [
        (61, 97, (20, 30, 30, 50), (128.3, 74.1)),
        (300, 40, (0, 0, 40, 40), (130.8, 73.4)),
        (9, 11, (3, 3, 5, 5), (139.9, 76.9)),
        (90, 700, (0, 600, 90, 700), (130.0, 75.7)),
    ],
)
def test_the_hole_is_painted_and_nothing_else_changes(
    load: Load, weights, inpainters, height: int, width: int, hole: tuple[int, ...], colours, monkeypatch
) -> None:
    monkeypatch.setattr(inpainters, "MOST_SIDE", 128)  # larger crops are painted smaller
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    inside = np.zeros((height, width), bool)
    inside[hole[0] : hole[2], hole[1] : hole[3]] = True
    painter, shares = load(weights), []
    painted = painter.fill(image, inside, shares.append)
    assert (painted[~inside] == image[~inside]).all()
    assert (painted[inside].mean(), painted[inside].std()) == pytest.approx(colours, abs=0.5)
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] <= 1
    # What stood in the hole decides nothing.
    other = np.where(inside[..., None], np.uint8(9), image)
    assert (painter.fill(other, inside, ignore) == painted).all()


def test_nothing_to_paint_is_no_work_and_a_canceled_fill_ends(load: Load, weights) -> None:
    painter, image = load(weights), np.zeros((40, 40, 3), np.uint8)
    assert painter.fill(image, np.zeros((40, 40), bool), pytest.fail) is image

    def cancel(done: float) -> None:
        raise Canceled("nobody wants it")

    with pytest.raises(Canceled):
        painter.fill(image, np.eye(40) > 0, cancel)


def test_missing_weights_are_refused_with_the_command_that_pulls_them(load: Load) -> None:
    with refused("perception-unavailable") as caught:
        load(None)
    assert "cow models pull lama" in caught.value.detail


@pytest.mark.parametrize(("change", "name"), [
    (lambda w: w.pop("generator.model.5.conv1.ffc.convl2g.weight"), "model.5.conv1.ffc.convl2g.weight"),
    (lambda w: w.update({"generator.lfu": w["generator.model.1.bn_l.bias"].new_ones(1)}), "lfu"),
    (lambda w: w.update({"generator.model.1.bn_l.bias": w["generator.model.1.bn_l.bias"].new_ones(5)}),
     "model.1.bn_l.bias"),
])  # fmt: skip
def test_weights_of_another_model_are_refused_by_name(load: Load, weights, change, name: str) -> None:
    change(weights)
    with refused("perception-unavailable") as caught:
        load(weights)
    assert name in caught.value.detail


def test_running_out_of_memory_is_refused(load: Load, weights, inpainters, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise inpainters.torch.OutOfMemoryError("full")

    monkeypatch.setattr(inpainters.Lama, "forward", fail)
    with refused("perception-unavailable") as caught:
        load(weights).fill(np.zeros((40, 40, 3), np.uint8), np.eye(40) > 0, ignore)
    assert "COW_PERCEPTION" in caught.value.detail


def test_the_full_size_has_the_parameters_of_its_manifest(inpainters: ModuleType) -> None:
    with inpainters.torch.device("meta"):
        model = inpainters.Lama(64, 18, 0.75)
    assert sum(each.numel() for each in model.parameters()) == load_manifests()["lama"].parameters["generator"]
    assert len(model.state_dict()) == 989  # tensors of the published generator
