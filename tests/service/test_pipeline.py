"""From image and question to frames, on rendered scenes with known truth and on drawn ones."""

from __future__ import annotations

import io
import json
from typing import Any

import av
import cv2
import numpy as np
import pytest
from conftest import Example, all_scenes, example
from drawn import DrawnArrow, angle_between, ball, block, floor, png_bytes
from PIL import Image
from servers import BODY

from cow_service.errors import ArtifactNotFound, ImageUrlNotAllowed, InvalidRequest
from cow_service.media.images import decode_data_url
from cow_service.media.share import Told
from cow_service.pipeline import simulate
from cow_service.records import Simulation
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.service import Service
from cow_service.vision.masks import iou
from cow_service.vision.regions import MAX_REGIONS
from cow_service.vision.scene import Scene

RED, BLUE = (210, 20, 20), (50, 80, 200)
DRAWN = png_bytes(block(ball(floor(), (150, 200), 40, RED), (430, 160, 510, 250), BLUE))
QUESTION = "If the red ball moves to the right, will it hit the blue cube?"


def run(service: Service, image: bytes = DRAWN, question: str = QUESTION, progress=None, **body) -> Simulation:
    artifact = service.keep_image(image)
    request = SimulateRequest.model_validate({"image": {"artifact": artifact.sha256}, "question": question, **body})
    return service.simulate(request, progress) if progress else service.simulate(request)


def picture(service: Service, sha256: str) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(service.artifacts.read(sha256))))


@pytest.mark.scaled
@pytest.mark.parametrize("folder", all_scenes(), ids=lambda path: path.name)
def test_scenes_with_known_truth(service: Service, folder) -> None:
    scene = Example(folder)
    meta = scene.meta
    simulation = run(service, scene.image, meta["question"], video=False)
    assert simulation.grounding.object == meta["object"]
    assert iou(simulation.grounding.bbox, tuple(meta["bbox"])) >= 0.5
    assert simulation.motion.kind == meta["motion"]
    if simulation.motion.direction is not None:
        assert angle_between(simulation.motion.direction, meta["direction"]) <= 8
    assert meta["target"] in [other.object for other in simulation.grounding.others]


@pytest.mark.scaled
def test_encounters_give_the_true_answer(service: Service) -> None:
    right = []
    for folder in all_scenes():
        scene = Example(folder)
        meta = scene.meta
        if meta["task"] not in ("collision", "occlusion"):
            continue
        given = {} if meta["arrow"] else {"motion": {"direction": meta["direction"]}}
        simulation = run(service, scene.image, meta["question"], video=False, **given)
        kinds = {e.kind for e in simulation.trajectory.encounters if e.object == meta["target"]}
        yes = bool(kinds & {"touches", "occludes"}) if "occluded" in meta["question"] else "touches" in kinds
        right.append(yes == (meta["answer"] == "A"))
    assert len(right) >= 3
    assert np.mean(right) >= 0.8


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
    assert simulation.motion.sentence.startswith("The red ball sets off")
    assert "to the right" in simulation.motion.sentence
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


def test_the_video_plays(service: Service) -> None:
    simulation = run(service, num_frames=24, fps=12)
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


