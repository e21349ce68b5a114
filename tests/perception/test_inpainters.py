"""Inpainters, with the real network at toy size and random weights: what is painted where, and what is refused."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from cow_service.errors import Canceled, PerceptionUnavailable
from cow_service.perception import inpainters
from cow_service.perception.inpainters import Lama, LamaInpainter, create_lama
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests
from cow_service.weights.repositories import Lock, LockedFile, folder_of, write_lock

SIZES = {"ngf": 4, "n_blocks": 2, "ratio_gin": 0.75}
FILE, REPOSITORY = "big-lama.safetensors", "michaelgold/big-lama"


def ignore(done: float) -> None:
    """There is no listener."""


@pytest.fixture
def weights() -> dict[str, torch.Tensor]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        state = Lama(4, 2, 0.75).state_dict()
    return {inpainters.PREFIX + name: tensor for name, tensor in state.items()}


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Has the factory load these weights, as `cow models pull` would have left them."""
    tiny = load_manifests()["lama"].model_copy(update={"architecture": SIZES})
    monkeypatch.setattr(inpainters, "load_manifests", lambda: {"lama": tiny})

    def loaded(weights: dict[str, torch.Tensor] | None) -> LamaInpainter:
        if weights is not None:
            folder = folder_of(tmp_path, REPOSITORY)
            folder.mkdir()
            save_file(weights, folder / FILE)
            data = (folder / FILE).read_bytes()
            file = LockedFile(path=FILE, size=len(data), algorithm="sha256", digest=hashlib.sha256(data).hexdigest())
            write_lock(tmp_path, Lock(repository=REPOSITORY, revision="0" * 40, patterns=(FILE,), files=(file,)))
        return create_lama(Settings(data_dir=tmp_path, models_dir=tmp_path, device="cpu"))

    return loaded


@pytest.mark.parametrize(
    ("height", "width", "hole"),
    [(61, 97, (20, 30, 30, 50)), (300, 40, (0, 0, 40, 40)), (9, 11, (3, 3, 5, 5)), (90, 700, (0, 600, 90, 700))],
)
def test_the_hole_is_painted_and_nothing_else_changes(load, weights, height, width, hole, monkeypatch) -> None:
    monkeypatch.setattr(inpainters, "MOST_SIDE", 128)  # larger crops are painted smaller
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    inside = np.zeros((height, width), bool)
    inside[hole[0] : hole[2], hole[1] : hole[3]] = True
    painter, shares = load(weights), []
    painted = painter.fill(image, inside, shares.append)
    assert (painted[~inside] == image[~inside]).all()
    assert (painted[inside] != image[inside]).any()
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] <= 1
    # What stood in the hole decides nothing.
    other = np.where(inside[..., None], np.uint8(9), image)
    assert (painter.fill(other, inside, ignore) == painted).all()


def test_nothing_to_paint_is_no_work(load, weights) -> None:
    image = np.zeros((20, 30, 3), np.uint8)
    assert load(weights).fill(image, np.zeros((20, 30), bool), pytest.fail) is image


def test_a_canceled_fill_ends(load, weights) -> None:
    def cancel(done: float) -> None:
        raise Canceled("nobody wants it")

    with pytest.raises(Canceled):
        load(weights).fill(np.zeros((40, 40, 3), np.uint8), np.eye(40) > 0, cancel)


def test_missing_weights_are_named_with_the_command_that_pulls_them(load) -> None:
    with pytest.raises(PerceptionUnavailable, match="cow models pull lama"):
        load(None)


@pytest.mark.parametrize(("change", "message"), [
    (lambda w: w.pop("generator.model.5.conv1.ffc.convl2g.weight"), r"lack model\.5\.conv1\.ffc\.convl2g\.weight"),
    (lambda w: w.update({"generator.lfu": torch.ones(1)}), "beyond its model, lfu"),
    (lambda w: w.update({"generator.model.1.bn_l.bias": torch.ones(5)}), r"size mismatch for model\.1\.bn_l\.bias"),
])  # fmt: skip
def test_weights_of_another_model_are_refused_by_name(load, weights, change, message: str) -> None:
    change(weights)
    with pytest.raises(PerceptionUnavailable, match=message):
        load(weights)


def test_running_out_of_memory_is_told(load, weights, monkeypatch) -> None:
    painter = load(weights)
    monkeypatch.setattr(
        painter._model.network, "forward", lambda *_: (_ for _ in ()).throw(torch.OutOfMemoryError("full"))
    )
    with pytest.raises(PerceptionUnavailable, match="ran out of memory"):
        painter.fill(np.zeros((40, 40, 3), np.uint8), np.eye(40) > 0, ignore)


def test_the_full_size_has_the_parameters_of_its_manifest() -> None:
    manifest = load_manifests()["lama"]
    with torch.device("meta"):
        model = Lama(64, 18, 0.75)
    assert sum(each.numel() for each in model.parameters()) == manifest.parameters["generator"]
    assert len(model.state_dict()) == 989  # tensors of the published generator
