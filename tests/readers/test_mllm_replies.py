"""What a multimodal LLM's reply says, by itself: places, directions, answers, and optional estimates as priors."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest
from conftest import DATA, ROOT
from hypothesis import given
from hypothesis import strategies as st

from cow_service.readers.options import read_choices
from cow_service.records import Asked, Estimate, ObjectPrior
from cow_service.weights.manifests import load_families

if TYPE_CHECKING:
    from cow_service.readers.mllm.coordinates import CoordinateFrame
    from cow_service.readers.mllm.locate import Located

SHARED = ROOT.parent / "shared" / "mllm_replies" / "replies.json"
OWN = DATA / "mllm_replies.json"
CASES = json.loads(OWN.read_text()) + (json.loads(SHARED.read_text()) if SHARED.exists() else [])
CHOICES = read_choices("If the toy car moves forward, will it hit the vase? (A) Yes (B) No (C) Not sure", None)
BALL = {"label": "red ball", "bbox_2d": [172, 400, 297, 600]}
VASE = {"label": "vase", "bbox_2d": [700, 300, 800, 600]}
LINE = {"cue": "orientation", "along_arrow": None, "camera": None, "direction": [230, 500, 600, 500]}
NAMED = {"object": "red ball", "others": [], "kind": "linear", "sentence": "The red ball rolls."}
OPTIONAL = ("size", "stands_on", "height_above", "shape", "depth_degrees", "speed")


def frame_of(family: str, image: tuple[int, int] = (640, 400), sent: tuple[int, int] = (640, 400)) -> CoordinateFrame:
    from cow_service.readers.mllm.coordinates import CoordinateFrame

    return CoordinateFrame(*image, sent, load_families()[family].coordinates)


def usable(read: Callable[[], Any]) -> Any:
    """What is read of a reply, or what can be used of one that is asked for again."""
    from cow_service.readers.mllm.replies import ReplyError

    try:
        return read()
    except ReplyError as error:
        if error.usable is None:
            raise
        return error.usable


def told(case: dict[str, Any]) -> dict[str, Any]:
    """What the reading of a case's stage makes of it, in the terms of `expect`."""
    from cow_service.readers.mllm.answer import read_answer
    from cow_service.readers.mllm.identify import read_identified
    from cow_service.readers.mllm.locate import read_located
    from cow_service.readers.mllm.replies import ReplyError

    view = frame_of(case["family"], case["image"], tuple(case["sent"]))
    stage, raw = case["stage"], case["raw"]
    try:
        if stage == "identify":
            named = usable(lambda: read_identified(raw))
            return {"error": "object-not-found"} if named is None else {"object": named.object}
        if stage == "answer":
            reading = read_answer(raw, CHOICES)
            return {"answer": reading.answer, "not_sure": reading.not_sure}
        found = read_located(raw, view, "the toy car", (), stage == "locate", stage == "direction")
    except ReplyError:
        return {"error": "mllm-bad-reply"}
    if found is None:
        return {"error": "object-not-found"}
    if found.line is None:
        return {"bbox": found.bbox, "point": found.point}
    if found.line.direction is None:
        return {"error": "cannot-read-direction"} if found.line.camera is None else {"camera": found.line.camera}
    (x0, y0), (x1, y1) = found.line.direction
    length = math.hypot(x1 - x0, y1 - y0)
    return {"direction": ((x1 - x0) / length, (y1 - y0) / length), "cue": found.line.cue}


@pytest.mark.parametrize(("reply", "reasoning"), [("B", ""), ("It rolls on.\nB", "It rolls on.\nB")])
def test_a_bare_letter_is_no_reasoning(reply: str, reasoning: str) -> None:
    from cow_service.readers.mllm.answer import read_answer

    assert read_answer(reply, CHOICES).reasoning == reasoning


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['stage']}-{case['family']}-{case['id']}")
def test_every_reply_is_read_right_or_refused(case: dict[str, Any]) -> None:
    found = told(case)
    for key, value in case["expect"].items():
        if key in ("bbox", "point"):
            assert found[key] == pytest.approx(value, abs=1)
        elif key == "direction" and "camera" not in found:
            assert found[key] == pytest.approx(value, abs=0.01)
        elif "camera" not in found:
            assert found[key] == value