def test_the_overlay_shows_box_path_and_encounter(service: Service) -> None:
    simulation = run(service, video=False)
    overlay = picture(service, simulation.overlay.sha256).astype(int)
    plain = cv2.imdecode(np.frombuffer(DRAWN, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    changed = np.abs(overlay - plain).max(axis=2) > 30
    x0, y0, x1, _ = (int(v) for v in simulation.grounding.bbox)
    assert changed[y0 - 3 : y0 + 4, (x0 + x1) // 2].any()
    assert changed[200, 300:420].mean() > 0.8
    assert not changed[350:].any()


def test_overrides_skip_their_readers(service: Service) -> None:
    point = {"grounding": {"point": [150, 200], "object": "thing"}}
    simulation = run(service, question="?", **point, motion={"direction": [1, 0]}, video=False)
    assert simulation.reader.stages == ()
    assert simulation.grounding.source == simulation.motion.source == "request"
    assert simulation.motion.cue == "request"
    simulation = run(service, **point, video=False)
    assert simulation.reader.stages == ("motion",)
    simulation = run(service, motion={"kind": "fall"}, video=False)
    assert simulation.reader.stages == ("grounding",)
    path = {"points": [[150, 200], [150, 100]], "fps": 1}
    simulation = run(service, question="?", trajectory=path, video=False)
    assert simulation.reader.stages == ()
    assert iou(simulation.grounding.bbox, (110, 160, 190, 240)) > 0.8
    assert simulation.trajectory.path.points[16] == pytest.approx((150, 100))


def test_doubts_are_told(service: Service) -> None:
    motion, path = {"direction": [1, 0]}, {"points": [[300, 300], [310, 300]]}
    place = {"grounding": {"point": [150, 200]}}

    def told(**body) -> str:
        return " ".join(run(service, video=False, num_frames=5, **body).warnings)

    assert "Both `motion` and `trajectory`" in told(motion=motion, trajectory=path)
    assert "from the object's centre" in told(trajectory=path, **place)
    assert "speed" in told(motion={"kind": "projectile", **motion})
    assert "'green vase' was not found" in told(question="If the red ball moves left, will it hit the green vase?")
    arrow = DrawnArrow((300, 330), 0.0, 120, 6, (30, 160, 30), "filled").on(block(floor(), (80, 100, 200, 220), RED))
    assert "an arrow at (" in told(image=png_bytes(arrow), question="?", motion=motion, grounding={"point": [140, 160]})
    assert told() == ""


def test_many_objects_stay_affordable(service: Service) -> None:
    image = floor(1600, 1200)
    for y in range(60, 1200, 120):
        for x in range(60, 1600, 120):
            cv2.circle(image, (x, y), 30, BLUE, -1)
    place = {"grounding": {"bbox": [30, 30, 90, 90]}, "motion": {"direction": [1, 0]}}
    simulation = run(service, png_bytes(image), "?", **place, video=False)
    assert len(Scene(image).regions) == MAX_REGIONS
    assert len(simulation.frames) == 4


def test_the_same_request_gives_the_same_bytes(service: Service) -> None:
    first, second = (run(service, num_frames=9) for _ in range(2))
    assert [f.sha256 for f in first.frames] == [f.sha256 for f in second.frames]
    assert first.overlay == second.overlay
    assert first.video is not None
    assert second.video is not None
    assert first.video.sha256 == second.video.sha256
    assert first.id != second.id


def test_a_cluttered_image_says_that_it_knows_no_surroundings(service: Service) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    image = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_NEAREST)
    place = {"grounding": {"bbox": [100, 80, 160, 140]}, "motion": {"direction": [1, 0]}}
    simulation = run(service, png_bytes(image), "?", **place, video=False)
    assert simulation.trajectory.encounters == ()
    assert "encounters were not computed" in simulation.warnings[0]


@pytest.mark.parametrize("size", [(8, 8), (9, 31), (40, 500), (500, 40), (8, 4000), (4000, 8)])
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
        ({"generator": "nobody"}, "/generator"),
        ({"generator_options": {"clean_cue": True}}, "/generator_options/clean_cue"),
        ({"frames": {"indices": [3, 81]}}, "/frames/indices/1"),
        ({"generator_options": {"a/b": 1}}, "/generator_options/a~1b"),
        ({"generator_options": {"clean_cues": "perhaps"}}, "/generator_options/clean_cues"),
    ],
)
def test_unknown_names_and_options_are_told(service: Service, body, pointer) -> None:
    with pytest.raises(InvalidRequest) as caught:
        run(service, **body)
    assert caught.value.errors[0].pointer == pointer


