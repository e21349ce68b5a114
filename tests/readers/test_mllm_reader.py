"""The reader `mllm` by itself: what it asks in each stage, what it hands on, what it holds while it waits."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import mllm_server as say
import pytest
from drawn import ball, block, floor, trail
from mllm_server import MllmServer
from runs import run_of

from cow_service.errors import Canceled, CannotReadDirection, MllmRefused, ObjectNotFound
from cow_service.readers.base import CallLog, MotionHints, Quantity, ReaderInput
from cow_service.readers.mllm.client import MllmClient
from cow_service.readers.mllm.identify import read_identified
from cow_service.readers.mllm.reader import MllmReader, create
from cow_service.records import Asked, Grounding
from cow_service.settings import Settings
from cow_service.stages.grounding import ground
from cow_service.stages.motion import read_motion
from cow_service.vision.scene import Scene

QUESTION = "If the ball rolls along the arrow, what does it hit?"
BALL = {"object": "red ball", "others": [], "kind": "linear", "sentence": "The red ball rolls."}
GIVEN = {"grounding": {"bbox": [286, 176, 334, 224], "object": "orange ball"}}
PLACE = {"label": "red ball", "bbox_2d": [172, 390, 297, 590], "cue": "arrow", "direction": [230, 500, 600, 500]}


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


@pytest.fixture(scope="module")
def reader(mllm: MllmServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[MllmReader]:
    data = tmp_path_factory.mktemp("data")
    made = create(Settings(data_dir=data, mllm="qwen3-vl-8b", mllm_base_url=mllm.address))
    yield made
    made.close()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(ball(floor(), (150, 200), 40, (200, 30, 30)))


def grounding(source: str) -> Grounding:
    return Grounding.model_validate(
        {"object": "red ball", "point": (150, 200), "bbox": (110, 156, 190, 236), "source": source}
    )


def test_what_was_read_with_the_place_needs_no_second_call(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    """Also after a restart, from hints that were stored."""
    mllm.say(json.dumps(BALL), json.dumps(PLACE))
    given = ReaderInput(scene, QUESTION)
    reading = reader.ground(given)
    assert reading.object == "red ball"
    assert len(mllm.asked) == 2
    assert reading.hints is not None
    stored = MotionHints.model_validate_json(reading.hints.model_dump_json())
    motion = reader.read_motion(ReaderInput(scene, QUESTION), grounding("mllm"), stored)
    assert len(mllm.asked) == 2
    assert (motion.kind, motion.cue, motion.sentence) == ("linear", "arrow", "The red ball rolls.")
    assert motion.direction == pytest.approx((0.37 * scene.width, 0), abs=1)


def test_what_is_taken_away_is_located_and_how_far_it_goes_is_kept(
    mllm: MllmServer, reader: MllmReader, scene: Scene
) -> None:
    said = BALL | {"changes": [{"kind": "remove", "object": "blue vase"}], "distance": "10 cm", "until": "contact"}
    vase = {"label": "blue vase", "bbox_2d": [600, 400, 700, 600]}
    mllm.say(
        json.dumps(said | {"speed": "20 pixels per second", "duration": "soon"}), json.dumps(PLACE | {"others": [vase]})
    )
    reading = reader.ground(ReaderInput(scene, QUESTION))
    assert "> blue vase" in mllm.text(1)
    assert [(each.kind, each.object.object) for each in reading.interventions] == [("remove", "blue vase")]
    assert reading.others == ()
    assert reading.hints is not None
    hints = MotionHints.model_validate_json(reading.hints.model_dump_json())
    motion = reader.read_motion(ReaderInput(scene, QUESTION), grounding("mllm"), hints)
    assert (motion.speed, motion.distance, motion.duration) == (Quantity(20, "px/s"), Quantity(0.1, "m"), None)
    assert motion.until == "contact"
    mllm.say(json.dumps(said), json.dumps(PLACE))
    with pytest.raises(ObjectNotFound, match="'blue vase' in the image, which the question changes"):
        reader.ground(ReaderInput(scene, QUESTION))


def test_further_legs_and_other_movers_are_kept(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    then = [
        {"way": "down", "distance": "30 px"},
        {"way": "somewhere"},
        "the right",
        {"direction": "away", "duration": "1 s"},
    ]
    also = [
        {"object": "blue car", "kind": "linear", "way": "left"},
        {"object": "cup", "kind": "fall"},
        {"kind": "fall"},
    ]
    boxes = [{"label": "blue car", "bbox_2d": [600, 400, 700, 600]}, {"label": "cup", "bbox_2d": [800, 100, 850, 200]}]
    mllm.say(json.dumps(BALL | {"then": then, "also_moving": also}), json.dumps(PLACE | {"others": boxes}))
    reading = reader.ground(ReaderInput(scene, QUESTION, sought=("tall lamp",)))
    assert "> blue car" in mllm.text(1)
    assert "> tall lamp" in mllm.text(1), "what the request changes is located, too"
    assert reading.hints is not None
    hints = MotionHints.model_validate_json(reading.hints.model_dump_json())
    found = grounding("mllm").model_copy(update={"others": reading.others})
    motion = reader.read_motion(ReaderInput(scene, QUESTION), found, hints)
    assert [(each.direction, each.distance, each.duration) for each in motion.steps] == [
        ((0, 1), Quantity(30, "px"), None), ((1, 0), None, None), ((0, -1), None, 1.0),
    ]  # fmt: skip
    assert [(each.object.object, each.kind, each.direction) for each in motion.others] == [
        ("blue car", "linear", (-1, 0)), ("cup", "fall", None),
    ]  # fmt: skip
    with pytest.raises(CannotReadDirection, match="'blue car' moves, too, and was not found"):
        reader.read_motion(ReaderInput(scene, QUESTION), grounding("mllm"), hints)


@pytest.mark.parametrize(
    ("written", "asked"),
    [
        ({"relation": "lands"}, Asked(relation="lands")),
        (
            {"Form": "Whether", "relation": "Covers", "target": "coin", "negated": "no", "within": "2 s", "among": []},
            Asked(relation="covers", target="coin", within=2),
        ),
        (
            {"relation": "touches", "subject": "the red ball", "target": "vase"},
            Asked(relation="touches", target="vase"),
        ),
        ({"relation": "explodes", "target": "vase"}, None),
        ({"target": "vase"}, None),
        ({"relation": "touches", "among": "all of them", "negated": "perhaps"}, None),
        ("does it hit the vase?", None),
        (None, None),
    ],
)
def test_what_is_asked_is_read_whole_or_not_at_all(written, asked: Asked | None) -> None:
    found = read_identified(json.dumps(BALL | {"asked": written}))
    assert found is not None
    assert found.asked == asked


def test_what_is_asked_about_is_located_and_handed_on(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    coin = {"label": "coin", "bbox_2d": [600, 400, 700, 600]}
    said = BALL | {"asked": {"relation": "covers", "target": "coin", "negated": False, "form": "whether"}}
    mllm.say(json.dumps(said), json.dumps(PLACE | {"others": [coin]}))
    reading = reader.ground(ReaderInput(scene, "Will it hide the coin below it?"))
    assert reading.asked == Asked(relation="covers", target="coin")
    assert "> coin" in mllm.text(1)
    assert [(each.object, each.role) for each in reading.others] == [("coin", "target")]


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ({"kind": "place", "object": "apple", "relation": "inside", "targets": "bowl"}, ("into", ("bowl",))),
        (
            [{"kind": "put", "object": "cube", "relation": "between", "targets": ["mug", "vase"]}],
            ("between", ("mug", "vase")),
        ),
        ([{"kind": "place", "object": "apple", "relation": "over there", "targets": ["bowl"]}], None),
        ([{"kind": "place", "object": "apple", "relation": "into"}], None),
        (["remove the vase"], None),
        (None, None),
    ],
)
def test_changes_as_replies_write_them(written, read) -> None:
    found = read_identified(json.dumps(BALL | {"changes": written})).changes
    assert [(each.relation, each.targets) for each in found] == ([] if read is None else [read])


def test_a_trail_that_the_model_sees_is_one_whatever_the_language(mllm: MllmServer, reader: MllmReader) -> None:
    """Three balls that stand apart are one ball where something says so; here it is the model's cue."""
    places = [(120.0, 200.0), (215.0, 200.0), (310.0, 200.0)]
    image = block(trail(floor(), places, [24.0] * 3, (220, 120, 30), [1.0] * 3), (460, 180, 530, 250), (40, 160, 60))
    height, width = image.shape[:2]
    box = [round(1000 * each) for each in (286 / width, 176 / height, 334 / width, 224 / height)]
    place = {
        "label": "orange ball",
        "bbox_2d": box,
        "cue": "trail",
        "direction": [box[0], box[1], box[0] + 200, box[1]],
    }
    for given in ({}, GIVEN):
        mllm.say(json.dumps(BALL | {"object": "orange ball"}), json.dumps(place))
        run = run_of(image, reader=lambda: reader, question="Trifft die Kugel den Würfel?", **given)
        found = run.stage("grounding", ground)
        motion = run.stage("motion", read_motion, found, run.hints)
        assert motion.cue == "trail"
        assert [round(x) for x, _ in motion.trail] == pytest.approx([120, 215], abs=2)
        regions = run.scene_of(found, motion.cue).regions
        assert {region.colour for region in regions} == {"orange", "green"}
        assert len(regions) == 2, "the earlier positions are taken out of the image"


