"""What the service makes of what models see: outlines, names and depth, by stand-ins that know the truth of scenes."""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from runs import run_of
from servers import data_url

sys.path.insert(0, str(ROOT / "benchmarks"))
sys.path.insert(0, str(ROOT / "tests" / "stand_in_models"))

from stand_in_models import StandInSegmenter
from stand_ins import TrueModels, TrueScene, TrueSegmenter, motorcycle, read_truth

from cow_service.media.images import decode_own, encode_png
from cow_service.media.masks import bbox_of, mask_iou
from cow_service.media.types import Mask
from cow_service.perception.base import MOST_EMBEDDINGS, Embedded, Perception, Prompt, Segment
from cow_service.perception.outlines import outlines_at, outlines_in
from cow_service.readers.base import ReadResult
from cow_service.records import BBox, GroundingRequest, ObjectRequest, Reading
from cow_service.requests import AnswerRequest, LookRequest, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError
from cow_service.stages.grounding import ground

pytestmark = pytest.mark.slow

TRUTH = ROOT / "cow-scenes" / "sample" / "truth"
CANDLE = TRUTH / "collision" / "Collision_Level_1_0"


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with Service(Settings(data_dir=tmp_path)) as made:
        yield made


def body_of(folder: Path, **more: Any) -> dict[str, Any]:
    image = base64.b64encode((folder / "image.jpg").read_bytes()).decode()
    question = json.loads((folder / "meta.json").read_text())["question"]
    return {"image": f"data:image/jpeg;base64,{image}", "question": question, "video": False, "num_frames": 17, **more}


def simulate(service: Service, folder: Path, **more: Any) -> Any:
    return service.simulate(SimulateRequest.model_validate(body_of(folder, **more)))


def mask_of(service: Service, artifact: Any) -> Mask:
    return decode_own(service.artifacts.read(artifact.sha256))[..., 0] > 0


# --- outlines


def rectangle(x0: int, y0: int, x1: int, y1: int) -> Mask:
    mask = np.zeros((60, 80), bool)
    mask[y0:y1, x0:x1] = True
    return mask


class Scraps(StandInSegmenter):
    """For a point it gives a scrap of what lies there."""

    def segment(self, embedding: Any, prompts: Sequence[Prompt]) -> tuple[tuple[Segment, ...], ...]:
        (found,) = super().segment(embedding, prompts)
        if prompts[0].point is None:
            return (found,)
        x, y = (int(value) for value in prompts[0].point)
        near = rectangle(max(0, x - 1), max(0, y - 1), x + 2, y + 2)
        return (tuple(Segment(np.where(near, each.logits, np.float32(-8)), each.score) for each in found),)


def seen(*shapes: tuple[Mask, float], scrap: bool = False) -> Embedded:
    """An image in which a segmenter sees shapes, with their scores."""
    return Embedded(Scraps() if scrap else StandInSegmenter(), list(shapes), (80, 60), None)


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 40), st.integers(1, 30), st.integers(8, 35), st.integers(8, 25), st.data())
def test_what_two_prompts_agree_on_is_found_from_any_of_its_points_and_by_its_box(
    x: int, y: int, wide: int, high: int, data: st.DataObject
) -> None:
    mask = rectangle(x, y, x + wide, y + high)
    point = data.draw(st.tuples(st.integers(x, x + wide - 1), st.integers(y, y + high - 1)))
    (at_point,) = outlines_at(seen((mask, 0.9)), point)
    (in_box,) = outlines_in(seen((mask, 0.9)), [(x, y, x + wide, y + high)])
    assert in_box is not None
    assert at_point.is_sure
    assert in_box.is_sure
    assert (at_point.mask.full() == mask).all()
    assert in_box.bbox == (x, y, x + wide, y + high)


