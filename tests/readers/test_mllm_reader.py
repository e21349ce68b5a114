"""The reader `mllm` by itself, against a server on loopback: what it asks, what it hands on, how it fails."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import mllm_server as say
import numpy as np
import pytest
from drawn import DrawnArrow, angle_between, ball, block, floor, trail
from hypothesis import given, settings
from hypothesis import strategies as st
from mllm_server import MllmServer
from refusals import refused
from runs import run_of
from waiting import TIME_LIMIT, eventually

from cow_service.errors import Canceled, CowError
from cow_service.perception.observation import Observation, look
from cow_service.readers.base import AnswerReading, CallLog, ReaderInput, ReadResult, WordsReading
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.readers.options import read_choices
from cow_service.records import (
    Asked,
    Distance,
    GroundingRequest,
    InterventionRequest,
    MotionRequest,
    ObjectRequest,
    OtherMotionRequest,
    Reading,
    Source,
    Speed,
    Usage,
)
from cow_service.settings import Settings
from cow_service.stages.grounding import ground, look_again
from cow_service.stages.motion import settle_motion
from cow_service.stages.trajectory import compute_trajectory

if TYPE_CHECKING:
    from cow_service.readers.mllm.reader import MllmReader

QUESTION = "If the ball rolls along the arrow, what does it hit?"
OPTIONS = read_choices("", ["Yes", "No", "Not sure"])
BALL = {"object": "red ball", "others": [], "kind": "linear"}
PLACE = {"label": "red ball", "bbox_2d": [172, 390, 297, 590], "cue": "arrow", "direction": [230, 500, 600, 500]}
LINE = {"cue": "orientation", "along_arrow": None, "camera": None, "direction": [230, 500, 600, 500]}
VASE = {"label": "vase", "bbox_2d": [700, 300, 800, 600]}


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


@pytest.fixture(scope="module")
def make(mllm: MllmServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., MllmReader]]:
    """A reader that asks the server in the way of a family; one is made once."""
    from cow_service.readers.mllm.reader import create

    with ExitStack() as closing:

        @cache
        def reader(manifest: str = "qwen3-vl-8b", **settings: Any) -> MllmReader:
            data = {"data_dir": tmp_path_factory.mktemp("data")}
            told = {"mllm_timeout": TIME_LIMIT, "mllm_budget": TIME_LIMIT} | data | settings
            made = create(Settings(mllm=manifest, mllm_base_url=mllm.address, **told))
            closing.callback(made.close)
            return made

        yield reader


@pytest.fixture(scope="module")
def reader(make) -> MllmReader:
    return make()


@pytest.fixture(scope="module")
def scene() -> Observation:
    return look(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200)))


def known(source: Source = "mllm", **said: Any) -> Reading:
    """What is given where the place of the ball is known, and perhaps more."""
    place = GroundingRequest(object="red ball", bbox=(110, 156, 190, 236), source=source)
    return Reading.model_validate({"grounding": place, **said})


def motion_of(result: ReadResult) -> MotionRequest:
    assert result.reading.motion is not None
    return result.reading.motion


def names(result: ReadResult) -> list[str]:
    return [each.object for each in result.reading.objects]


def answers(reader: MllmReader, votes: int = 1, **given: Any) -> tuple[AnswerReading, ...]:
    return reader.answer(ReaderInput(floor(64, 64), "Will it?", **given), OPTIONS, None, None, votes)


# What is asked and handed on


def test_place_and_motion_are_read_at_once(mllm, reader, scene) -> None:
    mllm.say(json.dumps(BALL), json.dumps(PLACE))
    result = reader.read(ReaderInput(scene.image, QUESTION, scene))
    assert result.reading.grounding is not None
    assert result.reading.grounding.object == "red ball"
    assert len(mllm.asked) == 2
    motion = motion_of(result)
    assert (motion.kind, motion.cue) == ("linear", "arrow")
    assert motion.direction == pytest.approx((0.37 * scene.width, 0), abs=1)
    # A motion that the request gives is not asked for.
    mllm.say(json.dumps(BALL), json.dumps(PLACE))
    assert reader.read(ReaderInput(scene.image, QUESTION, scene, motion_wanted=False)).reading.motion is None
    assert list(mllm.asked[-1]["response_format"]["json_schema"]["schema"]["properties"]) == ["reasoning", "objects"]


def test_what_is_read_with_the_place_needs_no_second_call(mllm, reader, scene) -> None:
    """Also after a restart, from what was stored."""
    mllm.say(json.dumps(BALL), json.dumps(PLACE))
    run = run_of(scene.image, reader=lambda: reader, question="Rollt die Kugel?")
    found = run.stage("grounding", ground)
    asked = len(mllm.asked)
    read = run.read_motion
    assert read is not None
    motion = run.stage("motion", settle_motion, found, MotionRequest.model_validate_json(read.model_dump_json()))
    assert (len(mllm.asked), motion.kind) == (asked, "linear")


def test_what_is_taken_away_or_asked_about_is_located_and_how_far_it_goes_is_kept(mllm, reader, scene) -> None:
    asked = {"relation": "covers", "target": "coin", "negated": False, "form": "whether"}
    said = BALL | {"changes": [{"kind": "remove", "object": "blue vase"}], "asked": asked}
    ends = {"distance": "10 cm", "until": "contact", "speed": "20 pixels per second", "duration": "soon"}
    question = f"{QUESTION} It rolls 10 cm at 20 px/s."
    boxes = [("blue vase", [600, 400, 700, 600]), ("coin", [800, 400, 900, 600])]
    others = [{"label": name, "bbox_2d": box} for name, box in boxes]
    mllm.say(json.dumps(said | ends), json.dumps(PLACE | {"others": others}))
    result = reader.read(ReaderInput(scene.image, question, scene))
    assert {"> blue vase", "> coin"} <= set(mllm.text(1).splitlines())
    assert result.reading.interventions == (InterventionRequest(kind="remove", object="blue vase"),)
    assert {(each.object, each.role) for each in result.reading.objects} == {
        ("coin", "target"),
        ("blue vase", "target"),
    }
    assert result.reading.asked == Asked(relation="covers", target="coin")
    motion = motion_of(result)
    speed, distance = Speed(value=20, unit="px/s"), Distance(value=0.1, unit="m")
    assert (motion.speed, motion.distance, motion.duration) == (speed, distance, None)
    assert motion.until == "contact"
    mllm.say(json.dumps(said), json.dumps(PLACE))
    with refused("object-not-found"):
        reader.read(ReaderInput(scene.image, QUESTION, scene))


def test_further_legs_and_other_movers_are_kept(mllm, reader, scene) -> None:
    then = [{"way": "down", "distance": "30 px"}, {"way": "..."}, "right", {"direction": "away", "duration": "1 s"}]
    car, cup = {"object": "blue car", "kind": "linear", "way": "left"}, {"object": "cup", "kind": "fall"}
    boxes = [{"label": "blue car", "bbox_2d": [600, 400, 700, 600]}, {"label": "cup", "bbox_2d": [800, 100, 850, 200]}]
    named = json.dumps(BALL | {"then": then, "also_moving": [car, cup, {"object": None}]})
    mllm.say(named, json.dumps(PLACE | {"others": boxes}))
    lamp = Reading(objects=(ObjectRequest(object="tall lamp"),))
    result = reader.read(ReaderInput(scene.image, QUESTION, scene, given=lamp))
    assert {"> blue car", "> tall lamp"} <= set(mllm.text(1).splitlines()), "what the request changes is located, too"
    motion = motion_of(result)
    assert [(each.direction, each.distance, each.duration) for each in motion.steps] == [
        ((0, 1), Distance(value=30, unit="px"), None), ((1, 0), None, None), ((0, -1), None, 1.0),
    ]  # fmt: skip
    assert motion.others == (
        OtherMotionRequest(object="blue car", kind="linear", direction=(-1, 0), direction_deviation=20),
        OtherMotionRequest(object="cup", kind="fall", direction_deviation=20),
    )
    mllm.say(named, json.dumps(PLACE))
    with refused("cannot-read-direction"):
        reader.read(ReaderInput(scene.image, QUESTION, scene))


def test_a_trail_that_the_model_sees_is_one_whatever_the_language(mllm, reader) -> None:
    """Three balls that stand apart are one ball where something says so; here it is the model's cue."""
    places = [(120.0, 200.0), (215.0, 200.0), (310.0, 200.0)]
    image = block(trail(floor(), places, [24.0] * 3, (220, 120, 30), [1.0] * 3), (460, 180, 530, 250), (40, 160, 60))
    height, width = image.shape[:2]
    box = [round(1000 * each) for each in (286 / width, 176 / height, 334 / width, 224 / height)]
    line = [box[0], box[1], box[0] + 200, box[1]]
    mllm.say(
        json.dumps(BALL | {"object": "orange ball"}),
        json.dumps({"label": "orange ball", "bbox_2d": box, "cue": "trail", "direction": line}),
    )
    run = run_of(image, reader=lambda: reader, question="Trifft die Kugel den Würfel?")
    found = run.stage("grounding", ground)
    motion = run.stage("motion", settle_motion, found, run.read_motion)
    assert motion.cue == "trail"
    assert [round(x) for x, _ in motion.trail] == pytest.approx([120, 215], abs=2)
    # The earlier positions are taken out of the image.
    assert sorted(thing.colour for thing in look_again(run, found, motion.cue).things) == ["green", "orange"]