@given(st.text(alphabet="{}[]\"'\\,:0aA().<>|", max_size=60))
def test_no_reply_breaks_the_reading(text: str) -> None:
    for stage in ("identify", "locate", "direction", "answer"):
        found = told({"stage": stage, "raw": text, "family": "qwen3-vl", "image": [320, 180], "sent": [320, 180]})
        if "error" not in found:
            assert found.get("answer") in {None, "A", "B", "C"}
            assert found.get("object") != ""
            x0, y0, x1, y1 = found.get("bbox") or (0, 0, 320, 180)
            assert 0 <= x0 < x1 <= 320
            assert 0 <= y0 < y1 <= 180


def test_a_reply_is_looked_through_once() -> None:
    """A search that grows with the square of the length would not end here."""
    from cow_service.readers.mllm.replies import values_in

    for noise in ("[" * 90_000, "{ " * 90_000, '{"a": "' * 40_000, "blah { " * 40_000, '["\\' * 90_000):
        assert values_in(noise) == ()


# What is asked and what moves


@pytest.mark.parametrize(
    ("written", "asked"),
    [
        (
            {"Form": "Whether", "relation": "Covers", "target": "coin", "negated": "no", "within": "2 s", "among": []},
            Asked(relation="covers", target="coin", within=2),
        ),
        ({"relation": "touches", "subject": "red ball", "target": "vase"}, Asked(relation="touches", target="vase")),
        ({"relation": "collides with", "target": "the vase on the left"}, Asked(relation="touches", target="vase")),
        (
            {"relation": "misses", "target": "vase", "form": "yes/no"},
            Asked(relation="touches", target="vase", negated=True),
        ),
        (
            {"relation": "touches", "form": "which to remove", "among": ["vase", "cup"]},
            Asked(relation="touches", form="which-to-remove", among=("vase", "cup")),
        ),
        ([{"relation": "touches", "target": "vase"}], Asked(relation="touches", target="vase")),
        ("Will it hit the vase?", Asked(relation="touches", target="vase")),
        ("Does it knock over anything?", Asked(relation="tips")),
        ("Will it not hit the vase?", None),
        ("Will it hit the target?", None),
        ("Will it hit and hide the vase?", None),
        ({"relation": "explodes", "target": "vase"}, None),
        ({"target": "vase"}, None),
        ({"relation": "touches", "among": "all of them", "negated": "perhaps"}, None),
    ],
)
def test_what_is_asked_is_read_whole_or_asked_again_and_left_out(written: Any, asked: Asked | None) -> None:
    from cow_service.readers.mllm.identify import read_identified
    from cow_service.readers.mllm.replies import ReplyError

    reply = json.dumps(NAMED | {"others": ["vase"], "asked": written})
    if asked is None:
        with pytest.raises(ReplyError, match="`asked`"):
            read_identified(reply)
    found = usable(lambda: read_identified(reply))
    assert found.asked == asked
    assert bool(found.warnings) is (asked is None)


def test_changes_as_replies_write_them() -> None:
    from cow_service.readers.mllm.identify import read_identified
    from cow_service.readers.mllm.replies import ReplyError

    between = [{"kind": "put", "object": "cube", "relation": "between", "targets": ["mug", "vase"]}]
    for written, read in (
        ({"kind": "place", "object": "apple", "relation": "inside", "targets": "bowl"}, [("into", ("bowl",))]),
        (between, [("between", ("mug", "vase"))]),
        ([{"kind": "remove", "object": None}, "none", {"kind": "...", "object": "..."}], []),
    ):
        named = read_identified(json.dumps(NAMED | {"changes": written}))
        assert named is not None
        assert [(each.relation, each.targets) for each in named.changes] == read, written
    # Without one that cannot be read, another world would be simulated.
    for unread in (
        {"kind": "place", "object": "apple", "relation": "over there", "targets": ["bowl"]},
        {"kind": "place", "object": "apple", "relation": "into"},
        "remove the vase",
        [{"kind": "remove", "object": f"cup {number}"} for number in range(9)],
    ):
        with pytest.raises(ReplyError, match="`changes`") as caught:
            read_identified(json.dumps(NAMED | {"changes": unread}))
        assert caught.value.usable is None


