"""The vision models, at toy size: real classes and files, random weights, pulled from a hub and loaded by factory."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hub import Blob, Hub, running
from refusals import refused

from cow_service.media.types import Image
from cow_service.perception.base import Prompt
from cow_service.settings import Settings
from cow_service.weights.manifests import find_manifest
from cow_service.weights.repositories import download, resolve

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 120, 80
NAMES = ("sam2-tiny", "grounding-dino-tiny", "depth-anything-indoor", "moge-2-small")
Toys = dict[str, Any]


@pytest.fixture(scope="module")
def kit() -> Iterator[ModuleType]:
    """What makes toys and loads them."""
    import toy_perception

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(toy_perception.moge, "BACKBONES", toy_perception.moge.BACKBONES | toy_perception.MOGE_BACKBONE)
        patch.setattr(toy_perception.dino, "SHORT_SIDE", 64)
        patch.delenv("HF_TOKEN", raising=False)
        yield toy_perception


@pytest.fixture(scope="module")
def home(kit: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder into which the toys were pulled by the sources of the real manifests."""
    data = tmp_path_factory.mktemp("home")
    kit.torch.manual_seed(0)
    with running() as hub:
        for name, make in kit.MAKERS.items():
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
def toys(kit: ModuleType, home: Path) -> Toys:
    return {name: create(Settings(data_dir=home, device="cpu")) for name, create in kit.FACTORIES.items()}


@pytest.fixture(scope="module")
def networks(kit: ModuleType, home: Path) -> Any:
    return kit.networks(Settings(data_dir=home, device="cpu"))


def own(home: Path, name: str, tmp_path: Path) -> Path:
    """A copy of a model's files that may be changed."""
    manifest = find_manifest(name)
    assert manifest is not None
    pulled = Settings(data_dir=home).weights_dir / str(manifest.weights).replace("/", "--")
    return shutil.copytree(pulled, tmp_path / "own")


def load_own(kit: ModuleType, name: str, folder: Path) -> Any:
    return kit.FACTORIES[name](Settings(data_dir=folder.parent, device="cpu", checkpoints={name: folder}))


def picture(seed: int = 0) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def listen(network: Any) -> list[dict[str, Any]]:
    """The arguments by name of each call from here on."""
    heard: list[dict[str, Any]] = []
    network.register_forward_pre_hook(lambda _, args, named: heard.append(named | {"args": args}), with_kwargs=True)
    return heard


# --- loading ---


def test_the_fingerprint_changes_with_the_weights(kit: ModuleType, home: Path, toys: Toys, tmp_path: Path) -> None:
    assert all(name in toy.fingerprint for name, toy in toys.items())
    other = load_own(kit, "moge-2-small", own(home, "moge-2-small", tmp_path)).fingerprint
    assert other != toys["moge-2-small"].fingerprint


@pytest.mark.parametrize(
    ("name", "is_missing"),
    [("sam2-tiny", True), ("grounding-dino-tiny", False), ("moge-2-small", True), ("moge-2-small", False)],
)
def test_keys_that_do_not_fit_are_refused(
    name: str, is_missing: bool, kit: ModuleType, home: Path, tmp_path: Path
) -> None:
    folder = own(home, name, tmp_path)
    file = next(folder.glob("model.*"))
    pickled = kit.torch.load(file, weights_only=True) if file.suffix == ".pt" else None
    weights = kit.load_file(file) if pickled is None else pickled["model"]
    key = next(key for key in sorted(weights) if "proj" in key and not key.startswith("memory"))
    if is_missing:
        del weights[key]
    else:
        weights[key := "zzz.weight"] = kit.torch.zeros(1)
    if pickled is None:
        kit.save_file(weights, file, {"format": "pt"})
    else:
        kit.torch.save(pickled, file)
    with refused("perception-unavailable") as caught:
        load_own(kit, name, folder)
    assert ".".join(key.split(".")[-3:]) in caught.value.detail  # where it begins, published names may differ
    assert str(tmp_path) not in caught.value.detail