@pytest.mark.parametrize("source", ["request", "mllm"])
def test_the_motion_alone_is_asked_for_with_the_box_that_is_known(source: Source, mllm, reader, scene) -> None:
    mllm.say(json.dumps(BALL), json.dumps(PLACE))
    asked = ReaderInput(scene.image, QUESTION, scene, given=known(source))
    result = reader.read(asked)
    assert motion_of(result).direction is not None
    assert result.reading.model_copy(update={"motion": None}) == Reading(), "and nothing else is said"
    assert asked.calls.prompts.keys() == {"identify", "locate", "looking"}
    assert asked.calls.usage == Usage(calls=2, input_tokens=200, output_tokens=20)
    schema = mllm.asked[-1]["response_format"]["json_schema"]["schema"]
    assert "bbox_2d" not in schema["properties"]
    assert "`changes`" not in mllm.text(0), "the question's changes are known with the places"
    assert "in the box [" in mllm.text(-1)
    mllm.say(json.dumps(BALL | {"also_moving": [{"object": "cup", "kind": "fall"}]}), json.dumps(PLACE))
    result = reader.read(asked)
    assert motion_of(result).others == ()
    assert any("'cup'" in warning for warning in result.warnings)


def test_large_images_are_made_smaller_and_pixels_count_in_what_was_sent(mllm, make) -> None:
    place, image = GroundingRequest(object="car", bbox=(1600, 800, 2400, 1200)), floor(4000, 2000)
    asked = ReaderInput(image, "Where does the car go?", look(image), given=Reading(grounding=place))
    way = np.array([math.cos(0.3), math.sin(0.3)])

    def line(handler) -> None:
        height, width = mllm.images(-1)[0].shape[:2]
        middle = np.array([width / 2, height / 2])
        ends = np.rint([middle - 0.4 * height * way, middle + 0.4 * height * way]).ravel().tolist()
        handler.send(200, say.completion(json.dumps({"reasoning": "", "cue": "orientation", "direction": ends})))

    mllm.say(json.dumps(BALL | {"object": "the car"}), line)
    direction = motion_of(make("qwen2.5-vl-7b").read(asked)).direction
    assert direction is not None
    assert angle_between(direction, (way[0], way[1])) < 0.2
    height, width = mllm.images(-1)[0].shape[:2]
    assert (width % 28, height % 28) == (0, 0)
    assert math.hypot(*direction) == pytest.approx(0.8 * 2000, rel=0.02)  # px of the image that was given
    mllm.say('{"answer": "B"}')
    make().answer(asked, OPTIONS, None, None, 1)
    height, width = mllm.images(0)[0].shape[:2]
    assert 4_000_000 < width * height <= 4_194_304