def test_images_come_as_data_urls_or_artifacts_only(service: Service) -> None:
    def ask(image):
        return service.simulate(SimulateRequest.model_validate({"image": image, "question": QUESTION, "video": False}))

    with pytest.raises(ImageUrlNotAllowed):
        ask({"url": "https://example.org/a.png"})
    with pytest.raises(ArtifactNotFound):
        ask({"artifact": "f" * 64})
    with pytest.raises(ImageUrlNotAllowed):
        ask("https://example.org/a.png")
    with pytest.raises(ImageUrlNotAllowed):
        ask("ftp://x")
    for bad in ("x", "data:image/png,abc", "data:image/png;base64,***", "data:"):
        with pytest.raises(InvalidRequest) as caught:
            ask(bad)
        assert caught.value.errors[0].pointer == "/image"
    assert decode_data_url("data:image/png;charset=x;base64,aGk=") == b"hi"


def test_a_phone_picture_is_read_upright(service: Service) -> None:
    turned = Image.open(io.BytesIO(DRAWN)).transpose(Image.Transpose.ROTATE_90)
    exif = Image.Exif()
    exif[0x0112] = 6
    buffer = io.BytesIO()
    turned.save(buffer, "JPEG", exif=exif, quality=92)
    simulation = run(service, buffer.getvalue(), video=False)
    assert (simulation.image.width, simulation.image.height) == (640, 400)
    assert simulation.grounding.point == pytest.approx((150, 200), abs=4)


def test_records_are_frozen_and_round_trip(service: Service) -> None:
    simulation = run(service, video=False)
    with pytest.raises(ValueError, match="frozen"):
        simulation.id = "other"  # type: ignore[misc]
    assert json.loads(simulation.model_dump_json())["trajectory"]["units"]["position"] == "m"


def test_what_is_found_again_is_not_looked_for_in_the_image(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    stored: dict[str, Any] = {}

    def step(stage: Any, key: Any, compute: Any) -> tuple[Any, bool]:
        found = key.digest in stored
        if not found:
            stored[key.digest] = compute()
        return stored[key.digest], found

    def unexpected(*_: Any) -> Any:
        raise AssertionError("nothing is computed that needs it")

    fields = {"grounding": {"point": [60, 80]}, "motion": {"direction": [1, 0]}, "num_frames": 3, "video": False}
    request = SimulateRequest.model_validate({"image": BODY["image"], "question": "?", **fields})
    first = simulate(service.prepare(request, step=step))
    monkeypatch.setattr(Scene, "with_mover", unexpected)
    again = simulate(service.prepare(request, step=step))
    assert again.reused == ("grounding", "motion", "trajectory", "generation")
    assert again.frames == first.frames


def test_under_another_answer_a_film_shows_what_the_simulation_says(service: Service) -> None:
    request = AnswerRequest.model_validate(
        {"image": {"artifact": service.keep_image(DRAWN).sha256}, "question": QUESTION}
    )
    answer = service.answer(request)
    simulation = answer.simulation
    assert simulation is not None
    assert Told.of(answer, simulation, "").agreeing == simulation.narration.agreement != ""
    other = answer.model_copy(update={"answer": "No", "reasoning": "It looks far away."})
    assert Told.of(other, simulation, "").agreeing == simulation.narration.summary


def test_the_world_is_the_same_whatever_a_question_names(service: Service) -> None:
    """Its mugs are seen to be round, also where no word says so."""
    image, worlds = example("ball-and-mug").image, []
    for asked in ("will it hit the blue mug", "will it hit the white mug", "what happens"):
        question = f"If the yellow ball moves opposite to the direction of the arrow, {asked}?"
        bodies = run(service, image, question, video=False).trajectory.bodies
        worlds.append(sorted((each.bbox, each.shape, tuple(round(side, 9) for side in each.size)) for each in bodies))
    assert [shape for _, shape, _ in worlds[0]] == ["sphere", "cylinder", "cylinder"]
    assert worlds[0] == worlds[1] == worlds[2]