@pytest.mark.parametrize("name", NAMES)
def test_missing_weights_and_too_little_memory_are_refused(
    name: str, kit: ModuleType, toys: Toys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with refused("perception-unavailable") as caught:
        kit.FACTORIES[name](Settings(data_dir=tmp_path, device="cpu"))
    assert f"cow models pull {name}" in caught.value.detail

    def fail(*_: Any) -> None:
        raise kit.torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(kit.torch.nn.Conv2d, "forward", fail)
    with refused("perception-unavailable") as caught:
        kit.CALLS[name](toys[name], picture())
    assert "COW_PERCEPTION" in caught.value.detail


def test_a_pickle_is_pulled_only_where_the_manifest_says_so_and_runs_no_code(
    kit: ModuleType, home: Path, tmp_path: Path
) -> None:
    with running() as hub, refused("weights-unavailable"):
        pull(hub, "moge-2-small", {"model.pt": Blob(b"x")}, tmp_path / "data", pickled=False)

    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (tmp_path / "sprung").touch, ()

    folder = own(home, "moge-2-small", tmp_path)
    kit.torch.save({"model_config": Trap(), "model": {}}, folder / "model.pt")
    with refused("perception-unavailable"):
        load_own(kit, "moge-2-small", folder)
    assert not (tmp_path / "sprung").exists()


# --- segmenter ---

PROMPTS = (
    Prompt(point=(30.0, 60.0)), Prompt(bbox=(10.0, 20.0, 60.0, 70.0)), Prompt(point=(90.5, 20.0)),
    Prompt(bbox=(0.0, 0.0, 120.0, 80.0)),
)  # fmt: skip


def test_prompts_reach_the_segmenter_and_one_embedding_serves_many_as_if_each_were_alone(
    kit: ModuleType, networks: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = networks[0]["sam2-tiny"]
    toy, encoded = kit.sam.SamSegmenter(model), listen(model.network.vision_encoder)
    heard = listen(model.network.prompt_encoder.shared_embedding)
    embedding = toy.embed(picture())
    together = toy.segment(embedding, PROMPTS)
    places = [call["args"][0][0, :, :-1].numpy() / kit.SIDE * (WIDTH, HEIGHT) for call in heard[:2]]  # the last pads
    np.testing.assert_allclose(places[0][:, 0], [(30, 60), (90.5, 20)], atol=1e-4)
    np.testing.assert_allclose(places[1].reshape(2, 4), [(10, 20, 60, 70), (0, 0, 120, 80)], atol=1e-4)
    box = kit.torch.tensor([[[10 / WIDTH, 20 / HEIGHT, 60 / WIDTH, 70 / HEIGHT]]]) * kit.SIDE - 0.5
    with kit.torch.inference_mode():  # as transformers makes one
        own = model.network(image_embeddings=embedding.maps, input_boxes=box, multimask_output=False)
    np.testing.assert_allclose(together[1][0].logits, own.pred_masks[0, 0, 0], atol=1e-4)
    assert [len(each) for each in together] == [3, 1, 3, 1]
    assert (together[0][0].score, together[0][0].logits.std()) == pytest.approx((0.5484, 0.1547), rel=0.01)
    monkeypatch.setattr(kit.sam, "MOST_TOGETHER", 1)
    for candidates, (alone,) in zip(together, (toy.segment(embedding, [each]) for each in PROMPTS), strict=True):
        assert [each.score for each in candidates] == sorted((each.score for each in candidates), reverse=True)
        for one, other in zip(candidates, alone, strict=True):
            assert one.score == pytest.approx(other.score, abs=1e-5)
            np.testing.assert_allclose(one.logits, other.logits, atol=1e-5)
    assert len(encoded) == 1
    assert np.abs(together[0][0].logits - together[2][0].logits).max() > 0.1, "another point, another mask"
    ((other, *_),) = toy.segment(toy.embed(picture(1)), PROMPTS[:1])
    assert np.abs(together[0][0].logits - other.logits).max() > 0.1, "another image, another mask"


# --- detector ---


def crafted(kit: ModuleType, networks: Any, queries: list[tuple[list[float], list[float]]]) -> Any:
    """A detector whose network finds, for each query, a box (middle, size) and chances of the text's tokens."""
    chances = kit.torch.zeros(len(queries), 8)
    for row, (_, values) in zip(chances, queries, strict=True):
        row[1 : 1 + len(values)] = kit.torch.tensor(values)  # after the first token, which begins the text
    output = SimpleNamespace(
        logits=kit.torch.logit(chances, eps=1e-6)[None], pred_boxes=kit.torch.tensor([box for box, _ in queries])[None]
    )

    def network(**_: Any) -> Any:
        return output

    loaded, tokenizer = networks
    model = loaded["grounding-dino-tiny"]
    network.config = model.network.config
    return kit.dino.DinoDetector(kit.LoadedModel(model.manifest, Path(), network, model.device, "crafted"), tokenizer)


def test_boxes_come_back_in_pixels_with_the_phrase_that_fits_best(kit: ModuleType, networks: Any) -> None:
    detector = crafted(kit, networks, [
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


def test_many_phrases_are_sought_in_groups_that_fit_the_models_text(kit: ModuleType, networks: Any) -> None:
    loaded, tokenizer = networks
    toy = kit.dino.DinoDetector(loaded["grounding-dino-tiny"], tokenizer)
    heard = listen(loaded["grounding-dino-tiny"].network)
    phrases = ["blue mug", "a ball", "table", "red table", ".", "table"]
    found = toy.detect(picture(), phrases)
    text = tokenizer(["blue mug. a ball.", "table. red table."])["input_ids"]
    assert [call["input_ids"][0].tolist() for call in heard] == text
    assert heard[0]["pixel_values"].shape == (1, 3, 64, 96)
    one_by_one = [each for group in (phrases[:2], phrases[2:]) for each in toy.detect(picture(), group)]
    assert found, "random weights find something, too"
    assert sorted(found, key=repr) == sorted(one_by_one, key=repr)
    assert all(0 <= each.bbox[0] < each.bbox[2] <= WIDTH and each.bbox[3] <= HEIGHT for each in found)


# --- depth ---


def test_depth_anything_keeps_the_shape_of_the_image(
    kit: ModuleType, networks: Any, home: Path, tmp_path: Path
) -> None:
    model = networks[0]["depth-anything-indoor"]
    heard = listen(model.network)
    reading = kit.depth.DepthAnythingEstimator(model).estimate(picture(), 100.0)
    assert heard[0]["args"][0].shape == (1, 3, 56, 84)
    assert (reading.depth.shape, reading.scale, reading.focal) == ((56, 84), 1.0, None)
    assert (reading.depth.min(), reading.depth.mean()) == pytest.approx((7.72, 9.887), rel=0.01)
    folder = own(home, "depth-anything-indoor", tmp_path)
    config = json.loads((folder / "config.json").read_text()) | {"depth_estimation_type": "relative"}
    (folder / "config.json").write_text(json.dumps(config))
    with refused("perception-unavailable"):
        load_own(kit, "depth-anything-indoor", folder)


def test_moge_reads_an_image_of_any_shape(toys: Toys) -> None:
    wide, tall = (toys["moge-2-small"].estimate(each, None) for each in (picture(), picture().swapaxes(0, 1)))
    assert (wide.depth.shape, tall.depth.shape) == ((24, 36), (36, 24))
    assert (wide.depth.min(), wide.depth.mean()) == pytest.approx((1.313, 1.712), rel=0.01)


@pytest.mark.parametrize(
    ("width", "height", "focal", "is_told"),
    [(120, 80, 150.0, False), (600, 900, 500.0, True), (400, 100, 900.0, False)],
)
def test_moge_recovers_focal_length_and_metres(
    width: int, height: int, focal: float, is_told: bool, kit: ModuleType, networks: Any
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
            return [kit.torch.tensor(each) for each in (points, sure, 2.5)]

    toy = networks[0]["moge-2-small"]
    model = kit.LoadedModel(toy.manifest, Path(), Crafted(), toy.device, "crafted")
    black = np.zeros((height, width, 3), np.uint8)
    reading = kit.depth.MogeEstimator(model).estimate(black, focal if is_told else None)
    assert reading.focal == pytest.approx(focal, rel=0.01)
    assert (np.isnan(reading.depth) == (sure < 0.5)).all()
    assert np.nanmax(np.abs(reading.depth / z - 1)) < 0.02
