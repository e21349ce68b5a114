"""Prompt files: what is shipped, and how one is read and filled in."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import pytest
from drawn import floor
from jinja2.exceptions import SecurityError

from cow_service.perception.observation import look
from cow_service.readers.base import ReaderInput
from cow_service.readers.options import read_choices
from cow_service.readers.prompts import Prompt, load_prompt, parse_prompt
from cow_service.records import Asked, Grounding, MetresPerPixel, Motion, Speed
from cow_service.stages.motion import motion_sentence
from cow_service.weights.manifests import PROMPTS, load_families

if TYPE_CHECKING:
    from cow_service.readers.mllm.client import PromptCall

HEAD = "---\nversion: 1\n---\n"
SAMPLES: dict[str, object] = {  # of inputs that are no words
    "kind": "linear",
    "law": "contact",
    "shown": "image-and-facts",
    "box_key": "bbox_2d",
    "question": "If the ball moves,\nwill it hit the vase?",
    "options": read_choices("", ["Yes", "No"]),
    **dict.fromkeys(("further", "also", "others", "facts", "encounters", "objections"), ("one thing", "another")),
}


def inputs_of(prompt: Prompt) -> dict[str, object]:
    return {name: SAMPLES.get(name, f"the {name}") for name in prompt.inputs}


@pytest.mark.parametrize("name", PROMPTS.names())
def test_every_shipped_prompt_renders_its_inputs_and_no_others(name: str) -> None:
    prompt = load_prompt(name)
    assert prompt.name == name
    assert load_prompt(name) is prompt
    inputs = inputs_of(prompt)
    text = prompt.render(**inputs)
    assert text
    assert "{{" not in text
    assert "{%" not in text
    assert not any(line.endswith(" ") for line in text.splitlines())
    for each in ("question", "object", "sentence"):
        if each in inputs and name not in ("motion-sentence", "eval-question"):
            assert all(f"> {line}" in text.splitlines() for line in str(inputs[each]).splitlines()), each
    with pytest.raises(TypeError, match="extra"):
        prompt.render(**inputs, extra="x")
    for each in inputs:
        with pytest.raises(TypeError, match=each):
            prompt.render(**{key: value for key, value in inputs.items() if key != each})


def calls(family: str, question: str = "Does it go 3 cm?") -> dict[str, PromptCall[Any]]:
    """What a model of that family is asked of an image of 640 x 480 px."""
    from cow_service.readers.mllm.coordinates import CoordinateFrame, EncodedImage
    from cow_service.readers.mllm.identify import identify_call
    from cow_service.readers.mllm.locate import locate_call, scale_call

    given = ReaderInput(floor(640, 480), question, look(floor(640, 480)))
    image = EncodedImage(b"", CoordinateFrame(640, 480, (640, 480), load_families()[family].coordinates))
    made = (
        identify_call(given, image, 100),
        locate_call(given, image, "red ball", None, ("vase",), True, 100),
        scale_call(image, "red ball", 100),
    )
    return {call.prompt: call for call in made}


FAMILIES = ["qwen3-vl", "qwen2.5-vl", "gemini", "claude", "gpt"]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_prompt_asks_for_the_fields_of_its_schema_and_shows_a_reply_that_is_read_so(family: str) -> None:
    made = calls(family)
    for name, call in made.items():
        text = load_prompt(name).render(**call.inputs)
        asked, _, shown = text.rpartition("Such as: ")
        fields = set(call.schema["properties"])
        assert fields - {"reasoning"} <= set(re.findall(r"`(\w+)`", asked)), name
        assert json.loads(shown).keys() <= fields, name
        assert json.loads(shown).keys() | {"until", "then", "also_moving", "distance", "duration"} >= fields, name
    shown = {name: load_prompt(name).render(**call.inputs).rpartition("Such as: ")[2] for name, call in made.items()}
    named, found, scale = (made[name].parse(shown[name]) for name in ("identify", "locate", "scale"))
    assert (named.object, named.others, named.kind) == ("red car", ("mug", "vase"), "linear")
    assert named.asked == Asked(relation="touches", target="mug", negated=True)
    assert named.speed == Speed(value=20, unit="px/s")
    assert [(each.kind, each.object) for each in named.changes] == [("remove", "vase")]
    assert found.reading.grounding.bbox == pytest.approx((128, 240, 192, 288), abs=0.7)
    assert [(each.object, each.bbox) for each in found.reading.objects] == [
        ("vase", pytest.approx((448, 144, 512, 288), abs=0.7))
    ]
    assert found.reading.motion.direction == pytest.approx((416, 0), abs=1.4)
    assert (found.reading.motion.along_arrow, scale.metres, scale.down) == (True, 0.067, (0, 1))


def test_only_a_question_with_a_number_is_searched_for_speeds_and_lengths() -> None:
    numbers = {"speed", "distance", "duration"}
    assert calls("gpt")["identify"].schema["properties"].keys() >= numbers
    assert numbers.isdisjoint(calls("gpt", "Does it hit the vase?")["identify"].schema["properties"])


@pytest.mark.parametrize("family", FAMILIES)
def test_schemas_are_what_strict_servers_take(family: str) -> None:
    """Every object requires all its properties and forbids others; limits are refused by some servers."""

    def walk(schema: dict[str, Any], name: str) -> None:
        if schema.get("type") == "object":
            assert schema["required"] == list(schema["properties"]), name
            assert schema["additionalProperties"] is False, name
            for key, each in schema["properties"].items():
                walk(each, key)
        for each in (*schema.get("anyOf", ()), *([schema["items"]] if "items" in schema else ())):
            walk(each, name)
        limits = schema.keys() - {"type", "enum", "anyOf", "items", "properties", "required", "additionalProperties"}
        is_point = schema.get("type") == "array" and schema["items"]["type"] in ("integer", "number")
        assert limits <= ({"maxLength"} if name == "reasoning" else {"minItems", "maxItems"} if is_point else set()), (
            name
        )

    for call in calls(family).values():
        walk(call.schema, call.prompt)


def test_values_are_data_and_blocks_leave_no_blank_lines() -> None:
    prompt = parse_prompt("p", HEAD + "Hello {{ name }}")
    value = "{{ 7 * 7 }} {% if %} <b> & {# no #}"
    assert prompt.render(name=value) == f"Hello {value}"
    assert parse_prompt("p", HEAD + "a\n{% if name %}\nb\n{% endif %}\nc").render(name=1) == "a\nb\nc"
    with pytest.raises(TypeError, match="nme"):
        prompt.render(nme="x")


@pytest.mark.parametrize(("body", "value"), [("{{ name.__class__.__mro__ }}", "x"), ("{{ name.append(1) }}", [])])
def test_a_body_is_sandboxed(body: str, value: object) -> None:
    with pytest.raises(SecurityError):
        parse_prompt("p", HEAD + body).render(name=value)


@pytest.mark.parametrize("head", ["- a", "version: 1\nother: 2", "version: true", None])
def test_a_file_without_a_whole_number_as_its_version_is_no_prompt(head: str | None) -> None:
    with pytest.raises(ValueError, match="'p'"):
        parse_prompt("p", "Hello" if head is None else f"---\n{head}\n---\nHello")


def test_the_sentence_of_a_motion_is_one_line_that_names_the_object_and_says_what_stops_it() -> None:
    ball = Grounding(object="the orange\n ball", point=(5, 5), bbox=(0, 0, 10, 10), source="request")
    scale = MetresPerPixel(value=0.01, source="default")
    motion = Motion(
        kind="linear", law="contact", direction=(1.0, 0.0), cue="text", speed=9, metres_per_pixel=scale, sentence="",
        source="request",
    )  # fmt: skip
    for kind in ("linear", "projectile", "fall", "static"):
        sentence = motion_sentence(motion.model_copy(update={"kind": kind}), ball)
        assert sentence.startswith("The orange ball ")
        assert len(sentence.splitlines()) == 1
        assert "constant speed" not in sentence
    ballistic = motion_sentence(motion.model_copy(update={"law": "ballistic"}), ball)
    assert "constant speed" in ballistic, "nothing stops it"
