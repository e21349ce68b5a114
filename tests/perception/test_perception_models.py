"""The vision models, at toy size: real classes and files, random weights, pulled from a hub and loaded by factory."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hub import Blob, Hub, running
from safetensors.torch import load_file, save_file
from toy_perception import MAKERS, MOGE_BACKBONE, SIDE

from cow_service.errors import PerceptionUnavailable, WeightsUnavailable
from cow_service.perception import depth, dino, moge, sam
from cow_service.perception.base import Prompt
from cow_service.perception.loading import LoadedModel
from cow_service.settings import Settings
from cow_service.vision.types import Image
from cow_service.weights.manifests import find_manifest
from cow_service.weights.repositories import download, resolve

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 120, 80
Toys = dict[str, Any]
FACTORIES: dict[str, Callable[[Settings], Any]] = {
    "sam2-tiny": sam.create_sam2_tiny,
    "grounding-dino-tiny": dino.create_dino_tiny,
    "depth-anything-indoor": depth.create_depth_anything_indoor,
    "moge-2-small": depth.create_moge_2_small,
}


CALLS: dict[str, Callable[[Any, Image], Any]] = {
    "sam2-tiny": lambda toy, image: toy.embed(image),
    "grounding-dino-tiny": lambda toy, image: toy.detect(image, ["ball"]),
    "depth-anything-indoor": lambda toy, image: toy.estimate(image, None),
    "moge-2-small": lambda toy, image: toy.estimate(image, None),
}


@pytest.fixture(scope="module", autouse=True)
def _toy_sizes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(moge, "BACKBONES", moge.BACKBONES | MOGE_BACKBONE)
        patch.setattr(dino, "SHORT_SIDE", 64)
        patch.delenv("HF_TOKEN", raising=False)
        yield


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder into which the toys were pulled by the sources of the real manifests."""
    data = tmp_path_factory.mktemp("home")
    torch.manual_seed(0)
    with running() as hub:
        for name, make in MAKERS.items():
            folder = tmp_path_factory.mktemp(name)
            make(folder)
            pull(hub, name, {path.name: Blob(path.read_bytes()) for path in folder.iterdir()}, data)
    return data


def pull(hub: Hub, name: str, files: dict[str, Blob], data: Path, **changed: Any) -> None:
    manifest = find_manifest(name)
    assert manifest is not None
    source = manifest.sources["weights"].model_copy(update=changed)
    hub.commit(source.repository, files)
    weights = Settings(data_dir=data).weights_dir
    download([resolve(source, weights, endpoint=hub.address)], weights, endpoint=hub.address)


@pytest.fixture(scope="module")
def toys(home: Path) -> Toys:
    return {name: create(Settings(data_dir=home, device="cpu")) for name, create in FACTORIES.items()}


def own(home: Path, name: str, tmp_path: Path) -> Path:
    """A copy of a model's files that may be changed."""
    manifest = find_manifest(name)
    assert manifest is not None
    pulled = Settings(data_dir=home).weights_dir / str(manifest.weights).replace("/", "--")
    return shutil.copytree(pulled, tmp_path / "own")


def load_own(name: str, folder: Path) -> Any:
    return FACTORIES[name](Settings(data_dir=folder.parent, device="cpu", checkpoints={name: folder}))


def picture(seed: int = 0) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def listen(network: torch.nn.Module) -> list[dict[str, Any]]:
    """The arguments by name of each call from here on."""
    heard: list[dict[str, Any]] = []
    network.register_forward_pre_hook(lambda _, args, named: heard.append(named | {"args": args}), with_kwargs=True)
    return heard


# --- loading ---


@pytest.mark.parametrize("name", FACTORIES)
class TestLoading:
    def test_the_fingerprint_changes_with_the_weights(self, name: str, home: Path, toys: Toys, tmp_path: Path) -> None:
        assert name in toys[name].fingerprint
        assert load_own(name, own(home, name, tmp_path)).fingerprint != toys[name].fingerprint

    @pytest.mark.parametrize("is_missing", [True, False])
    def test_keys_that_do_not_fit_are_refused(self, name: str, is_missing: bool, home: Path, tmp_path: Path) -> None:
        folder = own(home, name, tmp_path)
        file = next(folder.glob("model.*"))
        pickled = torch.load(file, weights_only=True) if file.suffix == ".pt" else None
        weights = load_file(file) if pickled is None else pickled["model"]
        key = next(key for key in sorted(weights) if "proj" in key and not key.startswith("memory"))
        if is_missing:
            del weights[key]
        else:
            weights[key := "zzz.weight"] = torch.zeros(1)
        if pickled is None:
            save_file(weights, file, {"format": "pt"})
        else:
            torch.save(pickled, file)
        with pytest.raises(PerceptionUnavailable, match="The weights of") as refused:
            load_own(name, folder)
        assert ".".join(key.split(".")[-3:]) in refused.value.detail  # where it begins, published names may differ
        assert str(tmp_path) not in refused.value.detail

    def test_missing_weights_are_refused_with_the_command_that_pulls_them(self, name: str, tmp_path: Path) -> None:
        with pytest.raises(PerceptionUnavailable, match=f"Run `cow models pull {name}`"):
            FACTORIES[name](Settings(data_dir=tmp_path, device="cpu"))

    def test_out_of_memory_says_what_to_do(self, name: str, toys: Toys, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*_: Any) -> None:
            raise torch.OutOfMemoryError("CUDA out of memory")

        monkeypatch.setattr(torch.nn.Conv2d, "forward", fail)
        with pytest.raises(PerceptionUnavailable, match=f"'{name}' ran out of memory on cpu. Set COW_PERCEPTION"):
            CALLS[name](toys[name], picture())