# Places, and what else is not asked for


def placed(mllm: MllmServer, reader: MllmReader, scene: Observation, reply: dict[str, Any]) -> ReadResult:
    mllm.say(json.dumps(BALL | {"others": ["vase"]}), json.dumps(PLACE | LINE | reply))
    asked = ReaderInput(scene.image, "If the red ball rolls to the right, will it hit the vase?", scene)
    result = reader.read(asked)
    assert len(mllm.asked) == 2, "nothing was asked again"
    return result


def test_guesses_are_neither_asked_for_nor_read(mllm, reader, scene) -> None:
    guesses = {"size": 0.2, "shape": "ball", "depth_degrees": 30, "speed": "slowly", "others": [VASE]}
    result = placed(mllm, reader, scene, guesses)
    motion, mover = motion_of(result), result.reading.grounding
    assert mover is not None
    assert (mover.prior, result.reading.objects[0].prior, result.warnings) == (None, None, ())
    assert (motion.depth, motion.depth_deviation, motion.speed) == (0.0, None, None)
    assert motion.direction == pytest.approx((0.37 * 640, 0))
    assert motion.direction_deviation == 20


def test_each_object_has_one_box_and_obstacles_are_few(mllm, reader, scene) -> None:
    boxes = [{"label": f"block {n}", "bbox_2d": [60 * n, 800, 60 * n + 40, 950]} for n in range(14)]
    mover = {"label": "red ball", "bbox_2d": [175, 395, 297, 590]}
    doubles = [mover, mover | {"label": "ball again"}, {"label": "vase as well", "bbox_2d": [705, 300, 800, 600]}]
    result = placed(mllm, reader, scene, {"others": [*doubles, *boxes, VASE]})
    assert names(result)[:2] == ["vase", "block 0"]
    assert len(result.reading.objects) == 1 + 12
    for warning, name in zip(result.warnings, ("ball again", "vase as well", "block 12", "block 13"), strict=True):
        assert f"'{name}'" in warning
    assert not result.reading.objects_complete
    assert "> vase" in mllm.text(1).splitlines()


