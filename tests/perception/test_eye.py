"""The network of the default installation: what it finds, what it says of it, and that it can be turned off."""

from __future__ import annotations

import base64
import hashlib
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import ROOT
from drawn import ball, block, floor, png_bytes
from refusals import refused
from servers import data_url

from cow_service.errors import PerceptionUnavailable
from cow_service.media.images import decode, decode_own
from cow_service.media.masks import CroppedMask, iou
from cow_service.perception import eye as eyes
from cow_service.perception.base import Perception
from cow_service.perception.classical.regions import find_regions
from cow_service.perception.eye import MATCH, Eye, Instance, Seen
from cow_service.requests import LookRequest
from cow_service.service import Service
from cow_service.settings import Settings

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="module")
def eye() -> Eye:
    return Eye()


def picture(name: str) -> np.ndarray:
    return decode((EXAMPLES / name).read_bytes(), max_megapixels=10).pixels


@pytest.mark.parametrize("name", ["ball-and-mug", "bottle-passes-cylinder", "car-forward", "thrown-ball"])
def test_it_finds_the_things_of_the_examples(eye: Eye, name: str) -> None:
    truth = json.loads((EXAMPLES / name / "meta.json").read_text())
    found = eye.find(picture(f"{name}/clean.jpg"))
    for thing, (box, *_) in truth["boxes"].items():  # at the first frame
        assert max((iou(each.bbox, tuple(box)) for each in found), default=0) > 0.5, thing
    assert all(0 < each.confidence <= 1 for each in found)
    assert len(found) <= len(truth["boxes"]) + 1


def test_it_sees_in_a_photograph_where_regions_find_nothing(eye: Eye) -> None:
    photograph = picture("photographs/coffee.jpg")
    assert find_regions(photograph) == ()
    assert len(eye.look(photograph).instances) > 0


def half_lit() -> np.ndarray:
    image = np.ascontiguousarray(floor(grey=150) * np.array([0.9, 1.0, 1.15])).astype(np.uint8)
    cv2.ellipse(image, (320, 180), (80, 70), 30, 0, 360, (235, 235, 235), -1, cv2.LINE_AA)
    return cv2.ellipse(image, (320, 180), (80, 70), 30, 0, 180, (60, 60, 60), -1, cv2.LINE_AA)


def test_two_halves_of_a_thing_are_one(eye: Eye) -> None:
    """A hard shadow lies across a ball: by colour it falls in two."""
    assert len(find_regions(half_lit())) == 2
    (found,) = eye.find(half_lit())
    assert iou(found.bbox, (243, 106, 397, 254)) > 0.9


def at(box: tuple[int, int, int, int], probability: float) -> Instance:
    mask = np.zeros((400, 640), bool)
    x0, y0, x1, y1 = box
    mask[y0:y1, x0:x1] = True
    return Instance(CroppedMask.of(mask), probability)


TWO = block(block(floor(), (100, 200, 160, 260), (200, 40, 40)), (160, 200, 220, 260), (40, 60, 200))
WHOLE, APART = (96, 196, 224, 264), (400, 200, 460, 260)


@pytest.mark.parametrize(
    ("instances", "boxes"),
    [
        ([], [(100, 200, 160, 260), (160, 200, 220, 260)]),  # regions that the network sees stand there stay
        ([at(WHOLE, 0.9)], [WHOLE]),  # two colours of one thing
        ([at(WHOLE, MATCH.sure - 0.1)], [(100, 200, 160, 260), (160, 200, 220, 260)]),
        ([at(APART, 0.9)], [(100, 200, 160, 260), (160, 200, 220, 260), APART]),
        ([at((100, 200, 160, 262), 0.9)], [(100, 200, 160, 260), (160, 200, 220, 260)]),  # a region is sharper
    ],
)
def test_regions_and_what_is_seen_go_together(
    eye: Eye, monkeypatch: pytest.MonkeyPatch, instances: list[Instance], boxes: list[tuple[int, ...]]
) -> None:
    monkeypatch.setattr(Eye, "look", lambda *_: Seen(tuple(instances), np.ones((400, 640), np.float32)))
    found = sorted(each.bbox for each in eye.find(TWO))
    assert found == [pytest.approx(box, abs=3) for box in sorted(boxes)]


