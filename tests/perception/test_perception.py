"""What the service makes of what models see: outlines, names and depth, by stand-ins that know the truth of scenes."""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import mllm_server as say
import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import run_of

sys.path.insert(0, str(ROOT / "benchmarks"))

from stand_ins import TrueModels, TrueScene, read_truth

from cow_service.errors import CannotGround, PerceptionUnavailable
from cow_service.media.images import decode_own, encode_png
from cow_service.perception.base import Embedded, Perception, Prompt, Segment
from cow_service.perception.outlines import outlines_at, outlines_in
from cow_service.readers.mllm.reader import create
from cow_service.records import Answer
from cow_service.requests import AnswerRequest, LookRequest, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError
from cow_service.stages.grounding import ground
from cow_service.vision.masks import bbox_of, mask_iou
from cow_service.vision.types import Mask

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
    return {"image": f"data:image/jpeg;base64,{image}", "question": question, "video": False, **more}


def simulate(service: Service, folder: Path, **more: Any) -> Any:
    return service.simulate(SimulateRequest.model_validate(body_of(folder, **more)))


def mask_of(service: Service, artifact: Any) -> Mask:
    return decode_own(service.artifacts.read(artifact.sha256))[..., 0] > 0


# --- outlines


@dataclass
class Drawn:
    """Sees what is drawn: for a point each shape there, for a box the shape whose box it is most."""

    shapes: Sequence[tuple[Mask, float]]
    scrap: bool = False  # points give a scrap of what lies there
    embedded: int = 0
    asked: list[int] = field(default_factory=list)

    fingerprint = "drawn"

    def embed(self, image: Any) -> None:
        self.embedded += 1

    def segment(self, embedding: None, prompts: Sequence[Prompt]) -> tuple[tuple[Segment, ...], ...]:
        self.asked.append(len(prompts))
        return tuple(self._at(prompt) for prompt in prompts)

    def _at(self, prompt: Prompt) -> tuple[Segment, ...]:
        found = [
            (mask, score) for mask, score in self.shapes if prompt.point is None or self._holds(mask, prompt.point)
        ]
        if prompt.bbox is not None:
            box = np.zeros_like(self.shapes[0][0])
            x0, y0, x1, y1 = (round(value) for value in prompt.bbox)
            box[y0:y1, x0:x1] = True
            found = [max(found, key=lambda each: mask_iou(each[0], box))]
        if prompt.point is not None and self.scrap:
            x, y = (int(value) for value in prompt.point)
            part = np.zeros_like(self.shapes[0][0])
            part[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2] = True
            found = [(mask & part, score) for mask, score in found]
        return tuple(Segment(np.where(mask, 8, -8).astype(np.float32), score) for mask, score in found)

    @staticmethod
    def _holds(mask: Mask, point: tuple[float, float]) -> bool:
        return bool(mask[int(point[1]), int(point[0])])


def rectangle(x0: int, y0: int, x1: int, y1: int) -> Mask:
    mask = np.zeros((60, 80), bool)
    mask[y0:y1, x0:x1] = True
    return mask


def seen(*shapes: tuple[Mask, float], scrap: bool = False) -> Embedded:
    return Embedded(Drawn(shapes, scrap), None, (80, 60), None)


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
    assert (at_point.mask == mask).all()
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


def test_edges_of_a_small_mask_are_smooth_at_the_size_of_the_image() -> None:
    y, x = np.mgrid[:64, :64]
    logits = (20 - np.hypot(x - 31.5, y - 31.5)).astype(np.float32)
    mask = Segment(logits, 0.9).enlarged(256, 256).full()
    yy, xx = np.mgrid[:256, :256]
    truth = np.hypot(xx - 127.5, yy - 127.5) < 80
    assert mask_iou(mask, truth) > 0.99


# --- stage 1


@pytest.mark.parametrize("folder", sorted(TRUTH.glob("collision/*")), ids=lambda folder: folder.name)
def test_a_picture_and_a_question_are_enough(service: Service, folder: Path) -> None:
    truth = read_truth(folder)
    service.perception = TrueModels(truth, depth_level=0.0)
    answer = service.answer(AnswerRequest.model_validate(body_of(folder)))
    meta = json.loads((folder / "meta.json").read_text())
    assert answer.answer == meta["answer"]
    assert answer.simulation is not None
    grounding = answer.simulation.grounding
    assert mask_iou(mask_of(service, grounding.mask), truth.thing(meta["object"]).mask) > 0.98
    located = {each.object: each for each in grounding.others}
    for name in located.keys() & {each.name for each in truth.things}:
        assert mask_iou(mask_of(service, located[name].mask), truth.thing(name).mask) > 0.98
    camera = answer.simulation.trajectory.camera
    assert camera is not None
    assert camera.pitch == pytest.approx(truth.camera.pitch, abs=0.3)