def test_a_part_that_cannot_be_used_is_asked_for_once_more_then_left_out_aloud(mllm, reader, scene) -> None:
    named = json.dumps(BALL | {"others": ["vase"]})
    unread, whole = (json.dumps(PLACE | LINE | {"others": others}) for others in (["vase"], [VASE]))
    for script, found, warned in (
        ([unread, whole], ["vase"], 0), ([unread, unread], [], 1), ([unread, "no idea"], [], 1),
    ):  # fmt: skip
        mllm.say(named, *script)
        result = reader.read(ReaderInput(scene.image, QUESTION, scene))
        assert len(mllm.asked) == 3
        assert "without a label and a box" in mllm.text(-1)
        assert names(result) == found
        assert len(result.warnings) == warned


def test_objections_to_a_reading_are_put_to_the_model(mllm, reader, scene) -> None:
    objection = "The box of 'red ball' lies\nwhere nothing stands."
    mllm.say(json.dumps(BALL), json.dumps(PLACE))
    reader.read(ReaderInput(scene.image, QUESTION, scene, objections=(objection,)))
    for call in (0, 1):
        assert "> The box of 'red ball' lies where nothing stands." in mllm.text(call).splitlines()
    against = json.dumps({"cue": "arrow", "sense": "against", "start": [230, 500], "end": [30, 500]})
    mllm.say(against)
    asked = ReaderInput(
        scene.image, QUESTION, scene, given=known(motion={"kind": "linear"}), objections=("It moves the other way.",)
    )
    motion = motion_of(reader.read(asked))
    assert "> It moves the other way." in mllm.text(0).splitlines()
    assert len(mllm.asked) == 1
    assert motion.along_arrow is False
    assert motion.direction == pytest.approx((-0.2 * scene.width, 0), abs=1)


