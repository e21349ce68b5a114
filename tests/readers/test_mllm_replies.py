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
from cow_service.records import Asked, Coordinates
from cow_service.weights.manifests import load_families

if TYPE_CHECKING:
    from cow_service.readers.base import ReadResult
    from cow_service.readers.mllm.coordinates import CoordinateFrame

SHARED = ROOT.parent / "shared" / "mllm_replies" / "replies.json"
OWN = DATA / "mllm_replies.json"
CASES = json.loads(OWN.read_text()) + (json.loads(SHARED.read_text()) if SHARED.exists() else [])
CHOICES = read_choices("If the toy car moves forward, will it hit the vase? (A) Yes (B) No (C) Not sure", None)
BALL = {"label": "red ball", "bbox_2d": [172, 400, 297, 600]}
VASE = {"label": "vase", "bbox_2d": [700, 300, 800, 600]}
LINE = {"cue": "orientation", "along_arrow": None, "camera": None, "direction": [230, 500, 600, 500]}
NAMED = {"object": "red ball", "others": [], "kind": "linear"}


def test_no_schema_stands_at_two_places() -> None:
    """pydantic-ai would empty the second."""
    from cow_service.readers.mllm.replies import closed, nullable, words

    point = nullable(words(9))
    start, end = closed({"start": point, "end": point})["properties"].values()
    assert start == end
    assert start["anyOf"][0] is not end["anyOf"][0]


def frame_of(family: str, image: tuple[int, int] = (640, 400), sent: tuple[int, int] = (640, 400)) -> CoordinateFrame:
    from cow_service.readers.mllm.coordinates import CoordinateFrame

    return CoordinateFrame(*image, sent, load_families()[family].coordinates)


@given(
    units=st.sampled_from(["thousandths", "fractions", "pixels"]),
    axes=st.sampled_from(["xy", "yx"]),
    form=st.sampled_from(["corners", "size"]),
    corner=st.tuples(st.integers(0, 300), st.integers(0, 200)),
    sides=st.tuples(st.integers(20, 300), st.integers(20, 180)),
)
def test_a_box_is_read_as_it_is_written(
    units: Any, axes: Any, form: Any, corner: tuple[int, int], sides: tuple[int, int]
) -> None:
    from cow_service.readers.mllm.coordinates import CoordinateFrame

    frame = CoordinateFrame(640, 400, (640, 400), Coordinates(units=units, axes=axes, box_form=form))
    box = (*corner, corner[0] + sides[0], corner[1] + sides[1])
    assert frame.bbox(frame.write_box(box)) == pytest.approx(box, abs=1.0)
    assert ("width" in frame.box_order) is (form == "size")


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
    place, way = found.reading.grounding, found.reading.motion
    if way is None:
        assert place is not None
        return {"bbox": place.bbox, "point": place.point}
    if way.direction is None:
        return {"error": "cannot-read-direction"}
    if way.depth:
        return {"camera": "towards" if way.depth < 0 else "away"}
    length = math.hypot(*way.direction)
    return {"direction": (way.direction[0] / length, way.direction[1] / length), "cue": way.cue}


def box_of(found: ReadResult) -> Any:
    assert found.reading.grounding is not None
    return found.reading.grounding.bbox


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


# Where things are, and which way


def read(mover: dict[str, Any], others: object = (), targets: tuple[str, ...] = ("vase",), **motion: Any) -> ReadResult:
    """What is read of a reply that gives a mover, others and a motion."""
    from cow_service.readers.mllm.locate import read_located

    reply = {"reasoning": "r", **mover, "others": others, **LINE, **motion}
    return usable(lambda: read_located(json.dumps(reply), frame_of("qwen3-vl"), "red ball", targets, True, True))


VALUES = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=12), st.sampled_from(["1 m", "up"])
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=4,
)


