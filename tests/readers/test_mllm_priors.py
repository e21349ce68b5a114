"""Optional parts of an MLLM's reply: sizes, supports, depth and speed as priors, and boxes of other objects."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import mllm_server as say
import pytest
from drawn import ball, block, floor
from hypothesis import given
from hypothesis import strategies as st
from mllm_server import MllmServer

from cow_service.readers.base import GroundingReading, MotionReading, ReaderInput
from cow_service.readers.mllm import estimates
from cow_service.readers.mllm.coordinates import CoordinateFrame
from cow_service.readers.mllm.estimates import support_named
from cow_service.readers.mllm.locate import MAX_OBSTACLES, Line, Located, SeenObject, read_located
from cow_service.readers.mllm.reader import MllmReader, create
from cow_service.records import Estimate, Grounding, ObjectPrior
from cow_service.settings import Settings
from cow_service.vision.scene import Scene
from cow_service.weights.manifests import load_families

FRAME = CoordinateFrame(640, 400, (640, 400), load_families()["qwen3-vl"].coordinates)
BALL = {"label": "red ball", "bbox_2d": [172, 400, 297, 600]}
VASE = {"label": "vase", "bbox_2d": [700, 300, 800, 600]}
OPTIONAL = [name for kind in (SeenObject, Line) for name, field in kind.model_fields.items() if not field.is_required()]
LINE = {"cue": "orientation", "along_arrow": None, "camera": None, "direction": [230, 500, 600, 500]}


def read(mover: dict[str, Any], others: object = (), targets: tuple[str, ...] = ("vase",), **motion: Any) -> Located:
    """What is read of a reply that gives a mover, others and a motion."""
    reply = {"reasoning": "r", **mover, "others": others, **LINE, **motion}
    found = read_located(json.dumps(reply), FRAME, "red ball", targets, True, True)
    assert found is not None
    return found


# What an object is like


def test_priors_have_widths() -> None:
    given = {"size": 0.2, "stands_on": "floor", "height_above": 0.02, "shape": "sphere"}
    found = read(BALL | given, [VASE | {"size": 0.4, "height_above": 1}])
    assert found.prior == ObjectPrior(
        shape="sphere",
        size=Estimate(value=0.2, deviation=estimates.SIZE_DEVIATION * 0.2),
        stands_on="floor",
        height=Estimate(value=0.02, deviation=estimates.MIN_HEIGHT_DEVIATION),
    )
    (vase,) = found.others
    assert vase.prior is not None
    assert vase.prior.size == Estimate(value=0.4, deviation=estimates.SIZE_DEVIATION * 0.4)
    assert vase.prior.height == Estimate(value=1, deviation=estimates.HEIGHT_DEVIATION)
    assert (vase.role, vase.source, found.warnings) == ("target", "mllm", ())


@pytest.mark.parametrize("said", [{}, {"size": None, "stands_on": "unknown", "height_above": "n/a", "shape": ""}])
def test_who_says_nothing_is_not_warned_of(said: dict[str, Any]) -> None:
    found = read(BALL | said, [VASE | said], depth_degrees=None, speed=None)
    assert (found.prior, found.others[0].prior, found.warnings) == (None, None, ())
    assert found.line is not None
    assert (found.line.depth_degrees, found.line.speed) == (None, None)


@pytest.mark.parametrize(
    ("field", "value", "shown"),
    [
        ("size", 3000, "'3000' is not a length"),
        ("size", -0.1, "'-0.1'"),
        ("size", 0, "'0'"),
        ("size", math.nan, "'nan'"),
        ("size", 10**400, "'1000"),
        ("size", True, "'True'"),
        ("size", "3 km", "'3 km'"),
        ("size", "large", "'large'"),
        ("size", [0.1, 0.2], "'[0.1, 0.2]'"),
        ("height_above", -1, "'-1' is not a height"),
        ("height_above", math.inf, "'inf'"),
        ("stands_on", 7, "'7'"),
        ("stands_on", "red ball", "'red ball'"),
        ("shape", "blob", "'blob' is not one of sphere"),
        ("depth_degrees", 120, "'120' is not an angle"),
        ("depth_degrees", "sevenish", "'sevenish'"),
        ("depth_degrees", math.nan, "'nan'"),
        ("speed", "ludicrous", "'ludicrous' is not one of slow"),
        ("speed", 12, "'12'"),
    ],
)
def test_what_cannot_be_is_left_out_with_a_warning(field: str, value: object, shown: str) -> None:
    found = read(BALL | {field: value})
    assert found.prior is None
    assert found.line is not None
    assert (found.line.depth_degrees, found.line.speed, found.line.camera) == (None, None, None)
    (warning,) = found.warnings
    assert f"`{field}`" in warning
    assert shown in warning
    assert found.bbox == pytest.approx((110.08, 160, 190.08, 240))


@pytest.mark.parametrize(
    ("written", "metres"), [("0.3", 0.3), ("30 cm", 0.3), ("0.3 metres", 0.3), ("5mm", 0.005), (1, 1.0)]
)
def test_lengths(written: object, metres: float) -> None:
    prior = read(BALL | {"size": written}).prior
    assert prior is not None
    assert prior.size is not None
    assert prior.size.value == pytest.approx(metres)


@pytest.mark.parametrize(
    ("said", "support"),
    [
        ("floor", "floor"),
        ("The ground", "floor"),
        ("table top", "floor"),
        ("auf dem Boden", "floor"),
        ("el suelo", "floor"),
        ("地面", "floor"),
        ("mid-air", "air"),
        ("in the air", "air"),
        ("in der Luft", "air"),
        ("dans l'air", "air"),
        ("空中", "air"),
        ("the blue crate", "blue crate"),
        ("crate", "blue crate"),
        ("top of the blue crate", "blue crate"),
        ("a shelf", "a shelf"),
        ("the red ball", None),
        ("", None),
        ("12", None),
    ],
)
def test_supports(said: str, support: str | None) -> None:
    assert support_named(said, "red ball", ("vase", "blue crate")) == support


def test_a_table_that_was_located_comes_before_the_floor() -> None:
    assert support_named("table top", "ball", ("wooden table",)) == "wooden table"
    assert support_named("box", "ball", ("red box", "blue box")) == "box"  # which of them it does not say


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=12)
    | st.sampled_from(["away 30", "1 m"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=4,
)


@given(fields=st.dictionaries(st.sampled_from(OPTIONAL), VALUES))
def test_no_optional_field_fails_or_moves_the_box(fields: dict[str, Any]) -> None:
    found = read(BALL | fields, [VASE | fields])
    assert found.bbox == read(BALL).bbox
    assert len(found.others) == 1
    for prior in (found.prior, found.others[0].prior):
        for estimate in () if prior is None else (prior.size, prior.height):
            assert estimate is None or (0 <= estimate.value <= 1000 and math.isfinite(estimate.deviation))
    assert found.line is not None
    assert found.line.direction is not None or found.line.camera is not None
    assert abs(found.line.depth_degrees or 0) <= 90


# How it moves


@pytest.mark.parametrize(
    ("said", "degrees", "camera"),
    [
        ({"depth_degrees": 30}, 30, None),
        ({"depth_degrees": -25}, -25, None),
        ({"depth_degrees": "30 degrees away"}, 30, None),
        ({"depth_degrees": "slightly towards the camera"}, -20, None),
        ({"depth_degrees": "across"}, 0, None),
        ({"depth_degrees": 30, "camera": "towards"}, -30, None),  # its line leads to the right: no contradiction
        ({"depth_degrees": 80, "direction": [230, 500, 230, 100]}, None, "away"),
        ({"depth_degrees": -90, "direction": None}, None, "towards"),
        ({"depth_degrees": 80}, 80, None),  # along a line to the right nothing moves straight away: no fault either
        ({"camera": "away", "direction": None}, None, "away"),
        ({"camera": "away", "direction": None, "depth_degrees": 20}, None, "away"),
    ],
)
def test_depth(said: dict[str, Any], degrees: float | None, camera: str | None) -> None:
    line = read(BALL, **said).line
    assert line is not None
    assert (line.depth_degrees, line.camera) == (degrees, camera)


# What is around


@pytest.mark.parametrize("family", ["qwen3-vl", "qwen2.5-vl", "gemini", "claude", "gpt"])
def test_boxes_of_targets_and_obstacles_in_every_convention(family: str) -> None:
    frame = CoordinateFrame(640, 400, (320, 200), load_families()[family].coordinates)
    key = frame.coordinates.box
    boxes = {"red ball": (64, 160, 128, 240), "the blue mug": (320, 120, 384, 240), "box": (448, 80, 512, 240)}
    written = {name: frame.write((box[0], box[1]), (box[2], box[3])) for name, box in boxes.items()}
    others = [{"label": name, key: written[name], "size": 0.1} for name in ("box", "the blue mug")]
    reply = json.dumps({"label": "red ball", key: written["red ball"], "stands_on": "box", "others": others})
    found = read_located(reply, frame, "red ball", ("blue mug",), True, False)
    assert found is not None
    assert [(other.object, other.role) for other in found.others] == [("blue mug", "target"), ("box", "obstacle")]
    assert found.bbox == pytest.approx(boxes["red ball"], abs=2)
    assert found.others[0].bbox == pytest.approx(boxes["the blue mug"], abs=2)
    assert found.others[1].bbox == pytest.approx(boxes["box"], abs=2)
    assert found.prior == ObjectPrior(stands_on="box")
    assert all(other.prior is not None and other.prior.size is not None for other in found.others)


def test_targets_are_known_by_their_words() -> None:
    mug, other_mug = {"label": "mug", "bbox_2d": [1, 1, 90, 90]}, {"label": "red mug", "bbox_2d": [300, 1, 390, 90]}
    found = read(BALL, [other_mug, mug, VASE], targets=("the blue mug", "vase"))
    told = [(other.object, other.role) for other in found.others]
    assert told == [("the blue mug", "target"), ("vase", "target"), ("red mug", "obstacle")]
    unsure = read(BALL, [other_mug, {"label": "green mug", "bbox_2d": [1, 1, 90, 90]}], targets=("mug",))
    assert {other.role for other in unsure.others} == {"obstacle"}


def test_what_is_no_object_is_left_out() -> None:
    bad = {"label": "lamp", "bbox_2d": [500, 400, 500, 400]}
    wall = {"label": "wall", "bbox_2d": [0, 0, 1000, 1000]}
    ground = {"label": "the floor", "bbox_2d": [0, 500, 1000, 1000]}
    found = read(BALL | {"stands_on": "lamp"}, [bad, wall, ground, VASE, {"label": "cat", "bbox_2d": None}, 3, "x"])
    assert [other.object for other in found.others] == ["vase"]
    assert ["'lamp'" in warning or "'wall'" in warning for warning in found.warnings] == [True, True]
    assert found.prior == ObjectPrior(stands_on="lamp")  # in words: it was not located


# The reader


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
    return Scene(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200)))


def ground(
    mllm: MllmServer, reader: MllmReader, scene: Scene, reply: dict[str, Any]
) -> tuple[GroundingReading, MotionReading]:
    named = {"object": "red ball", "others": ["vase"], "kind": "linear", "sentence": "The red ball rolls."}
    mllm.say(json.dumps(named), json.dumps(reply))
    given = ReaderInput(scene, "If the red ball rolls to the right, will it hit the vase?")
    reading = reader.ground(given)
    place = Grounding(object="red ball", point=(150, 200), bbox=reading.bbox, source="mllm")
    motion = reader.read_motion(given, place, reading.hints)
    assert len(mllm.asked) == 2, "nothing was asked again"
    return reading, motion


def test_priors_travel_to_both_stages(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    said = {"size": 0.2, "shape": "ball", "depth_degrees": 30, "speed": "slowly", "height_above": -3}
    reading, motion = ground(mllm, reader, scene, BALL | LINE | said | {"others": [VASE]})
    assert reading.prior is not None
    assert (reading.prior.shape, reading.prior.height) == ("sphere", None)
    assert any("`height_above` of 'red ball'" in warning for warning in reading.warnings)
    assert motion.depth == pytest.approx(0.5)
    assert (motion.depth_deviation, motion.speed) == (estimates.HEADING_DEVIATION, "slow")
    assert motion.speed_deviation == estimates.SPEED_DEVIATION
    assert motion.direction == pytest.approx((0.37 * 640, 0))


def test_without_priors_nothing_is_said(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    reading, motion = ground(mllm, reader, scene, BALL | LINE)
    assert (reading.prior, reading.others, reading.warnings) == (None, (), ())
    assert (motion.depth, motion.depth_deviation, motion.speed, motion.speed_deviation) == (0.0, None, None, None)


def test_the_warnings_of_a_motion_alone_are_not_lost(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    mllm.say(json.dumps({"object": "red ball", "kind": "linear"}), json.dumps(LINE | {"speed": "warp 9"}))
    place = Grounding(object="red ball", point=(150, 200), bbox=(110, 156, 190, 236), source="request")
    motion = reader.read_motion(ReaderInput(scene, "Where does it roll?"), place, None)
    assert motion.speed is None
    assert "'warp 9'" in motion.warnings[0]


def test_each_object_has_one_box_and_obstacles_are_few(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    boxes = [{"label": f"block {n}", "bbox_2d": [90 * n, 800, 90 * n + 60, 950]} for n in range(11)]
    doubles = [
        {"label": "ball again", "bbox_2d": [175, 405, 297, 600]},
        {"label": "vase as well", "bbox_2d": [705, 300, 800, 600]},
        boxes[0] | {"label": "block 0 again"},
    ]
    reading, _ = ground(mllm, reader, scene, BALL | LINE | {"others": [*doubles, *boxes, VASE]})
    assert [other.object for other in reading.others[:2]] == ["vase", "block 0 again"]
    assert len(reading.others) == 1 + MAX_OBSTACLES
    assert reading.warnings == ()
    reading, _ = ground(mllm, reader, scene, BALL | LINE | {"others": [VASE | {"bbox_2d": BALL["bbox_2d"]}]})
    assert reading.others == ()
    assert "'vase'" in reading.warnings[0]


def test_optional_fields_are_asked_for_and_may_be_left_out(mllm: MllmServer, reader: MllmReader, scene: Scene) -> None:
    ground(mllm, reader, scene, BALL | LINE)
    words, sent = mllm.text(1), mllm.asked[1]["response_format"]["json_schema"]["schema"]
    for field in OPTIONAL:
        assert f"`{field}`" in words
        assert field in sent["properties"]
        assert field not in sent["required"]
    assert "up to 8 that could be hit" in words
    assert "> vase" in words.splitlines()
