"""The whole life of published weights at toy size: pulled, locked, loaded, used, damaged."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hub import Blob, Hub, running
from refusals import refused

from cow_service.weights.manifests import load_manifests
from cow_service.weights.repositories import download, resolve

pytest_plugins = "toy_fixtures"
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

TOY = load_manifests()["tiny-ati"].architecture
ATI = load_manifests()["ati"]
SHARD = "diffusion_pytorch_model-00002-of-00002.safetensors"


def original_form() -> dict[str, Blob]:
    """The toy transformer as ATI's repository lays it out: original names, two shards."""
    import toys

    names: dict[str, Any] = toys.convert_wan_transformer_to_diffusers({name: name for name in toys.original_weights()})
    weights = toys.make_tiny(TOY).transformer.state_dict()
    held = {original: weights[ours].contiguous() for ours, original in names.items()}
    assert len(held) == len(weights)
    order = sorted(held)
    files = {
        f"diffusion_pytorch_model-0000{i + 1}-of-00002.safetensors": Blob(toys.save({n: held[n] for n in order[i::2]}))
        for i in range(2)
    }
    return files | {"config.json": Blob(json.dumps(TOY | {"_class_name": "WanModel"}).encode(), lfs=False)}


@pytest.fixture(scope="module")
def hub(toys, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hub]:
    base = tmp_path_factory.mktemp("base")
    toys.make_tiny(TOY).save_pretrained(base)
    parts = {
        str(path.relative_to(base)): Blob(path.read_bytes(), lfs=path.suffix == ".safetensors")
        for path in base.rglob("*")
        if path.is_file()
    }
    with running() as hub:
        hub.commit(ATI.sources["transformer"].repository, original_form())
        hub.commit(ATI.sources["base"].repository, parts)
        lora = ATI.sources["distilled-lora"]
        hub.commit(lora.repository, {lora.files[0]: Blob(b"not looked at here")})
        yield hub


@pytest.fixture(scope="module")
def pulled(tmp_path_factory: pytest.TempPathFactory, hub: Hub) -> Path:
    """A data folder with the weights."""
    folder = tmp_path_factory.mktemp("data")
    for source in ATI.sources.values():
        download([resolve(source, folder / "models", endpoint=hub.address)], folder / "models", endpoint=hub.address)
    return folder


def test_what_was_pulled_is_loaded_and_named(toys, pulled: Path, hub: Hub) -> None:
    made = toys.model("ati", pulled, profile="portable")
    wanted, ours = (dict(each.transformer.named_parameters()) for each in (toys.make_tiny(TOY), made.pipeline))
    assert ours.keys() == wanted.keys()
    assert toys.same(list(ours.values()), [weight.to(ours[name].dtype) for name, weight in wanted.items()])
    assert made.device == toys.CPU
    assert made.revisions == {part: hub.main[ATI.sources[part].repository] for part in ("base", "transformer")}
    again = toys.model("ati", pulled, profile="portable")
    assert again.fingerprint == made.fingerprint


def test_damaged_weights_are_not_loaded(toys, pulled: Path) -> None:
    file = next((pulled / "models").rglob(SHARD))
    whole = file.read_bytes()
    try:
        file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        with refused("weights-unavailable") as caught:
            toys.model("ati", pulled, profile="portable")
        assert SHARD in caught.value.detail
        assert "cow models pull ati" in caught.value.detail
    finally:
        file.write_bytes(whole)


def test_a_checkpoint_of_ones_own(toys, pulled: Path, tmp_path: Path) -> None:
    """One file in place of the pulled transformer; what is wrong with it is named, and no path of this machine."""
    bias = {"blocks.0.self_attn.q.weight": toys.original_weights()["head.head.bias"]}
    (tmp_path / "mine.safetensors").write_bytes(toys.save(bias))
    for name, named in (("absent.safetensors", "absent.safetensors"), ("mine.safetensors", "missing")):
        with refused("checkpoint-invalid") as caught:
            toys.model("ati", pulled, profile="portable", checkpoints={"ati": tmp_path / name})
        assert named in caught.value.detail
        assert str(tmp_path) not in caught.value.detail
