"""The whole life of published weights at toy size: pulled, locked, loaded, used, damaged."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import example
from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers
from golden import original_weights
from hub import Blob, Hub, running
from safetensors.torch import save

from cow_service.errors import CheckpointInvalid, WeightsUnavailable
from cow_service.generators.wan.loading import create_ati
from cow_service.generators.wan.tiny import make_tiny
from cow_service.records import Simulation
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

BALL = example("ball-and-mug")
TOY = load_manifests()["tiny-ati"].architecture
ATI = load_manifests()["ati"]


def original_form() -> dict[str, Blob]:
    """The toy transformer as ATI's repository lays it out: original names, two shards."""
    names: dict[str, Any] = convert_wan_transformer_to_diffusers({name: name for name in original_weights()})
    weights = make_tiny(TOY).transformer.state_dict()
    held = {original: weights[ours].contiguous() for ours, original in names.items()}
    assert len(held) == len(weights)
    order = sorted(held)
    files = {
        f"diffusion_pytorch_model-0000{i + 1}-of-00002.safetensors": Blob(save({n: held[n] for n in order[i::2]}))
        for i in range(2)
    }
    return files | {"config.json": Blob(json.dumps(TOY | {"_class_name": "WanModel"}).encode(), lfs=False)}


@pytest.fixture(scope="module")
def hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hub]:
    base = tmp_path_factory.mktemp("base")
    make_tiny(TOY).save_pretrained(base)
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
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("home")
    (folder / "image.jpg").write_bytes(BALL.image)
    return folder


def cow(home: Path, hub: Hub, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {
        "COW_DATA_DIR": str(home / "data"), "COW_PROFILE": "portable", "COW_DEVICE": "cpu", "HF_ENDPOINT": hub.address,
        "HF_HOME": str(home / "hub"), "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb",
    }  # fmt: skip
    command = [sys.executable, "-m", "cow_service.cli.main", *arguments]
    return subprocess.run(command, env=os.environ | environment, cwd=home, capture_output=True, text=True, check=False)


def settings(home: Path, **given: Any) -> Settings:
    """Those of the server that `cow` is."""
    return Settings(data_dir=home / "data", profile="portable", device="cpu", **given)


@pytest.mark.soak
def test_pulled_checked_loaded_and_used(home: Path, hub: Hub) -> None:
    before = cow(home, hub, "models", "check", "ati")
    assert before.returncode == 1
    assert "bytedance-research/ATI" in before.stdout
    pulled = cow(home, hub, "models", "pull", "ati")
    assert pulled.returncode == 0, pulled.stderr
    assert cow(home, hub, "models", "check", "ati").returncode == 0
    models = json.loads(cow(home, hub, "models", "--json").stdout)["generators"]
    assert [(m["ready"], m["pull"]) for m in models if m["name"] == "ati"] == [(True, None)]
    options = ("--generator", "ati", "--num-frames", "5", "--no-video", "--out", "out", "--option", "steps=2")
    done = cow(home, hub, "simulate", "image.jpg", BALL.meta["question"], *options)
    assert done.returncode == 0, done.stderr
    found = Simulation.model_validate_json((home / "out" / "simulation.json").read_bytes())
    repository = ATI.sources["transformer"].repository
    assert found.generator.model == repository
    assert found.generator.revision == hub.main[repository]
    assert found.generator.steps == 2
    assert found.generator.options["shift"] == 5.0
    assert str(found.generator.options["negative_prompt"]).startswith("镜头晃动")


def test_damaged_weights_are_not_loaded(home: Path, hub: Hub) -> None:
    assert cow(home, hub, "models", "pull", "ati").returncode == 0  # of what is there already it loads nothing
    file = next((home / "data" / "models").rglob("diffusion_pytorch_model-00002-of-00002.safetensors"))
    whole = file.read_bytes()
    try:
        file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        with pytest.raises(WeightsUnavailable) as refused:
            create_ati(settings(home))
        assert "diffusion_pytorch_model-00002-of-00002.safetensors" in refused.value.detail
        assert "cow models pull ati" in refused.value.detail
    finally:
        file.write_bytes(whole)


def test_a_checkpoint_of_ones_own(home: Path, hub: Hub, tmp_path: Path) -> None:
    """One file in place of the pulled transformer; what is wrong with it is named, and no path of this machine."""
    assert cow(home, hub, "models", "pull", "ati").returncode == 0
    with pytest.raises(CheckpointInvalid, match=r"There is no checkpoint 'absent.safetensors'"):
        create_ati(settings(home, checkpoints={"ati": tmp_path / "absent.safetensors"}))
    (tmp_path / "mine.safetensors").write_bytes(
        save({"blocks.0.self_attn.q.weight": original_weights()["head.head.bias"]})
    )
    with pytest.raises(CheckpointInvalid, match="missing: ") as refused:
        create_ati(settings(home, checkpoints={"ati": tmp_path / "mine.safetensors"}))
    assert str(tmp_path) not in refused.value.detail