def test_a_point_gives_the_whole_thing_or_asks_for_a_box(service: Service) -> None:
    truth = read_truth(CANDLE)
    service.perception = TrueModels(truth)
    mask = truth.thing("blue candle").mask
    rows, columns = np.nonzero(mask)
    for place in range(0, len(rows), len(rows) // 8):
        point = float(columns[place]), float(rows[place])
        found = simulate(service, CANDLE, grounding={"object": "blue candle", "point": point}).grounding
        assert mask_iou(mask_of(service, found.mask), mask) > 0.98
    with pytest.raises(CannotGround, match=r"two attempts to outline it disagree.*`grounding.bbox`") as refused:
        simulate(service, CANDLE, grounding={"point": (4.0, truth.image.shape[0] - 4.0)})
    assert refused.value.errors[0].pointer == "/grounding/point"


@dataclass(frozen=True)
class Doubting:
    """As another segmenter, but that looks at one thing do not agree: around its middle they differ."""

    inner: Any
    bbox: tuple[float, float, float, float]
    fingerprint = "doubting"

    def embed(self, image: Any) -> Any:
        return self.inner.embed(image)

    def segment(self, embedding: Any, prompts: Sequence[Prompt]) -> tuple[tuple[Segment, ...], ...]:
        x0, y0, x1, y1 = self.bbox
        found = self.inner.segment(embedding, prompts)
        spoiled = []
        for prompt, candidates in zip(prompts, found, strict=True):
            inside = prompt.point is not None and x0 <= prompt.point[0] <= x1 and y0 <= prompt.point[1] <= y1
            spoiled.append(candidates[1:] if inside else candidates)
        return tuple(spoiled)


class DoubtingModels(TrueModels):
    def __init__(self, truth: TrueScene, name: str) -> None:
        super().__init__(truth)
        self._name = name

    def load(self, kind: Any) -> Any:
        found = super().load(kind)
        return Doubting(found, bbox_of(self._scene.thing(self._name).mask)) if kind == "segmenter" else found


def test_a_mover_on_whose_outline_no_two_looks_agree_is_not_moved(service: Service) -> None:
    truth = read_truth(CANDLE)
    service.perception = DoubtingModels(truth, "blue candle")
    with pytest.raises(CannotGround, match=r"'blue candle'.*two attempts") as refused:
        simulate(service, CANDLE)
    assert "grounding.bbox" in (refused.value.remedy or "")
    given = {"object": "blue candle", "bbox": bbox_of(truth.thing("blue candle").mask)}
    cone = {"object": "cyan cone", "bbox": bbox_of(truth.thing("cyan cone").mask)}
    result = simulate(service, CANDLE, grounding=given, objects=[cone])
    assert result.grounding.is_doubtful
    assert "identity" in result.trajectory.outcome.depends_on
    assert not result.trajectory.outcome.sure


def test_nothing_is_sure_of_another_thing_on_whose_outline_no_two_looks_agree(service: Service) -> None:
    service.perception = DoubtingModels(read_truth(CANDLE), "cyan cone")
    answer: Answer = service.answer(AnswerRequest.model_validate(body_of(CANDLE)))
    assert answer.not_sure
    assert any("outline 'cyan cone' disagree" in warning for warning in answer.warnings)


def test_nouns_that_rules_do_not_know_are_known_by_the_detector(service: Service) -> None:
    truth = read_truth(CANDLE)
    renamed = [each if each.name != "cyan cone" else type(each)("gnome", each.bbox, each.mask) for each in truth.things]
    asked = {"question": "If the blue candle moves to the left, will it hit the gnome?"}
    assert [each.is_doubtful for each in simulate(service, CANDLE, **asked).grounding.others] == [True]
    service.perception = TrueModels(type(truth)(truth.name, truth.image, tuple(renamed), truth.depth, truth.camera))
    (gnome,) = simulate(service, CANDLE, **asked).grounding.others
    assert (gnome.object, gnome.is_doubtful) == ("gnome", False)
    assert gnome.bbox == bbox_of(truth.thing("cyan cone").mask)


def test_boxes_of_a_multimodal_llm_are_outlined(service: Service) -> None:
    """They lie some pixels off, and the outline is that of the thing."""
    truth = read_truth(CANDLE)
    candle, cone = (bbox_of(truth.thing(name).mask) for name in ("blue candle", "cyan cone"))
    height, width = truth.image.shape[:2]

    def place(name: str, box: tuple[float, float, float, float]) -> dict[str, Any]:
        loose = [box[0] - 3, box[1] - 4, box[2] + 3, box[3] + 2]
        scale = (1000 / width, 1000 / height) * 2
        return {"label": name, "bbox_2d": [round(value * each) for value, each in zip(loose, scale, strict=True)]}

    what = {"object": "blue candle", "others": ["cyan cone"], "kind": "linear", "sentence": "The candle slides."}
    where = place("blue candle", candle) | {"others": [place("cyan cone", cone)]}
    where |= {"cue": "text", "direction": [200, 500, 700, 500]}
    with say.mllm_server() as mllm:
        mllm.say(json.dumps(what), json.dumps(where))
        reader = create(Settings(data_dir=service.settings.data_dir, mllm="qwen3-vl-8b", mllm_base_url=mllm.address))
        run = run_of(truth.image, reader=lambda: reader, question="If the candle slides right, will it hit the cone?")
        run.backends = replace(run.backends, perception=TrueModels(truth))
        found = ground(run).value
        reader.close()
    assert found.bbox == candle
    (other,) = found.others
    assert (other.object, other.bbox, other.is_doubtful) == ("cyan cone", cone, False)
    assert other.mask is not None


def test_a_picture_of_nothing_gives_no_answer(service: Service) -> None:
    truth = read_truth(CANDLE)
    _, png = cv2.imencode(".png", np.full((*truth.image.shape[:2], 3), 128, np.uint8))
    empty = type(truth)("nothing", truth.image, (), truth.depth, truth.camera)
    service.perception = TrueModels(empty, false=1.0)
    body = body_of(CANDLE, image=f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode()}")
    answer = service.answer(AnswerRequest.model_validate(body))
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
        (np.full((40, 60), np.nan), 1.0),  # nothing is seen
        (np.full((40, 60), np.nan), None),
        (np.linspace(1e-6, 1, 2400).reshape(40, 60), None),  # with an offset
        (np.full((40, 60), 2.0), 1e12),  # no picture is of such a size
    ],
)
def test_depth_that_cannot_be_used_is_not(service: Service, depth: Any, scale: float | None) -> None:
    class Blind(TrueModels):
        def estimate(self, image: Any, focal: Any) -> Any:
            return type(super().estimate(image, focal))(depth, scale, None, 0.1)

    service.perception = Blind(read_truth(CANDLE), depth_level=0.0)
    found = simulate(service, CANDLE)
    assert found.trajectory.depth is None
    assert any("depth model saw no usable distances" in warning for warning in found.warnings)


