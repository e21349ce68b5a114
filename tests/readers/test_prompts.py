"""Prompt files, and the sentence that says a motion."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jinja2.exceptions import SecurityError

from cow_service.narration.words import direction_words
from cow_service.readers.mllm.answer import answer_schema
from cow_service.readers.mllm.coordinates import CoordinateFrame
from cow_service.readers.mllm.identify import Identified
from cow_service.readers.mllm.locate import Scale, locate_schema
from cow_service.readers.mllm.replies import schema_of
from cow_service.readers.options import read_choices
from cow_service.readers.prompts import load_prompt, parse_prompt
from cow_service.records import MotionKind, Vector
from cow_service.stages.motion import motion_sentence
from cow_service.weights.manifests import PROMPTS, Coordinates

HEAD = "---\nversion: 1\n---\n"


@pytest.mark.parametrize("name", PROMPTS.names())
def test_every_shipped_prompt_loads(name: str) -> None:
    prompt = load_prompt(name)
    assert prompt.name == name
    assert prompt.version >= 1
    assert prompt.body
    assert load_prompt(name) is prompt


def test_fields() -> None:
    prompt = load_prompt("motion-sentence")
    assert prompt.version == 4
    assert prompt.inputs == {"object", "kind", "law", "words", "sentence", "further", "stops", "also"}


SAMPLES: dict[str, object] = {
    "object": "red ball",
    "kind": "linear",
    "words": "to the left",
    "further": ("down",),
    "stops": True,
    "also": ("car moves up",),
    "question": "If the ball moves,\nwill it hit the vase?",
    "others": ("blue vase",),
    "bbox": "[1, 2, 3, 4]",
    "units": "integers from 0 to 1000",
    "box_key": "bbox_2d",
    "box_order": "[x0, y0, x1, y1]",
    "line_order": "[x0, y0, x1, y1]",
    "wants_box": True,
    "wants_direction": True,
    "max_obstacles": 8,
    "options": read_choices("", ["Yes", "No"]),
    "sentence": "The ball moves.",
    "times": "0.06 s",
    "law": "contact",
    "changed": "With the vase removed",
    "as_it_is": "As it is",
    "shown": "image-and-facts",
    "facts": ("The ball touches the vase after 0.5 s.",),
    "encounters_known": True,
    "encounters": ("touches the vase, 0.5 s in",),
}


@pytest.mark.parametrize("name", PROMPTS.names())
def test_every_shipped_prompt_renders_its_inputs_and_no_others(name: str) -> None:
    prompt = load_prompt(name)
    inputs = {each: SAMPLES[each] for each in prompt.inputs}
    text = prompt.render(**inputs)
    assert "{{" not in text
    assert "{%" not in text
    assert not any(line.endswith(" ") for line in text.splitlines())
    for each in ("question", "object", "sentence"):
        if each in inputs and name not in ("motion-sentence", "eval-question"):
            assert all(f"> {line}" in text.splitlines() for line in str(inputs[each]).splitlines()), each
    with pytest.raises(TypeError, match="not used: extra"):
        prompt.render(**inputs, extra="x")
    for each in inputs:
        with pytest.raises(TypeError, match=f"missing: {each}"):
            prompt.render(**{key: value for key, value in inputs.items() if key != each})


FRAME = CoordinateFrame(640, 480, (640, 480), Coordinates(units="thousandths"))
SCHEMAS = {
    "identify": schema_of(Identified, reasoning_length=100),
    "locate": locate_schema(FRAME, True, True, 100),
    "scale": schema_of(Scale, reasoning_length=100, numbers=FRAME.numbers),
    "answer-from-image": answer_schema(read_choices("", ["Yes", "No"]), 100),
    "answer-with-frames": answer_schema(read_choices("", ["Yes", "No"]), 100),
}


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in PROMPTS.names()
        if name not in {"looking", "motion-sentence", "imagined-frames", "imagined-facts", "eval-question"}
        and not name.startswith("tool")
    ],
)
def test_a_prompt_shows_the_fields_of_its_schema(name: str) -> None:
    prompt = load_prompt(name)
    text = prompt.render(**{each: SAMPLES[each] for each in prompt.inputs})
    shape = text.splitlines()[-1]
    fields = list(SCHEMAS[name]["properties"])
    places = [shape.index(f'"{field}"') for field in fields]
    assert places == sorted(places), "the shape names the fields in the schema's order"
    assert fields[0] == "reasoning"


def test_unknown_prompt_names_those_that_exist() -> None:
    with pytest.raises(LookupError, match="motion-sentence"):
        load_prompt("no-such-prompt")


@pytest.mark.parametrize(
    ("inputs", "named"),
    [
        ({}, "missing: name"),
        ({"name": "x", "colour": "red"}, "not used: colour"),
        ({"nme": "x"}, "missing: name; not used: nme"),
    ],
)
def test_inputs_are_checked(inputs: dict[str, str], named: str) -> None:
    with pytest.raises(TypeError, match=named):
        parse_prompt("p", HEAD + "Hello {{ name }}").render(**inputs)


def test_values_are_data() -> None:
    prompt = parse_prompt("p", HEAD + "Hello {{ name }}")
    value = "{{ 7 * 7 }} {% if %} <b> & {# no #}"
    assert prompt.render(name=value) == f"Hello {value}"


def test_blocks_leave_no_blank_lines() -> None:
    assert parse_prompt("p", HEAD + "a\n{% if name %}\nb\n{% endif %}\nc").render(name=1) == "a\nb\nc"


def test_body_is_sandboxed() -> None:
    with pytest.raises(SecurityError):
        parse_prompt("p", HEAD + "{{ name.__class__.__mro__ }}").render(name="x")
    with pytest.raises(SecurityError):
        parse_prompt("p", HEAD + "{{ name.append(1) }}").render(name=[])


@pytest.mark.parametrize(
    "text",
    [
        "Hello",
        "---\nversion: 1\n",
        "---\n- a\n---\nHello",
        "---\nversion: 1\nother: 2\n---\nHello",
        HEAD.replace("version: 1", "version: one"),
        HEAD.replace("version: 1", "version: true"),
    ],
)
def test_malformed_prompts(text: str) -> None:
    with pytest.raises(ValueError, match="'p' does not begin with `version: <number>`"):
        parse_prompt("p", text)


@pytest.mark.parametrize(
    ("degrees", "words"),
    [
        (0, "to the right"),
        (22.5, "to the right and slightly up"),
        (45, "to the right and up"),
        (67.5, "up and slightly to the right"),
        (90, "up"),
        (112.5, "up and slightly to the left"),
        (135, "up and to the left"),
        (180, "to the left"),
        (202.5, "to the left and slightly down"),
        (-90, "down"),
        (-45, "down and to the right"),
        (-11, "to the right"),
    ],
)
def test_direction_words(degrees: float, words: str) -> None:
    angle = math.radians(degrees)
    assert direction_words((math.cos(angle), -math.sin(angle)), 0.0) == words


@pytest.mark.parametrize(
    ("direction", "depth", "words"),
    [
        (None, 0.0, ""),
        ((0.0, 0.0), 0.0, ""),
        ((math.nan, 1.0), 0.0, ""),
        (None, -1.0, "towards the camera"),
        (None, 0.7, "away from the camera"),
        ((1.0, 0.0), 1.0, "away from the camera"),
        ((1.0, 0.0), -0.7, "to the right and towards the camera"),
        ((9.0, 0.0), 0.1, "to the right"),
    ],
)
def test_direction_words_with_depth(direction: Vector | None, depth: float, words: str) -> None:
    assert direction_words(direction, depth) == words


@pytest.mark.parametrize(
    ("kind", "direction", "words"),
    [
        ("linear", (1.0, 0.0), "sets off to the right"),
        ("linear", None, "sets off in a straight line"),
        ("projectile", (0.0, -1.0), "is thrown up and flies on a curved path, pulled down by gravity"),
        ("fall", None, "falls straight down, faster and faster, pulled down by gravity"),
        ("static", None, "stays where it is and does not move"),
    ],
)
def test_motion_sentence(kind: MotionKind, direction: Vector | None, words: str) -> None:
    sentence = motion_sentence("the orange\n ball", kind, "contact", direction, 0.0)
    assert sentence == f"The orange ball {words}. The camera stays still."


def test_only_what_nothing_stops_moves_at_a_constant_speed() -> None:
    sentence = motion_sentence("ball", "linear", "ballistic", (1.0, 0.0), 0.0)
    assert sentence == "The ball moves straight to the right at a constant speed. The camera stays still."


@settings(deadline=None)
@given(st.text(), st.sampled_from(["linear", "projectile", "fall", "static"]))
def test_motion_sentence_is_one_line_of_bounded_length(name: str, kind: MotionKind) -> None:
    sentence = motion_sentence(name, kind, "contact", (1.0, 0.0), 0.0)
    assert len(sentence.splitlines()) == 1
    assert len(sentence) < 350
    assert sentence.endswith("The camera stays still.")