@pytest.mark.parametrize("changes", [(InterventionRequest(kind="remove", object="red ball"),), ()], ids=["one", "none"])
def test_what_the_caller_says_is_not_asked(mllm, reader, scene, changes: tuple[InterventionRequest, ...]) -> None:
    mllm.say(json.dumps({"object": "red ball", "others": []}), json.dumps(PLACE))
    said = Reading(asked=Asked(relation="touches"), interventions=changes)
    reader.read(ReaderInput(scene.image, QUESTION, scene, given=said, motion_wanted=False))
    schema = mllm.asked[0]["response_format"]["json_schema"]["schema"]
    assert list(schema["properties"]) == ["reasoning", "object", "others", "language"]
    assert not any(f"`{field}`" in mllm.text(0) for field in ("asked", "changes", "kind", "then"))


ROLLS = "If the red ball rolls to the right, will it hit the vase?"


def words_of(question: str) -> WordsReading:
    return EmbeddedReader().read_question(question)


def test_one_call_is_enough_where_the_words_say_the_rest(mllm, reader, scene) -> None:
    mllm.say(json.dumps({"objects": [{"bbox_2d": [172, 390, 297, 590], "label": "red ball"}, VASE], **LINE}))
    result = reader.read(ReaderInput(scene.image, ROLLS, scene, words=words_of(ROLLS)))
    assert len(mllm.asked) == 1
    assert "The object that moves is this one" in mllm.text(0)
    assert {"> red ball", "> vase"} <= set(mllm.text(0).splitlines())
    reading = result.reading
    assert reading.grounding is not None
    assert (reading.grounding.object, reading.asked) == ("red ball", Asked(relation="touches", target="vase"))
    assert [(each.object, each.role) for each in reading.objects] == [("vase", "target")]
    assert motion_of(result).kind == "linear"


@pytest.mark.parametrize(
    "question",
    [
        "Trifft die Kugel die Vase?",
        "If the red ball rolls 10 cm to the right, will it hit the vase?",
        "If the red ball rolls to the right and then down, will it hit the vase?",
        "If the red ball rolls on along its trail, will it hit the vase?",
        "If the red ball rolls to the right, which mug does it hit first?",
        "If the red ball rolls to the right, will it hit both mugs?",
        "If the object in the red box moves to the right, will it hit the vase?",
        "If the book falls, will it hit the vase?",
    ],
)
def test_words_that_leave_something_open_do_not_spare_a_call(question: str, mllm, reader, scene) -> None:
    mllm.say(json.dumps(BALL), json.dumps(PLACE | {"others": [VASE]}))
    reader.read(ReaderInput(scene.image, question, scene, words=words_of(question)))
    assert "Find out which one object" in mllm.text(0)


def test_of_several_arrows_the_model_says_which_is_meant(mllm, reader, scene) -> None:
    image = scene.image.copy()
    for y in (60, 340):
        image = DrawnArrow((200, y), 0.0, 110, 5, (30, 160, 30), "filled").on(image)
    mllm.say(json.dumps(BALL | {"others": ["vase"]}), json.dumps(PLACE | {"others": [VASE]}))
    reading = reader.read(ReaderInput(image, ROLLS, look(image), words=words_of(ROLLS))).reading
    assert "`asked`" not in mllm.text(0), "the words say it"
    assert len(mllm.asked) == 2
    assert reading.asked == Asked(relation="touches", target="vase")


