"""From image and question to frames, on rendered scenes with known truth and on drawn ones."""

from __future__ import annotations

import io
from itertools import product
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from conftest import EXAMPLES, Example, example
from drawn import DrawnArrow, angle_between, ball, block, clutter, floor, png_bytes
from PIL import Image
from refusals import refused
from rendered_scenes import scene_rows

from cow_service.media.masks import iou
from cow_service.media.share import Told
from cow_service.perception.classical.regions import REGION
from cow_service.perception.observation import look
from cow_service.records import Outcome, Simulation
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

RED, BLUE = (210, 20, 20), (50, 80, 200)
DRAWN = png_bytes(block(ball(floor(), (150, 200), 40, RED), (430, 160, 510, 250), BLUE))
QUESTION = "If the red ball moves to the right, will it hit the blue cube?"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Service:
    return Service(Settings(data_dir=tmp_path_factory.mktemp("data")))


def run(service: Service, image: bytes = DRAWN, question: str = QUESTION, progress=None, **body) -> Simulation:
    artifact = service.keep_image(image)
    request = SimulateRequest.model_validate({"image": {"artifact": artifact.sha256}, "question": question, **body})
    return service.simulate(request, progress) if progress else service.simulate(request)


def picture(service: Service, sha256: str) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(service.artifacts.read(sha256))))


@pytest.mark.slow
@pytest.mark.parametrize("folder", scene_rows())
def test_scenes_with_known_truth(service: Service, folder: Path) -> None:
    meta = Example(folder).meta
    asks = meta["task"] in ("collision", "occlusion")
    given = {} if meta["arrow"] or not asks else {"motion": {"direction": meta["direction"]}}
    simulation = run(service, Example(folder).image, meta["question"], video=False, **given)
    assert simulation.grounding.object == meta["object"]
    assert iou(simulation.grounding.bbox, tuple(meta["bbox"])) >= 0.5
    assert simulation.motion.kind == meta["motion"]
    if simulation.motion.direction is not None:
        assert angle_between(simulation.motion.direction, meta["direction"]) <= 8
    assert meta["target"] in [other.object for other in simulation.grounding.others]
    if asks and folder.parent == EXAMPLES:
        kinds = {e.kind for e in simulation.trajectory.encounters if e.object == meta["target"]}
        yes = bool(kinds & {"touches", "occludes"}) if "occluded" in meta["question"] else "touches" in kinds
        assert yes == (meta["answer"] == "A")


def test_everything_that_a_simulation_promises(service: Service) -> None:
    heard: list[tuple[str, float]] = []
    simulation = run(service, progress=lambda stage, done: heard.append((stage, done)))
    assert [(e.object, e.kind) for e in simulation.trajectory.encounters] == [("blue cube", "touches")]
    shown = [frame.index for frame in simulation.frames]
    hit = simulation.trajectory.encounters[0].first_frame
    assert len(shown) == 4
    assert shown[0] < hit < shown[-1], "what led to the hit and what came of it are shown, too"
    assert simulation.frames[shown.index(hit)].time == pytest.approx(hit / 16)
    assert set(simulation.timings) == {"grounding", "motion", "trajectory", "generation"}
    assert simulation.reader.name == "embedded"
    assert simulation.reader.stages == ("grounding", "motion")
    assert simulation.generator.options == {"clean_cues": True}
    assert simulation.warnings == ()
    for frame in simulation.frames:
        assert picture(service, frame.sha256).shape == (frame.height, frame.width, 3) == (320, 512, 3)
    overlay = picture(service, simulation.overlay.sha256)
    assert overlay.shape == (400, 640, 3)
    assert simulation.grounding.mask is not None
    mask = picture(service, simulation.grounding.mask.sha256)
    assert mask.shape == (400, 640)
    assert mask[200, 150]
    assert not mask[20, 20]
    for stage in ("grounding", "motion", "trajectory", "generation"):
        steps = [done for name, done in heard if name == stage]
        assert steps[0] == 0
        assert steps[-1] == 1
        assert steps == sorted(steps)
    assert Simulation.model_validate_json(simulation.model_dump_json()) == simulation


def test_the_video_plays_and_the_same_request_gives_the_same_bytes(service: Service) -> None:
    simulation, again = (run(service, num_frames=24, fps=12) for _ in range(2))
    assert simulation.video is not None
    with av.open(io.BytesIO(service.artifacts.read(simulation.video.sha256))) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 12
    assert len(frames) == simulation.video.num_frames == 24
    assert frames[0].shape == (400, 640, 3)
    x, y = simulation.trajectory.path.points[20]
    assert frames[20][int(y), int(x), 0] > 120 > frames[20][int(y), int(x), 2]
    told = ("frames", "overlay", "video", "trajectory")
    assert simulation.model_dump(include=set(told)) == again.model_dump(include=set(told))
    assert simulation.id != again.id


@pytest.mark.parametrize(
    ("body", "stages"),
    [
        ({"question": "?", "grounding": {"point": [150, 200]}, "motion": {"direction": [1, 0]}}, ()),
        ({"grounding": {"point": [150, 200], "object": "thing"}}, ("motion",)),
        ({"motion": {"kind": "fall"}}, ("grounding",)),
        ({"question": "?", "trajectory": {"points": [[150, 200], [150, 100]], "fps": 1}}, ()),
    ],
)
def test_what_is_given_is_not_read(service: Service, body: dict[str, Any], stages: tuple[str, ...]) -> None:
    simulation = run(service, video=False, num_frames=17, **body)
    assert simulation.reader.stages == stages
    assert simulation.grounding.source == ("embedded" if "grounding" in stages else "request")
    assert iou(simulation.grounding.bbox, (110, 160, 190, 240)) > 0.8
    if "trajectory" in body:
        assert simulation.trajectory.path.points[16] == pytest.approx((150, 100))