@given(fields=st.dictionaries(st.sampled_from(["size", "shape", "depth_degrees", "speed", "cue", "complete"]), VALUES))
def test_nothing_that_is_not_asked_moves_the_box_or_the_line(fields: dict[str, Any]) -> None:
    found = read(BALL | fields, [VASE | fields])
    assert (box_of(found), len(found.reading.objects)) == (box_of(read(BALL)), 1)
    assert found.reading.motion is not None
    assert found.reading.motion.direction == pytest.approx((236.8, 0))


@pytest.mark.parametrize(
    ("said", "along", "camera", "cue"),
    [
        ({"sense": "with"}, True, None, "arrow"),
        ({"sense": "against the arrow"}, False, None, "arrow"),
        ({"sense": "trail"}, None, None, "trail"),
        ({"sense": None}, None, None, None),
        ({"sense": "toward the camera", "direction": [230, 500, 230, 900]}, None, "towards", None),
        ({"sense": "away", "direction": None}, None, "away", None),
        ({"cue": "arrow", "along_arrow": False, "camera": "neither"}, False, None, "arrow"),  # as it was asked before
        ({"camera": "towards", "direction": None}, None, "towards", None),
    ],
)
def test_the_sense_is_a_word(said: dict[str, Any], along: bool | None, camera: str | None, cue: str | None) -> None:
    line = read(BALL, **({"cue": None} if "sense" in said else {}), **said).reading.motion
    assert line is not None
    assert (line.along_arrow, line.cue) == (along, cue)
    assert (line.depth < 0, line.depth > 0) == (camera == "towards", camera == "away")


@pytest.mark.parametrize(
    ("written", "metres"), [("0.3", 0.3), ("30 cm", 0.3), ("0.3 metres", 0.3), ("5mm", 0.005), (1, 1.0), (None, None)]
)
def test_a_size_is_a_number_in_metres(written: object, metres: float | None) -> None:
    from cow_service.readers.mllm.locate import read_scale

    assert read_scale(json.dumps({"metres": written, "down": "Left"})).metres == metres
    assert read_scale(json.dumps({"metres": written, "down": "Left"})).down == (-1, 0)


@pytest.mark.parametrize("written", [3000, 0, -1, 10**400, True, "3 km", [0.1, 0.2], "large"])
def test_a_size_that_cannot_be_is_asked_for_again(written: object) -> None:
    from cow_service.readers.mllm.locate import read_scale
    from cow_service.readers.mllm.replies import ReplyError

    with pytest.raises(ReplyError, match="`metres`"):
        read_scale(json.dumps({"metres": written, "down": "bottom"}))


# What is around


@pytest.mark.parametrize("family", ["qwen3-vl", "qwen2.5-vl", "gemini", "claude", "gpt"])
def test_boxes_of_targets_and_obstacles_in_every_convention(family: str) -> None:
    from cow_service.readers.mllm.locate import read_located

    frame = frame_of(family, sent=(320, 200))
    key = frame.coordinates.box
    boxes = {"red ball": (64, 160, 128, 240), "the blue mug": (320, 120, 384, 240), "box": (448, 80, 512, 240)}
    written = {name: frame.write((box[0], box[1]), (box[2], box[3])) for name, box in boxes.items()}
    reply = json.dumps(
        {"objects": [{key: written[name], "label": name} for name in ("red ball", "box", "the blue mug")]}
    )
    found = read_located(reply, frame, "red ball", ("blue mug",), True, False)
    assert found is not None
    assert [(other.object, other.role) for other in found.reading.objects] == [
        ("blue mug", "target"),
        ("box", "obstacle"),
    ]
    places = (box_of(found), *(other.bbox for other in found.reading.objects))
    for place, wanted in zip(places, ("red ball", "the blue mug", "box"), strict=True):
        assert place == pytest.approx(boxes[wanted], abs=2)