# Geometry checks the reader


@pytest.mark.parametrize(
    ("ends", "along", "expected", "is_doubtful"),
    [
        ([230, 500, 600, 600], True, (1, 0), False),
        ([230, 500, 330, 900], True, (1, 0), True),
        ([600, 500, 230, 500], False, (-1, 0), False),
        (None, True, (1, 0), False),
    ],
)
def test_a_drawn_arrow_is_surer_than_the_reader(
    ends: list[int] | None, along: bool, expected: Any, is_doubtful: bool, mllm, reader, scene
) -> None:
    drawn = DrawnArrow((200, 200), 0.0, 110, 5, (30, 160, 30), "filled").on(scene.image.copy())
    wanted = {"relation": "touches", "target": "blue block", "form": "whether"}
    asked = BALL | {"others": ["blue block"], "asked": wanted}
    block = {"label": "blue block", "bbox_2d": [672, 375, 812, 625]}
    mllm.say(json.dumps(asked), json.dumps(PLACE | {"along_arrow": along, "direction": ends, "others": [block]}))
    run = run_of(drawn, reader=lambda: reader, question="Rollt die Kugel gegen den Block?")
    found = run.stage("grounding", ground)
    motion = run.stage("motion", settle_motion, found, run.read_motion)
    assert motion.direction is not None
    assert angle_between(motion.direction, expected) < 2.5
    assert (motion.cue, motion.other_direction is not None) == ("arrow", is_doubtful)
    assert motion.direction_deviation < 5, "it is as exact as the arrow"
    outcome = run.stage("trajectory", compute_trajectory, found, motion).outcome
    assert outcome is not None
    assert outcome.sure is not is_doubtful
    assert (outcome.depends_on[:1] == ("reading",)) is is_doubtful


# What a network and a server do


@pytest.mark.parametrize(
    "script",
    [
        [say.status(429, retry_after="0"), say.status(429, retry_after="0")],
        [say.dropped],
        [say.raw(b"not JSON")],
        [say.shaped({"choices": []})],
        [say.shaped(None)],
        ["", "nothing of use"],
        [say.finished('{"reasoning": "it was cut sh', "length")],
    ],
    ids=lambda value: None,
)
def test_one_failure_is_got_over(script: list[Any], mllm, reader) -> None:
    mllm.say(*script, '{"answer": "B"}')
    calls = CallLog()
    assert [reading.answer for reading in answers(reader, calls=calls)] == ["B"]
    assert calls.usage.calls == len(mllm.asked) == len(script) + 1


@pytest.mark.parametrize(
    ("reply", "code"),
    [
        (say.status(429, retry_after="3600"), "mllm-unavailable"),
        (say.status(500), "mllm-unavailable"),
        (say.raw(b"not JSON"), "mllm-unavailable"),
        (say.slow(3), "mllm-unavailable"),
        (say.finished("", "content_filter"), "mllm-bad-reply"),
        ("no idea", "mllm-bad-reply"),
    ],
    ids=lambda value: None,
)
def test_failures_without_end_are_typed(reply: Any, code: str, mllm, make) -> None:
    limits = {"mllm_timeout": 1, "mllm_budget": 1.5} if code == "mllm-unavailable" else {}
    mllm.say(reply)
    with refused(code) as caught:
        answers(make(**limits))
    assert "127.0.0.1" not in caught.value.detail