def test_what_does_not_exist_hides_nothing(eye: Eye, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is hidden in part may have any outline: a bucket behind a patch of texture would pass for a ball."""
    image = block(block(floor(), (200, 150, 300, 250), (30, 160, 60)), (230, 200, 330, 300), (40, 60, 200))
    assert [each.is_hidden for each in find_regions(image) if each.colour == "green"] == [True]
    standing = np.ones((400, 640), np.float32)
    monkeypatch.setattr(Eye, "look", lambda *_: Seen((), standing))
    assert [each.is_hidden for each in eye.find(image) if each.colour == "green"] == [True]
    (blue,) = (each for each in find_regions(image) if each.colour == "blue")
    standing[blue.mask.full()] = 0.0
    assert [(each.colour, each.is_hidden) for each in eye.find(image)] == [("green", False)]


def test_what_does_not_stand_is_no_thing(eye: Eye, monkeypatch: pytest.MonkeyPatch) -> None:
    standing = np.ones((400, 640), np.float32)
    standing[:, 160:] = MATCH.seen / 2
    monkeypatch.setattr(Eye, "look", lambda *_: Seen((), standing))
    (left,) = eye.find(TWO)
    assert left.colour == "red"


OTHER = json.dumps(json.loads(eyes.CARDS.read("things")) | {"sha256": hashlib.sha256(b"").hexdigest()})


@pytest.mark.parametrize("card", [OTHER, "{", "{}"])
def test_another_network_than_the_card_tells_of_is_refused(monkeypatch: pytest.MonkeyPatch, card: str) -> None:
    monkeypatch.setattr(type(eyes.CARDS), "read", lambda *_: card)
    with pytest.raises(PerceptionUnavailable):
        Eye()


def test_a_missing_network_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(eyes, "NAME", "nothing")
    with pytest.raises(PerceptionUnavailable):
        Eye()


@pytest.mark.parametrize("size", [(8, 900), (12, 4000), (4000, 12), (9, 9)])
def test_it_sees_the_same_each_time_in_pictures_of_any_shape(size: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (*size, 3), dtype=np.uint8)
    first, second = (Eye().maps(noise) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert np.array_equal(one, other)
        assert np.abs(one).max() < 1e3


def test_it_is_the_default_and_can_be_turned_off() -> None:
    assert Perception(Settings()).names == {"finder": "eye"}
    assert Perception(Settings(perception="none")).names == {}
    assert Perception(Settings(perception="lama")).names == {"finder": "eye", "inpainter": "lama"}
    names = Perception(Settings()).identity(("finder", "depth"))
    assert names.keys() == {"finder"}
    assert names["finder"].startswith("eye ")


def test_it_needs_no_torch_and_is_loaded_when_it_first_looks() -> None:
    code = (
        "import sys; from cow_service.settings import Settings; from cow_service.perception.base import Perception;"
        "sees = Perception(Settings()); assert 'cow_service.perception.eye' not in sys.modules;"
        "sees.finder; assert 'cow_service.perception.eye' in sys.modules; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.fixture
def seeing(tmp_path: Path) -> Service:
    return Service(Settings(data_dir=tmp_path, workers=False, warmup=False))


def test_it_is_asked_what_is_at_a_place(seeing: Service) -> None:
    image = data_url(png_bytes(ball(floor(), (160, 250), 30, (200, 40, 40))))
    (thing,) = seeing.look(LookRequest.model_validate({"image": image, "point": (160, 250)})).things
    assert thing.bbox == pytest.approx((130, 220, 190, 280), abs=3)
    mask = decode_own(base64.b64decode(thing.mask.partition(",")[2]))
    assert mask[250, 160].all()
    assert not mask[250, 400].any()
    (same,) = seeing.look(LookRequest.model_validate({"image": image, "bbox": thing.bbox})).things
    assert same == thing
    assert seeing.look(LookRequest.model_validate({"image": image, "point": (500, 300)})).things == ()
    with refused("invalid-request", "/point"):
        seeing.look(LookRequest.model_validate({"image": image, "point": (5000, 300)}))
    with refused("perception-missing"):  # it does not know names
        seeing.look(LookRequest.model_validate({"image": image, "question": "Where is the ball?"}))