def test_a_pickle_is_pulled_only_where_the_manifest_says_so_and_runs_no_code(home: Path, tmp_path: Path) -> None:
    with running() as hub, pytest.raises(WeightsUnavailable, match="only pickled files"):
        pull(hub, "moge-2-small", {"model.pt": Blob(b"x")}, tmp_path / "data", pickled=False)

    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (tmp_path / "sprung").touch, ()

    folder = own(home, "moge-2-small", tmp_path)
    torch.save({"model_config": Trap(), "model": {}}, folder / "model.pt")
    with pytest.raises(PerceptionUnavailable, match="'moge-2-small' cannot be loaded: UnpicklingError"):
        load_own("moge-2-small", folder)
    assert not (tmp_path / "sprung").exists()


# --- segmenter ---

PROMPTS = (
    Prompt(point=(30.0, 60.0)), Prompt(bbox=(10.0, 20.0, 60.0, 70.0)), Prompt(point=(90.5, 20.0)),
    Prompt(bbox=(0.0, 0.0, 120.0, 80.0)),
)  # fmt: skip


def test_prompts_reach_the_segmenter_at_their_places(toys: Toys) -> None:
    toy = toys["sam2-tiny"]
    heard = listen(toy._model.network.prompt_encoder.shared_embedding)
    toy.segment(toy.embed(picture()), PROMPTS)
    points, boxes = (call["args"][0][0, :, :-1].numpy() / SIDE * (WIDTH, HEIGHT) for call in heard[:2])  # the last pads
    np.testing.assert_allclose(points[:, 0], [(30, 60), (90.5, 20)], atol=1e-4)
    np.testing.assert_allclose(boxes.reshape(2, 4), [(10, 20, 60, 70), (0, 0, 120, 80)], atol=1e-4)