def test_what_cannot_pass_is_not_repeated(mllm, reader) -> None:
    """The error tells every reason, not only the last one; calls that fail count, too."""
    mllm.say('{"reasoning": "", "answer": "A"}')
    answers(reader)  # what was taken once is not at fault later
    for status, code, named in (
        (401, "mllm-unavailable", "COW_MLLM_API_KEY"),
        (404, "mllm-unavailable", "COW_MLLM_MODEL"),
        (400, "mllm-refused", "400"),
    ):
        mllm.say(say.status(429, retry_after="0"), say.status(status))
        calls = CallLog()
        with refused(code) as caught:
            answers(reader, calls=calls)
        assert named in caught.value.detail
        assert "429" in caught.value.detail
        assert calls.usage.calls == len(mllm.asked) == 2
        assert calls.prompts.keys() == {"answer-from-image", "looking"}


def test_a_server_that_is_not_there() -> None:
    from cow_service.readers.mllm.reader import create

    settings = Settings(mllm="qwen3-vl-8b", mllm_base_url="http://127.0.0.1:9/v1", mllm_budget=1.5)
    away = create(settings)
    with refused("mllm-unavailable") as caught:
        answers(away)
    assert "COW_MLLM_BASE_URL" in caught.value.detail
    away.close()
    with refused("mllm-unavailable"):
        answers(away)


def test_the_wait_that_a_server_asks_for_is_kept(mllm, reader) -> None:
    mllm.say(say.status(429, retry_after="1"), '{"answer": "B"}')
    started = time.monotonic()
    assert answers(reader)[0].answer == "B"
    assert time.monotonic() - started >= 1


@contextmanager
def held(mllm: MllmServer) -> Iterator[None]:
    """The server replies only once the block has ended."""
    released = threading.Event()

    def reply(handler) -> None:
        released.wait(TIME_LIMIT)
        handler.close_connection = True

    mllm.say(reply)
    yield
    released.set()


def test_a_canceled_run_and_a_reader_that_closes_wait_no_longer(mllm, make, scene) -> None:
    closing = make(mllm_model="closing")

    def canceled() -> None:
        if mllm.asked:
            raise Canceled("The caller left.")

    with held(mllm), pytest.raises(Canceled):
        closing.read(ReaderInput(scene.image, QUESTION, scene, check_canceled=canceled))

    def close() -> None:
        eventually(lambda: mllm.asked)
        closing.close()

    with held(mllm):
        thread = threading.Thread(target=close)
        thread.start()
        with refused("mllm-unavailable"):
            answers(closing)
        thread.join()


# Votes and calls at the same time


def test_votes_have_seeds_of_their_own(mllm, make) -> None:
    """What a vote that fails comes to is tested with the service."""
    from cow_service.readers.mllm.client import seed_of_vote

    mllm.say('{"answer": "B"}')
    reader = make(mllm_concurrency=3)
    assert reader.places.limit.most == 3
    assert len(answers(reader, 9, seed=0)) == 9
    assert {call["seed"] for call in mllm.asked} == {seed_of_vote(0, vote) for vote in range(9)}
    assert {call["temperature"] for call in mllm.asked} == {0.7}
    mllm.say('{"answer": "B"}')
    assert len(answers(reader, 3)) == 3
    assert all("seed" not in call for call in mllm.asked)
    # Requests with other seeds have no votes in common.
    seeds = [seed_of_vote(seed, vote) for seed in range(20) for vote in range(32)]
    assert len(set(seeds)) == len(seeds)
    assert [seed_of_vote(seed, 0) for seed in (0, 7, 2**31 + 5)] == [0, 7, 5]


def test_answers_are_the_same_each_time_of_a_deterministic_model_at_temperature_0_alone(mllm, tmp_path) -> None:
    from cow_service.readers.mllm.client import MllmClient
    from cow_service.readers.mllm.models import configure
    from cow_service.readers.mllm.reader import MllmReader

    settings = Settings(mllm="qwen3-vl-8b", mllm_base_url=mllm.address, data_dir=tmp_path)
    model = configure(settings)
    for deterministic, defaults, votes, repeats in (
        (False, {"temperature": 0}, 1, False),  # no provider promises the same reply
        (True, {"temperature": 0}, 1, True),
        (True, {"temperature": 0}, 3, False),  # votes are drawn
        (True, {}, 1, False),
    ):
        manifest = model.manifest.model_copy(update={"defaults": defaults})
        client = MllmClient(replace(model, manifest=manifest, deterministic=deterministic), settings)
        assert MllmReader("local", client).repeats_answers(votes) is repeats
        client.close()