def test_what_the_caller_has_said_is_not_read() -> None:
    from cow_service.readers.mllm.identify import read_identified

    unread = {"asked": "?", "changes": ["?"], "then": ["?"], "kind": "?"}
    found = read_identified(json.dumps(NAMED | unread), unread.keys())
    assert found is not None
    assert (found.asked, found.changes, found.then, found.kind, found.warnings) == (None, (), (), None, ())


# What an object is like


def read(mover: dict[str, Any], others: object = (), targets: tuple[str, ...] = ("vase",), **motion: Any) -> Located:
    """What is read of a reply that gives a mover, others and a motion."""
    from cow_service.readers.mllm.locate import read_located

    reply = {"reasoning": "r", **mover, "others": others, **LINE, **motion}
    return usable(lambda: read_located(json.dumps(reply), frame_of("qwen3-vl"), "red ball", targets, True, True))


def test_priors_have_widths() -> None:
    from cow_service.readers.mllm import estimates

    said = {"size": 0.2, "stands_on": "floor", "height_above": 0.02, "shape": "sphere"}
    found = read(BALL | said, [VASE | {"size": 0.4, "height_above": 1}])
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


def test_who_says_nothing_is_not_warned_of() -> None:
    for said in ({}, {"size": None, "stands_on": "unknown", "height_above": "n/a", "shape": ""}):
        found = read(BALL | said, [VASE | said], depth_degrees=None, speed=None)
        assert (found.prior, found.others[0].prior, found.warnings) == (None, None, ())
        assert found.line is not None
        assert (found.line.depth_degrees, found.line.speed) == (None, None)


IMPOSSIBLE = {
    "size": (3000, 0, 10**400, True, "3 km", [0.1, 0.2]), "height_above": (-1,), "stands_on": (7, "red ball"),
    "shape": ("blob",), "depth_degrees": (120,), "speed": ("ludicrous",),
}  # fmt: skip


@pytest.mark.parametrize(("field", "value"), [(field, each) for field, some in IMPOSSIBLE.items() for each in some])
def test_what_cannot_be_is_left_out_with_a_warning(field: str, value: object) -> None:
    """The warning names the field and the value."""
    found = read(BALL | {field: value})
    assert found.prior is None
    assert found.line is not None
    assert (found.line.depth_degrees, found.line.speed, found.line.camera) == (None, None, None)
    (warning,) = found.warnings
    assert f"`{field}`" in warning
    assert str(value)[:4] in warning
    assert found.bbox == pytest.approx((110.08, 160, 190.08, 240))


def test_lengths() -> None:
    for written, metres in (("0.3", 0.3), ("30 cm", 0.3), ("0.3 metres", 0.3), ("5mm", 0.005), (1, 1.0)):
        prior = read(BALL | {"size": written}).prior
        assert prior is not None
        assert prior.size is not None
        assert prior.size.value == pytest.approx(metres)


def test_supports() -> None:
    from cow_service.readers.mllm.estimates import support_named

    named = {
        "The ground": "floor", "table top": "floor", "地面": "floor", "mid-air": "air", "空中": "air",
        "top of the blue crate": "blue crate", "a shelf": "a shelf", "the red ball": None, "": None,
    }  # fmt: skip
    assert {said: support_named(said, "red ball", ("vase", "blue crate")) for said in named} == named
    assert support_named("table top", "ball", ("wooden table",)) == "wooden table", "before the floor"
    assert support_named("box", "ball", ("red box", "blue box")) == "box"  # which of them it does not say