@pytest.mark.parametrize(
    ("shapes", "scrap", "count"),
    [
        ([(rectangle(10, 10, 40, 40), 0.9)], True, 0),  # each point gives another scrap
        ([(rectangle(10, 10, 40, 40), 0.3)], False, 0),  # under its score
        ([(rectangle(0, 0, 80, 60), 0.9)], False, 0),  # the image as a whole
        ([(rectangle(10, 10, 40, 40), 0.9), (rectangle(15, 15, 25, 25), 0.6)], False, 1),  # a part, clearly worse
        ([(rectangle(10, 10, 40, 40), 0.9), (rectangle(15, 15, 25, 25), 0.88)], False, 2),  # within each other
    ],
)
def test_a_point_means_no_scrap(shapes: Any, scrap: bool, count: int) -> None:
    assert len(outlines_at(seen(*shapes, scrap=scrap), (20, 20))) == count


def test_what_does_not_fill_its_box_is_not_taken_and_what_one_prompt_alone_gives_is_not_sure() -> None:
    shape = rectangle(10, 10, 20, 20), 0.9
    assert outlines_in(seen(shape), [(5, 5, 70, 50)]) == [None]
    (outline,) = outlines_in(seen(shape, scrap=True), [(10, 10, 20, 20)])
    assert outline is not None
    assert not outline.is_sure


# --- stage 1


def test_a_picture_and_a_question_are_enough(service: Service) -> None:
    """Of two candidates the right one is meant."""
    folder = TRUTH / "collision" / "Collision_Level_2_0"
    truth, meta = read_truth(folder), json.loads((folder / "meta.json").read_text())
    service.perception = TrueModels(truth, depth_level=0.0)
    answer = service.answer(AnswerRequest.model_validate(body_of(folder)))
    assert answer.answer == meta["answer"]
    assert answer.simulation is not None
    grounding = answer.simulation.grounding
    assert mask_iou(mask_of(service, grounding.mask), truth.thing(meta["object"]).mask) > 0.98
    located = {each.object: each for each in grounding.others}
    for thing in located.keys() & {each.name for each in truth.things}:
        assert mask_iou(mask_of(service, located[thing].mask), truth.thing(thing).mask) > 0.98
    camera = answer.simulation.trajectory.camera
    assert camera is not None
    assert camera.pitch == pytest.approx(truth.camera.pitch, abs=0.3)