# --- the server's choice


def test_a_mover_by_its_mask_and_again_by_its_box_is_one_thing(service: Service) -> None:
    truth = read_truth(CANDLE)
    candle = truth.thing("blue candle")
    mask = f"data:image/png;base64,{base64.b64encode(encode_png(candle.mask)).decode()}"
    service.perception = TrueModels(truth)
    given = {
        "grounding": {"object": "candle", "mask": mask},
        "objects": [{"object": "it", "bbox": bbox_of(candle.mask)}],
    }
    found = simulate(service, CANDLE, **given)
    assert found.grounding.others == ()
    assert any("lies where the moving object is" in warning for warning in found.warnings)


def test_looks_of_several_threads_at_one_image_are_one(service: Service) -> None:
    drawn = Drawn([(rectangle(10, 10, 40, 40), 0.9)])

    class Models(TrueModels):
        def load(self, kind: Any) -> Any:
            return drawn

    models = Models(read_truth(CANDLE))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: models.embed((None, "x"), lambda: np.zeros((60, 80, 3), np.uint8)), range(8)))
    assert drawn.embedded == 1
    assert all(each is found[0] for each in found)


def test_one_look_at_an_image_serves_every_click(service: Service) -> None:
    drawn = Drawn([(rectangle(10, 10, 40, 40), 0.9)])

    class Models(TrueModels):
        def load(self, kind: Any) -> Any:
            return drawn

    service.perception = Models(read_truth(CANDLE))
    _, png = cv2.imencode(".png", np.full((60, 80, 3), 90, np.uint8))
    image = f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode()}"
    first = service.look(LookRequest(image=image, point=(20, 20)))
    for point in ((30, 30), (12, 38)):
        again = service.look(LookRequest.model_validate({"image": {"artifact": first.image}, "point": point}))
        assert again.things == first.things
    assert drawn.embedded == 1
    assert first.things[0].bbox == (10, 10, 40, 40)


def test_models_are_chosen_by_name_one_of_each_kind() -> None:
    assert Perception(Settings()).names == {}
    chosen = Perception(Settings(perception="sam2-tiny, moge-2-small")).names
    assert chosen == {"segmenter": "sam2-tiny", "depth": "moge-2-small"}
    assert "inpainter" in Perception(Settings(perception="cpu,lama")).names
    for wrong in ("sam2-tiny,sam2-large", "cpu,sam2-large", "sam3", ""):
        with pytest.raises((SettingsError, ValueError), match=r"COW_PERCEPTION|perception"):
            Perception(Settings(perception=wrong))


def test_a_chosen_model_that_is_not_here_is_an_error_and_not_passed_over(tmp_path: Path) -> None:
    with Service(Settings(data_dir=tmp_path, perception="sam2-tiny")) as made:
        with pytest.raises(PerceptionUnavailable, match="cow models pull sam2-tiny"):
            simulate(made, CANDLE)
        with pytest.raises(PerceptionUnavailable):
            made.check()
        described = {each.name: each for each in made.models().perception}
        assert (described["sam2-tiny"].default, described["sam2-tiny"].kind) == (True, "segmenter")
        assert described["sam2-tiny"].pull == "cow models pull sam2-tiny"