def test_the_cpu_is_held_for_work_and_never_while_the_model_is_waited_for(mllm, reader, scene) -> None:
    held = 0
    seen: list[int] = []

    @contextmanager
    def cpu() -> Iterator[None]:
        nonlocal held
        held += 1
        seen.append(held)
        yield
        held -= 1

    def reply(handler) -> None:
        seen.append(-held)
        prompt = mllm.text(-1)
        text = {"answer": "B"} if "`answer`" in prompt else BALL if "sets in motion" in prompt else PLACE
        handler.send(200, say.completion(json.dumps(text)))

    mllm.say(reply)
    asked = ReaderInput(scene.image, QUESTION, scene, cpu=cpu)
    reader.read(asked)
    reader.answer(asked, (), None, None, votes=2)
    assert held == 0
    assert set(seen) == {0, 1}  # no call while it was held, and not taken twice
    assert seen.count(0) == len(mllm.asked) == 4


NAMES = st.one_of(
    st.sampled_from(("red ball", "vase", "cup", "\u200b", "\u200bx", "x" * 130, "", "blue  vase", None, 5)), st.text()
)
AMOUNTS = st.sampled_from(
    ("0 px", "-2 m", "1e9 km", "1e12 px/s", "2 m/s", "3 h", "5000 s", "0.000001 ms", 1e300, "NaN")
)
CHANGES = st.fixed_dictionaries(
    {
        "kind": st.sampled_from(("remove", "place", "put")),
        "object": NAMES,
        "relation": st.sampled_from(("into", "between", "beside", None)),
        "targets": st.lists(NAMES, max_size=3),
    }
)
REPLIES = st.fixed_dictionaries(
    {
        "object": st.sampled_from(("red ball", "r" * 120)),
        "others": st.lists(NAMES, max_size=3),
        "kind": st.sampled_from(("linear", "projectile", "fall", "static", "place", None)),
    },
    optional={
        "changes": st.lists(CHANGES, max_size=2),
        "asked": st.fixed_dictionaries({"relation": st.just("touches"), "target": NAMES, "within": AMOUNTS}),
        "speed": AMOUNTS,
        "distance": AMOUNTS,
        "duration": AMOUNTS,
        "until": st.sampled_from(("contact", "never")),
        "then": st.lists(st.fixed_dictionaries({"way": st.just("left"), "distance": AMOUNTS, "duration": AMOUNTS})),
        "also_moving": st.lists(
            st.fixed_dictionaries({"object": NAMES, "kind": st.sampled_from(("fall", "static")), "way": NAMES})
        ),
    },
)
BOXES = st.lists(
    st.fixed_dictionaries({"label": NAMES, "bbox_2d": st.lists(st.integers(0, 1000), min_size=4, max_size=4)})
)


@settings(max_examples=40, deadline=None)
@given(REPLIES, BOXES)
def test_whatever_the_model_replies_is_read_or_refused(
    mllm, reader, scene, reply: dict[str, Any], boxes: list[dict[str, Any]]
) -> None:
    """Names, numbers and lists beyond the limits of a request among them."""
    scale = json.dumps({"metres": 1000, "down": "top"})

    def replies(handler) -> None:
        text = mllm.text(-1)
        said = json.dumps(reply) if "Find out which one object" in text else scale if "`metres`" in text else where
        handler.send(200, say.completion(said))

    where = json.dumps(PLACE | LINE | {"others": boxes})
    mllm.say(replies)
    with suppress(CowError):
        Reading.model_validate(reader.read(ReaderInput(scene.image, "Does it go 3 m?", scene)).reading.model_dump())