def test_targets_are_known_by_their_words() -> None:
    mug, other_mug = {"label": "mug", "bbox_2d": [1, 1, 90, 90]}, {"label": "red mug", "bbox_2d": [300, 1, 390, 90]}
    found = read(BALL, [other_mug, mug, VASE], targets=("the blue mug", "vase"))
    roles = [(other.object, other.role) for other in found.reading.objects]
    assert roles == [("the blue mug", "target"), ("vase", "target"), ("red mug", "obstacle")]
    unsure = read(BALL, [other_mug, {"label": "green mug", "bbox_2d": [1, 1, 90, 90]}], targets=("mug",))
    assert {other.role for other in unsure.reading.objects} == {"obstacle"}


def test_what_is_no_object_is_left_out() -> None:
    bad = {"label": "lamp", "bbox_2d": [500, 400, 500, 400]}
    wall = {"label": "wall", "bbox_2d": [0, 0, 1000, 1000]}
    ground = {"label": "the floor", "bbox_2d": [0, 500, 1000, 1000]}
    found = read(BALL, [bad, wall, ground, VASE, {"label": "cat", "bbox_2d": None}, 3, "cup"])
    assert [other.object for other in found.reading.objects] == ["vase"]
    assert all(sum(name in warning for warning in found.warnings) == 1 for name in ("'3'", "'cup'", "'lamp'", "'wall'"))
    assert len(found.warnings) == 4


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
    assert [(other.object, other.role) for other in found.reading.objects] == IN_THE_WAY
    assert found.reading.objects_complete
    assert found.reading.motion is not None


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
    assert read(BALL, **others).reading.objects_complete is complete


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
def test_a_direction_is_two_named_points(family: str) -> None:
    from cow_service.readers.mllm.locate import read_located

    frame = frame_of(family, sent=(320, 200))
    line = {"start": frame.write((100, 300)), "end": frame.write((400, 100)), "sense": None}
    found = read_located(json.dumps(line), frame, "red ball", (), False, True)
    assert found is not None
    assert found.reading.motion is not None
    assert found.reading.motion.direction == pytest.approx((300, -200), abs=4)


@pytest.mark.parametrize(
    ("labels", "first"),
    [
        (("red ball", "vase"), 0),
        (("vase", "red ball"), 1),  # its words tell it, wherever it stands
        (("ball", "red vase"), 0),
        (("toy", "vase"), 0),  # no words do: it was to come first
        (("ball", "ball"), 0),
    ],
)
def test_what_moves_is_known_by_its_words_else_it_comes_first(labels: tuple[str, str], first: int) -> None:
    from cow_service.readers.mllm.locate import read_located

    boxes = ([172, 400, 297, 600], [700, 300, 800, 600])
    reply = {"objects": [{"bbox_2d": box, "label": label} for box, label in zip(boxes, labels, strict=True)]}
    found = read_located(json.dumps(reply), frame_of("qwen3-vl"), "red ball", (), True, False)
    assert found is not None
    assert box_of(found) == frame_of("qwen3-vl").bbox(boxes[first])
    assert [each.object for each in found.reading.objects] == [labels[1 - first]]


def test_of_two_lists_neither_comes_first() -> None:
    from cow_service.readers.mllm.locate import read_located
    from cow_service.readers.mllm.replies import ReplyError

    drafts = [json.dumps({"objects": [BALL | {"bbox_2d": [172 + off, 400, 297 + off, 600]}, VASE]}) for off in (30, 0)]
    with pytest.raises(ReplyError, match="give one box"):
        read_located("Corrected: ".join(drafts), frame_of("qwen3-vl"), "red ball", (), True, False)


def test_an_empty_list_says_that_it_is_not_there() -> None:
    from cow_service.readers.mllm.locate import read_located

    for reply in ({"objects": []}, {"objects": None, "start": None}, {"objects": [], "start": [1, 1], "end": [9, 9]}):
        assert read_located(json.dumps(reply), frame_of("qwen3-vl"), "red ball", ("vase",), True, True) is None