def test_one_embedding_serves_many_prompts_as_if_each_were_alone(toys: Toys, monkeypatch: pytest.MonkeyPatch) -> None:
    toy = toys["sam2-tiny"]
    encoded = listen(toy._model.network.vision_encoder)
    embedding = toy.embed(picture())
    together = toy.segment(embedding, PROMPTS)
    monkeypatch.setattr(sam, "MOST_TOGETHER", 1)
    assert [len(each) for each in together] == [3, 1, 3, 1]
    for candidates, (alone,) in zip(together, (toy.segment(embedding, [each]) for each in PROMPTS), strict=True):
        assert [each.score for each in candidates] == sorted((each.score for each in candidates), reverse=True)
        for one, other in zip(candidates, alone, strict=True):
            assert (one.logits.shape, one.logits.dtype) == ((SIDE // 4, SIDE // 4), np.float32)
            assert 0 <= one.score <= 1
            np.testing.assert_allclose(one.logits, other.logits, atol=1e-5)
    assert len(encoded) == 1
    assert np.abs(together[0][0].logits - together[2][0].logits).max() > 0.1, "another point, another mask"
    ((other, *_),) = toy.segment(toy.embed(picture(1)), PROMPTS[:1])
    assert np.abs(together[0][0].logits - other.logits).max() > 0.1, "another image, another mask"


def test_a_box_is_what_transformers_makes_of_one(toys: Toys) -> None:
    toy = toys["sam2-tiny"]
    embedding = toy.embed(picture())
    box = torch.tensor([[[10 / WIDTH, 20 / HEIGHT, 60 / WIDTH, 70 / HEIGHT]]]) * SIDE - 0.5
    with torch.inference_mode():
        found = toy._model.network(image_embeddings=embedding.maps, input_boxes=box, multimask_output=False)
    np.testing.assert_allclose(toy.segment(embedding, PROMPTS[1:2])[0][0].logits, found.pred_masks[0, 0, 0], atol=1e-4)


# --- detector ---


def crafted(toy: dino.DinoDetector, queries: list[tuple[list[float], list[float]]]) -> dino.DinoDetector:
    """The same with a network that finds, for each query, a box (middle, size) and chances of the text's tokens."""
    chances = torch.zeros(len(queries), 8)
    for row, (_, values) in zip(chances, queries, strict=True):
        row[1 : 1 + len(values)] = torch.tensor(values)  # after the first token, which begins the text
    output = SimpleNamespace(
        logits=torch.logit(chances, eps=1e-6)[None], pred_boxes=torch.tensor([box for box, _ in queries])[None]
    )

    def network(**_: Any) -> Any:
        return output

    network.config = toy._model.network.config
    model = LoadedModel(toy._model.manifest, Path(), network, torch.device("cpu"), "crafted")
    return dino.DinoDetector(model, toy._tokenizer)


def test_boxes_come_back_in_pixels_with_the_phrase_that_fits_best(toys: Toys) -> None:
    detector = crafted(toys["grounding-dino-tiny"], [
        ([0.5, 0.5, 0.5, 0.25], [0.1, 0.6, 0.0, 0.55]),  # tokens: blue mug . mug
        ([0.5, 0.5, 0.5, 0.26], [0.1, 0.5, 0.0, 0.5]),  # the same thing once more
        ([0.1, 0.9, 0.4, 0.4], [0.7, 0.8, 0.0, 0.6]),  # beyond the image
        ([0.5, 0.1, 0.1, 0.1], [0.29, 0.28, 0.0, 0.28]),
    ])  # fmt: skip
    blue, mug = detector.detect(picture(), ["Blue mug", "mug"])
    assert (blue.phrase, mug.phrase) == ("Blue mug", "mug")
    assert blue.bbox == pytest.approx((0, 56, 36, 80), abs=1e-4)
    assert mug.bbox == pytest.approx((30, 30, 90, 50), abs=1e-4)
    assert (blue.score, mug.score) == (pytest.approx(0.8), pytest.approx(0.55))


def test_many_phrases_are_sought_in_groups_that_fit_the_models_text(toys: Toys) -> None:
    toy = toys["grounding-dino-tiny"]
    heard = listen(toy._model.network)
    phrases = ["blue mug", "a ball", "table", "red table", ".", "table"]
    found = toy.detect(picture(), phrases)
    text = toy._tokenizer(["blue mug. a ball.", "table. red table."])["input_ids"]
    assert [call["input_ids"][0].tolist() for call in heard] == text
    assert heard[0]["pixel_values"].shape == (1, 3, 64, 96)
    one_by_one = [each for group in (phrases[:2], phrases[2:]) for each in toy.detect(picture(), group)]
    assert found, "random weights find something, too"
    assert sorted(found, key=repr) == sorted(one_by_one, key=repr)
    assert all(0 <= each.bbox[0] < each.bbox[2] <= WIDTH and each.bbox[3] <= HEIGHT for each in found)


# --- depth ---


def test_depth_anything_keeps_the_shape_of_the_image(home: Path, toys: Toys, tmp_path: Path) -> None:
    heard = listen(toys["depth-anything-indoor"]._model.network)
    reading = toys["depth-anything-indoor"].estimate(picture(), 100.0)
    assert heard[0]["args"][0].shape == (1, 3, 56, 84)
    assert (reading.depth.shape, reading.scale, reading.focal) == ((56, 84), 1.0, None)
    assert 0 < reading.depth.min() < reading.depth.max() < 20
    folder = own(home, "depth-anything-indoor", tmp_path)
    config = json.loads((folder / "config.json").read_text()) | {"depth_estimation_type": "relative"}
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(PerceptionUnavailable, match="not one of the metric models"):
        load_own("depth-anything-indoor", folder)


def test_moge_reads_an_image_of_any_shape(toys: Toys) -> None:
    wide, tall = (toys["moge-2-small"].estimate(each, None) for each in (picture(), picture().swapaxes(0, 1)))
    assert (wide.depth.shape, tall.depth.shape) == ((24, 36), (36, 24))
    assert np.isfinite(wide.depth).all()
    assert wide.depth.min() > 0


@pytest.mark.parametrize("exif", [None, 150.0])
@pytest.mark.parametrize(("width", "height", "focal"), [(120, 80, 150.0), (600, 900, 500.0), (400, 100, 900.0)])
def test_moge_recovers_focal_length_and_metres(
    width: int, height: int, focal: float, exif: float | None, toys: Toys
) -> None:
    """A slanted wall and a box before it, as the network gives it: another unit, and shifted along z; sky on top."""
    v, u = np.mgrid[: height // 4, : width // 4] * 4.0 + 2
    z = 4 + u / width
    z[height // 8 :, width // 16 : width // 8] = 2.0
    points = np.stack([(u - width / 2) * z / focal, (v - height / 2) * z / focal, z - 0.7], axis=-1) / 2.5
    points += np.random.default_rng(0).normal(0, 0.002, points.shape)
    sure = np.where(v < height / 8, 0.1, 0.9)

    class Crafted:
        grid = staticmethod(lambda *_: (2, 2))

        def __call__(self, *_: Any) -> Any:
            return [torch.tensor(each) for each in (points, sure, 2.5)]

    model = LoadedModel(toys["moge-2-small"]._model.manifest, Path(), Crafted(), torch.device("cpu"), "crafted")
    known = None if exif is None else focal
    reading = depth.MogeEstimator(model).estimate(np.zeros((height, width, 3), np.uint8), known)
    assert reading.focal == pytest.approx(focal, rel=0.01)
    assert (np.isnan(reading.depth) == (sure < 0.5)).all()
    assert np.nanmax(np.abs(reading.depth / z - 1)) < 0.02