MOTION, PLACE = {"direction": [1, 0]}, {"grounding": {"point": [150, 200]}}
ARROW = DrawnArrow((300, 330), 0.0, 120, 6, (30, 160, 30), "filled").on(block(floor(), (80, 100, 200, 220), RED))


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ({"motion": MOTION, "trajectory": {"points": [[300, 300], [310, 300]]}}, "`trajectory`"),
        ({"motion": {"kind": "projectile", **MOTION}}, "speed"),
        ({"question": "If the red ball moves left, will it hit the green vase?"}, "'green vase'"),
        ({"image": png_bytes(ARROW), "question": "?", "motion": MOTION, "grounding": {"point": [140, 160]}}, "arrow"),
        ({}, None),
    ],
)
def test_doubts_are_told(service: Service, body: dict[str, Any], named: str | None) -> None:
    warnings = run(service, video=False, num_frames=5, **body).warnings
    assert any(named in warning for warning in warnings) if named else warnings == ()


@pytest.mark.slow
def test_many_objects_stay_affordable(service: Service) -> None:
    image = floor(640, 480)
    for x, y in product(range(40, 640, 80), range(40, 480, 80)):
        cv2.circle(image, (x, y), 16, BLUE, -1)
    place = {"grounding": {"bbox": [24, 24, 56, 56]}, "motion": MOTION}
    assert len(run(service, png_bytes(image), "?", **place, video=False, num_frames=17).frames) == 4
    assert len(look(image).things) == REGION.most


def test_a_cluttered_image_says_that_it_knows_no_surroundings(service: Service) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    image = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_NEAREST)
    place = {"grounding": {"bbox": [100, 80, 160, 140]}, "motion": MOTION}
    simulation = run(service, png_bytes(image), "?", **place, video=False, num_frames=17)
    assert simulation.trajectory.encounters == ()
    assert "encounters" in simulation.warnings[0]


@pytest.mark.parametrize("size", [(9, 31), (8, 4000)])
def test_small_and_long_images(service: Service, size: tuple[int, int]) -> None:
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    place = {"grounding": {"bbox": [2, 2, 6, 6]}, "motion": {"direction": [1, 1]}}
    simulation = run(service, png_bytes(image), "?", **place, num_frames=5)
    assert simulation.image.width == size[0]
    assert len(simulation.frames) == 4
    assert max(picture(service, simulation.overlay.sha256).shape) == min(1280, max(size))


@pytest.mark.parametrize(
    ("body", "pointer"),
    [
        ({"reader": "nobody"}, "/reader"),
        ({"frames": {"indices": [3, 81]}}, "/frames/indices/1"),
        ({"generator_options": {"a/b": 1}}, "/generator_options/a~1b"),
    ],
)
def test_unknown_names_and_options_are_told(service: Service, body, pointer) -> None:
    with refused("invalid-request", pointer):
        run(service, **body)


def test_images_that_are_none(service: Service) -> None:
    images: dict[str, Any] = {
        "image-url-not-allowed": "https://example.org/a.png",
        "invalid-request": "data:image/png;base64,*",
    }
    for code, image in (images | {"artifact-not-found": {"artifact": "f" * 64}}).items():
        with refused(code):
            service.simulate(SimulateRequest.model_validate({"image": image, "question": QUESTION}))


def test_under_another_answer_a_film_shows_what_the_simulation_says(service: Service) -> None:
    asked = {"image": {"artifact": service.keep_image(DRAWN).sha256}, "question": QUESTION}
    answer = service.answer(AnswerRequest.model_validate(asked))
    simulation = answer.simulation
    assert simulation is not None
    assert Told.of(answer, simulation, "").agreeing == simulation.narration.agreement != ""
    other = answer.model_copy(update={"answer": "No", "reasoning": "It looks far away."})
    assert Told.of(other, simulation, "").agreeing == simulation.narration.summary


def test_the_world_is_the_same_whatever_a_question_names(service: Service) -> None:
    """Its mugs are seen to be round, also where no word says so."""
    image, worlds = example("ball-and-mug").image, []
    for asked in ("will it hit the white mug", "what happens"):
        question = f"If the yellow ball moves opposite to the direction of the arrow, {asked}?"
        bodies = run(service, image, question, video=False, num_frames=17).trajectory.bodies
        worlds.append(sorted((each.bbox, each.shape, tuple(round(side, 9) for side in each.size)) for each in bodies))
    assert [shape for _, shape, _ in worlds[0]] == ["sphere", "cylinder", "cylinder"]
    assert worlds[0] == worlds[1]


@pytest.mark.slow
def test_what_nothing_in_a_picture_full_of_edges_decides_is_not_sure(service: Service) -> None:
    def outcome(question: str, **boxes: tuple[int, int, int, int]) -> Outcome:
        mover, *others = ({"object": name, "bbox": box} for name, box in boxes.items())
        image = png_bytes(clutter(320, 200))
        simulation = run(service, image, question, grounding=mover, objects=others, video=False, num_frames=33)
        assert simulation.trajectory.outcome is not None
        return simulation.trajectory.outcome

    boxes = {"bin": (210, 90, 250, 125), "bike": (50, 50, 190, 180), "shelf": (150, 10, 300, 145)}
    beside = outcome("If the bin slides to the left, will it hit the bike?", **boxes)
    assert beside.probability is not None
    assert 0.2 < beside.probability < 0.8, "what stands in a shelf is not surely beside what stands before it"
    assert "place" in beside.depends_on
    question = "If the cup slides to the left, will it fall off the tray?"
    assert outcome(question, cup=(140, 60, 180, 145), tray=(90, 90, 230, 150)).probability is not None