def test_a_point_gives_the_whole_thing_or_asks_for_a_box(service: Service) -> None:
    truth = read_truth(CANDLE)
    service.perception = TrueModels(truth)
    mask = truth.thing("blue candle").mask
    rows, columns = np.nonzero(mask)
    for place in (0, len(rows) // 2):
        point = float(columns[place]), float(rows[place])
        found = simulate(service, CANDLE, grounding={"object": "blue candle", "point": point}).grounding
        assert mask_iou(mask_of(service, found.mask), mask) > 0.98
    with refused("cannot-ground", "/grounding/point"):
        simulate(service, CANDLE, grounding={"point": (4.0, truth.image.shape[0] - 4.0)})


class DoubtingModels(TrueModels):
    """As others, but looks at one thing do not agree: around its middle they differ."""

    fingerprint = "doubting"

    def __init__(self, truth: TrueScene, name: str) -> None:
        super().__init__(truth)
        self.inner, self.bbox = TrueSegmenter(truth, "inner"), bbox_of(truth.thing(name).mask)

    def load(self, kind: Any) -> Any:
        return self if kind == "segmenter" else super().load(kind)

    def embed(self, *arguments: Any) -> Any:
        return super().embed(*arguments) if len(arguments) > 1 else None

    def segment(self, embedding: Any, prompts: Sequence[Prompt]) -> tuple[tuple[Segment, ...], ...]:
        x0, y0, x1, y1 = self.bbox
        points = [prompt.point or (-1, -1) for prompt in prompts]
        found = zip(points, self.inner.segment(embedding, prompts), strict=True)
        return tuple(each[1:] if x0 <= x <= x1 and y0 <= y <= y1 else each for (x, y), each in found)


def test_of_what_no_two_looks_agree_on_nothing_is_sure(service: Service) -> None:
    truth = read_truth(CANDLE)
    service.perception = DoubtingModels(truth, "blue candle")
    with refused("cannot-ground") as caught:
        simulate(service, CANDLE)
    assert "grounding.bbox" in (caught.value.remedy or "")
    given = {"object": "blue candle", "bbox": bbox_of(truth.thing("blue candle").mask)}
    cone = {"object": "cyan cone", "bbox": bbox_of(truth.thing("cyan cone").mask)}
    result = simulate(service, CANDLE, grounding=given, objects=[cone])
    assert result.grounding.is_doubtful
    assert "identity" in result.trajectory.outcome.depends_on
    assert not result.trajectory.outcome.sure
    service.perception = DoubtingModels(truth, "cyan cone")
    assert service.answer(AnswerRequest.model_validate(body_of(CANDLE))).not_sure


def test_nouns_that_rules_do_not_know_are_known_by_the_detector(service: Service) -> None:
    truth = read_truth(CANDLE)
    renamed = [each if each.name != "cyan cone" else type(each)("gnome", each.bbox, each.mask) for each in truth.things]
    asked = {"question": "If the blue candle moves to the left, will it hit the gnome?"}
    assert simulate(service, CANDLE, **asked).grounding.others == (), "nothing is taken for what no word is known of"
    service.perception = TrueModels(type(truth)(truth.name, truth.image, tuple(renamed), truth.depth, truth.camera))
    (gnome,) = simulate(service, CANDLE, **asked).grounding.others
    assert (gnome.object, gnome.is_doubtful) == ("gnome", False)
    assert gnome.bbox == bbox_of(truth.thing("cyan cone").mask)


def test_boxes_of_a_reader_are_outlined() -> None:
    """They lie some pixels off, and the outline is that of the thing."""
    truth = read_truth(CANDLE)
    candle, cone = (bbox_of(truth.thing(name).mask) for name in ("blue candle", "cyan cone"))

    def loose(box: BBox) -> BBox:
        return box[0] - 3, box[1] - 4, box[2] + 3, box[3] + 2

    class Reader:
        source = "mllm"
        heeds_objections = False

        def read(self, given: Any) -> ReadResult:
            others = (ObjectRequest(object="cyan cone", bbox=loose(cone)),)
            return ReadResult(
                Reading(grounding=GroundingRequest(object="blue candle", bbox=loose(candle)), objects=others)
            )

    run = run_of(truth.image, reader=Reader, question="If the candle slides right, will it hit the cone?")
    run.backends = replace(run.backends, perception=TrueModels(truth))
    found = ground(run).value
    assert found.bbox == candle
    (other,) = found.others
    assert (other.object, other.bbox, other.is_doubtful) == ("cyan cone", cone, False)
    assert other.mask is not None


def test_a_picture_of_nothing_gives_no_answer(service: Service) -> None:
    truth = read_truth(CANDLE)
    grey = data_url(encode_png(np.full(truth.image.shape, 128, np.uint8)))
    empty = type(truth)("nothing", truth.image, (), truth.depth, truth.camera)
    service.perception = TrueModels(empty, false=1.0)
    answer = service.answer(AnswerRequest.model_validate(body_of(CANDLE, image=grey)))
    assert answer.not_sure
    assert answer.simulation_problem is not None
    assert answer.simulation_problem.code == "cannot-ground"


# --- depth


def test_a_depth_model_stands_in_for_the_depth_of_a_request_and_no_more(service: Service) -> None:
    truth = read_truth(CANDLE)
    service.perception = TrueModels(truth, depth_level=0.03)
    found = simulate(service, CANDLE)
    assert (found.trajectory.depth.source, found.trajectory.depth.deviation) == ("model", pytest.approx(0.03))
    assert found.trajectory.depth.focal == pytest.approx(truth.camera.focal)
    assert "depth" in found.timings
    service.perception = TrueModels(truth)
    assert simulate(service, CANDLE).trajectory.depth is None


@pytest.mark.parametrize(
    ("depth", "scale"),
    [
        (np.full((40, 60), np.nan), 1.0),
        (np.linspace(1e-6, 1, 2400).reshape(40, 60), None),
        (np.full((40, 60), 2.0), 1e12),
    ],
    ids=["nothing is seen", "with an offset", "no picture is of such a size"],
)
def test_depth_that_cannot_be_used_is_not(service: Service, depth: Any, scale: float | None) -> None:
    class Blind(TrueModels):
        def estimate(self, image: Any, focal: Any) -> Any:
            return type(super().estimate(image, focal))(depth, scale, None, 0.1)

    service.perception = Blind(read_truth(CANDLE), depth_level=0.0)
    found = simulate(service, CANDLE)
    assert found.trajectory.depth is None
    assert found.warnings


# --- the server's choice


class CountingModels(TrueModels):
    """A segmenter that sees one rectangle, and counts its looks."""

    def __init__(self) -> None:
        super().__init__(read_truth(CANDLE))
        self.looks = 0

    def load(self, kind: Any) -> Any:
        def embed(image: Any) -> list[tuple[Mask, float]]:
            self.looks += 1
            return [(rectangle(10, 10, 40, 40), 0.9)]

        return SimpleNamespace(fingerprint="counting", embed=embed, segment=StandInSegmenter().segment)


def test_looks_of_several_threads_at_one_image_are_one_and_the_latest_are_kept() -> None:
    models = CountingModels()

    def look(name: str, source: bytes | None = None) -> Embedded:
        return models.embed((None, name), lambda: np.zeros((60, 80, 3), np.uint8), source)

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(look, ["x"] * 8))
    assert models.looks == 1
    assert all(each is found[0] for each in found)
    assert (found[0].size, models.source_of((None, "x"))) == ((80, 60), None)
    look("x", b"image")
    assert (models.looks, models.source_of((None, "x"))) == (1, b"image")
    for number in range(MOST_EMBEDDINGS):
        assert models.source_of((None, "x")) == b"image"
        look(str(number))
    assert models.source_of((None, "x")) is None