VALUES = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=12), st.sampled_from(["1 m", "up"])
    ),
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


@pytest.mark.parametrize(
    ("said", "degrees", "camera"),
    [
        ({"depth_degrees": 30}, 30, None),
        ({"depth_degrees": "30 degrees away"}, 30, None),
        ({"depth_degrees": "slightly towards the camera"}, -20, None),
        ({"depth_degrees": "across"}, 0, None),
        ({"depth_degrees": 30, "camera": "towards"}, -30, None),  # its line leads to the right: no contradiction
        ({"depth_degrees": 80, "direction": [230, 500, 230, 100]}, None, "away"),
        ({"depth_degrees": -90, "direction": None}, None, "towards"),
        ({"depth_degrees": 80}, 80, None),  # along a line to the right nothing moves straight away: no fault either
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
    from cow_service.readers.mllm.locate import read_located

    frame = frame_of(family, sent=(320, 200))
    key = frame.coordinates.box
    boxes = {"red ball": (64, 160, 128, 240), "the blue mug": (320, 120, 384, 240), "box": (448, 80, 512, 240)}
    written = {name: frame.write((box[0], box[1]), (box[2], box[3])) for name, box in boxes.items()}
    others = [{"label": name, key: written[name], "size": 0.1} for name in ("box", "the blue mug")]
    reply = json.dumps({"label": "red ball", key: written["red ball"], "stands_on": "box", "others": others})
    found = read_located(reply, frame, "red ball", ("blue mug",), True, False)
    assert found is not None
    assert [(other.object, other.role) for other in found.others] == [("blue mug", "target"), ("box", "obstacle")]
    places = (found.bbox, *(other.bbox for other in found.others))
    for place, wanted in zip(places, ("red ball", "the blue mug", "box"), strict=True):
        assert place == pytest.approx(boxes[wanted], abs=2)
    assert found.prior == ObjectPrior(stands_on="box")
    assert all(other.prior is not None and other.prior.size is not None for other in found.others)


def test_targets_are_known_by_their_words() -> None:
    mug, other_mug = {"label": "mug", "bbox_2d": [1, 1, 90, 90]}, {"label": "red mug", "bbox_2d": [300, 1, 390, 90]}
    found = read(BALL, [other_mug, mug, VASE], targets=("the blue mug", "vase"))
    roles = [(other.object, other.role) for other in found.others]
    assert roles == [("the blue mug", "target"), ("vase", "target"), ("red mug", "obstacle")]
    unsure = read(BALL, [other_mug, {"label": "green mug", "bbox_2d": [1, 1, 90, 90]}], targets=("mug",))
    assert {other.role for other in unsure.others} == {"obstacle"}


def test_what_is_no_object_is_left_out() -> None:
    bad = {"label": "lamp", "bbox_2d": [500, 400, 500, 400]}
    wall = {"label": "wall", "bbox_2d": [0, 0, 1000, 1000]}
    ground = {"label": "the floor", "bbox_2d": [0, 500, 1000, 1000]}
    found = read(BALL | {"stands_on": "lamp"}, [bad, wall, ground, VASE, {"label": "cat", "bbox_2d": None}, 3, "cup"])
    assert [other.object for other in found.others] == ["vase"]
    assert all(sum(name in warning for warning in found.warnings) == 1 for name in ("'3'", "'cup'", "'lamp'", "'wall'"))
    assert len(found.warnings) == 4
    assert found.prior == ObjectPrior(stands_on="lamp")  # in words: it was not located


MUG = {"label": "mug", "bbox_2d": [400, 300, 450, 400]}
IN_THE_WAY = [("vase", "target"), ("mug", "obstacle")]


@pytest.mark.parametrize("wrap", ["result", "arguments", "a list", "a plain list", "others by name", "others with key"])
def test_others_are_found_in_whatever_the_reply_is_wrapped(wrap: str) -> None:
    from cow_service.readers.mllm.locate import read_located

    reply: Any = BALL | LINE | {"others": [MUG, VASE]}
    if wrap == "a list":
        reply = [reply]
    elif wrap == "a plain list":
        reply = [BALL, MUG, VASE, LINE]
    elif wrap == "others by name":
        reply["others"] = {each["label"]: each["bbox_2d"] for each in (MUG, VASE)}
    elif wrap == "others with key":
        reply["others"] = [{each["label"]: each["bbox_2d"]} for each in (MUG, VASE)]
    else:
        reply = {"name": "reply", wrap: reply}
    found = read_located(json.dumps(reply), frame_of("qwen3-vl"), "red ball", ("vase",), True, True)
    assert found is not None
    assert [(other.object, other.role) for other in found.others] == IN_THE_WAY
    assert found.objects_complete
    assert found.line is not None


@pytest.mark.parametrize(
    ("others", "complete"),
    [
        ({"others": [MUG, VASE]}, True),  # all that could be hit was asked for
        ({"others": [VASE]}, False),
        ({"others": [VASE], "complete": True}, True),
        ({"others": [MUG, VASE], "complete": False}, False),
        ({"others": [MUG, VASE], "complete": "perhaps"}, False),
        ({"others": [MUG, VASE], "complete": None}, False),
        *(
            ({"others": [MUG, VASE, each], "complete": True}, False)
            for each in ("cup", {"label": "cup", "bbox_2d": None})
        ),
    ],
)
def test_a_list_is_complete_if_it_says_so_or_is_one_and_nothing_of_it_is_left_out(
    others: dict[str, Any], complete: bool
) -> None:
    assert read(BALL, **others).objects_complete is complete


@pytest.mark.parametrize(
    ("reply", "fault"),
    [
        ({"others": [{"bbox_2d": VASE["bbox_2d"]}]}, "without a label"),
        ({"others": [VASE, VASE | {"bbox_2d": MUG["bbox_2d"]}]}, "2 things are labelled 'vase'"),
        ({"others": [VASE | {"bbox_2d": BALL["bbox_2d"]}]}, "the same box"),
        ({"others": [VASE], "sense": "sideways"}, "`sense`"),
        ({"others": [VASE], "direction": "right"}, "in words"),
    ],
)
def test_what_contradicts_itself_is_asked_for_again(reply: dict[str, Any], fault: str) -> None:
    from cow_service.readers.mllm.locate import read_located
    from cow_service.readers.mllm.replies import ReplyError

    with pytest.raises(ReplyError, match=fault) as caught:
        read_located(json.dumps(BALL | LINE | reply), frame_of("qwen3-vl"), "red ball", ("vase",), True, True)
    assert caught.value.usable is not None


@pytest.mark.parametrize(
    ("mover", "fault"), [({"bbox_2d": [0, 0, 1000, 1000]}, "whole image"), (VASE, "that of 'vase'")]
)
def test_nothing_is_read_with_the_wrong_box_of_what_moves(mover: dict[str, Any], fault: str) -> None:
    from cow_service.readers.mllm.replies import ReplyError

    with pytest.raises(ReplyError, match=fault) as caught:
        read(BALL | mover, [VASE])
    assert caught.value.usable is None


@pytest.mark.parametrize("family", ["qwen3-vl", "gemini", "gpt"])
def test_a_direction_is_two_named_points_and_its_sense_a_word(family: str) -> None:
    from cow_service.readers.mllm.locate import read_located

    frame = frame_of(family, sent=(320, 200))
    for word, sense in (("with", True), ("against the arrow", False), (None, None)):
        line = {"cue": "arrow", "sense": word, "start": frame.write((100, 300)), "end": frame.write((400, 100))}
        found = read_located(json.dumps(line), frame, "red ball", (), False, True)
        assert found is not None
        assert found.line is not None
        assert found.line.sense is sense
        assert found.line.direction is not None
        for point, wanted in zip(found.line.direction, ((100, 300), (400, 100)), strict=True):
            assert point == pytest.approx(wanted, abs=2)