@pytest.mark.parametrize("source", ["request", "mllm"])
def test_without_hints_the_motion_is_asked_for_with_the_box_that_is_known(
    source: str, mllm: MllmServer, reader: MllmReader, scene: Scene
) -> None:
    prompts = {"identify", "locate"}
    mllm.say(json.dumps(BALL), json.dumps(PLACE))
    given = ReaderInput(scene, QUESTION)
    assert reader.read_motion(given, grounding(source), None).direction is not None
    assert given.calls.prompts.keys() == prompts | {"looking"}
    assert given.calls.usage.calls == len(mllm.asked) == len(prompts)
    schema = mllm.asked[-1]["response_format"]["json_schema"]["schema"]
    assert "bbox_2d" not in schema["properties"]
    assert "in the box [" in mllm.text(-1)
    mllm.say(json.dumps(BALL | {"also_moving": [{"object": "cup", "kind": "fall"}]}), json.dumps(PLACE))
    motion = reader.read_motion(given, grounding(source), None)
    assert motion.others == ()
    assert "'cup' moves, too, and was left out" in motion.warnings[0]


def test_a_motion_that_the_request_gives_is_not_asked_for(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    mllm.say(json.dumps(BALL), json.dumps(PLACE))
    assert reader.ground(ReaderInput(scene, QUESTION, motion_wanted=False)).hints is None
    assert "direction" not in mllm.asked[-1]["response_format"]["json_schema"]["schema"]["properties"]


@pytest.mark.parametrize(
    ("deterministic", "defaults", "votes", "repeats"),
    [
        (False, {"temperature": 0}, 1, False),  # no provider promises the same reply
        (True, {"temperature": 0}, 1, True),
        (True, {"temperature": 0}, 3, False),  # votes are drawn
        (True, {"temperature": 0.2}, 1, False),
        (True, {}, 1, False),
    ],
)
def test_answers_are_the_same_each_time_of_a_deterministic_model_at_temperature_0_alone(
    deterministic: bool, defaults: dict[str, float], votes: int, repeats: bool, reader: MllmReader, mllm: MllmServer
) -> None:
    model = reader._client.model
    manifest = model.manifest.model_copy(update={"defaults": defaults})
    client = MllmClient(replace(model, manifest=manifest, deterministic=deterministic), Settings())
    try:
        assert MllmReader("local", client).repeats_answers(votes) is repeats
    finally:
        client.close()


def test_calls_that_fail_count_too(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    mllm.say(say.status(400))
    calls = CallLog()
    with pytest.raises(MllmRefused):
        reader.ground(ReaderInput(scene, QUESTION, calls=calls))
    assert calls.usage.calls == len(mllm.asked) == 1
    assert calls.prompts.keys() == {"identify", "looking"}


def test_the_cpu_is_held_for_work_and_never_while_the_model_is_waited_for(
    mllm: MllmServer, reader: MllmReader, scene: Scene
) -> None:
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
    given = ReaderInput(scene, QUESTION, cpu=cpu)
    hints = reader.ground(given).hints
    reader.read_motion(given, grounding("mllm"), hints)
    reader.answer(given, (), None, None, votes=2)
    assert held == 0
    assert set(seen) == {0, 1}  # no call while it was held, and not taken twice
    assert seen.count(0) == len(mllm.asked) == 4


def test_a_canceled_run_waits_no_longer(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    mllm.say(say.slow(5))

    def canceled() -> None:
        if mllm.asked:
            raise Canceled("The caller left.")

    with pytest.raises(Canceled):
        reader.ground(ReaderInput(scene, QUESTION, check_canceled=canceled))


def test_requests_at_the_same_time_do_not_mix(mllm: MllmServer, reader: MllmReader) -> None:
    """A reader keeps nothing of a request: one image is never sent for the other."""
    wide, tall = Scene(floor(320, 160)), Scene(floor(160, 320))
    mllm.say('{"answer": "B"}')
    requests = [ReaderInput(wide, "Is it wide?"), ReaderInput(tall, "Is it tall?")] * 3
    with ThreadPoolExecutor(max_workers=6) as pool:
        list(pool.map(lambda given: reader.answer(given, (), None, None, votes=3), requests))
    assert len(mllm.asked) == 18
    for call in range(18):
        height, width = mllm.images(call)[0].shape[:2]
        assert ("Is it wide?" in mllm.text(call)) == (width > height)