def test_one_look_at_an_image_serves_every_click(service: Service) -> None:
    service.perception = models = CountingModels()
    first = service.look(LookRequest(image=data_url(encode_png(np.full((60, 80, 3), 90, np.uint8))), point=(20, 20)))
    for point in ((30, 30), (12, 38)):
        again = service.look(LookRequest.model_validate({"image": {"artifact": first.image}, "point": point}))
        assert again.things == first.things
    assert models.looks == 1
    assert first.things[0].bbox == (10, 10, 40, 40)


def test_models_are_chosen_by_name_one_of_each_kind() -> None:
    assert Perception(Settings()).names == {"finder": "eye"}
    assert Perception(Settings(perception="none")).names == {}
    chosen = Perception(Settings(perception="sam2-tiny, moge-2-small")).names
    assert chosen == {"finder": "eye", "segmenter": "sam2-tiny", "depth": "moge-2-small"}
    assert "inpainter" in Perception(Settings(perception="cpu,lama")).names
    for wrong in ("sam2-tiny,sam2-large", "cpu,sam2-large", "sam3", "", "none,lama"):
        with pytest.raises((SettingsError, ValueError), match=r"COW_PERCEPTION|perception"):  # the setting is named
            Perception(Settings(perception=wrong))


def test_a_chosen_model_that_is_not_here_is_an_error_and_not_passed_over(tmp_path: Path) -> None:
    with Service(Settings(data_dir=tmp_path, perception="sam2-tiny")) as made:
        for ask in (lambda: simulate(made, CANDLE), made.check):
            with refused("perception-unavailable") as caught:
                ask()
            assert "cow models pull sam2-tiny" in caught.value.detail
        described = {each.name: each for each in made.models().perception}
        assert (described["sam2-tiny"].default, described["sam2-tiny"].kind) == (True, "segmenter")
        assert described["sam2-tiny"].pull == "cow models pull sam2-tiny"


def test_the_motorcycle_of_scikit_image_has_its_measured_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """The package is not needed here: its function is a fake. Nothing is known where it measured nothing."""
    left, disparity = np.zeros((500, 741, 3), np.uint8), np.full((500, 741), 23.0)
    disparity[:, 300:] = 60.0
    disparity[:9] = np.inf
    data = SimpleNamespace(stereo_motorcycle=lambda: (left, left, disparity))
    monkeypatch.setitem(sys.modules, "skimage.data", data)
    scene = motorcycle()
    assert (scene.image.shape, scene.things, scene.camera.pitch) == ((500, 741, 3), (), None)
    assert np.isnan(scene.depth[:9]).all()
    assert (scene.depth[20, 0], scene.depth[20, 740]) == pytest.approx((3.55, 2.11), abs=0.01)
