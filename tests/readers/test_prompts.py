"""Prompt files: what is shipped, and how one is read and filled in."""

from __future__ import annotations

import pytest
from jinja2.exceptions import SecurityError

from cow_service.readers.options import read_choices
from cow_service.readers.prompts import Prompt, load_prompt, parse_prompt
from cow_service.stages.motion import motion_sentence
from cow_service.weights.manifests import PROMPTS, Coordinates

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


def test_a_prompt_shows_the_fields_of_its_schema_in_their_order() -> None:
    from cow_service.readers.mllm.answer import answer_schema
    from cow_service.readers.mllm.coordinates import CoordinateFrame
    from cow_service.readers.mllm.identify import Identified
    from cow_service.readers.mllm.locate import Scale, locate_schema
    from cow_service.readers.mllm.replies import schema_of

    frame = CoordinateFrame(640, 480, (640, 480), Coordinates(units="thousandths"))
    answer = answer_schema(read_choices("", ["Yes", "No"]), 100)
    schemas = {
        "identify": schema_of(Identified, reasoning_length=100),
        "locate": locate_schema(frame, True, True, 100),
        "scale": schema_of(Scale, reasoning_length=100, numbers=frame.numbers),
        "answer-from-image": answer,
        "answer-with-frames": answer,
    }
    for name, schema in schemas.items():
        prompt = load_prompt(name)
        shape = prompt.render(**inputs_of(prompt)).splitlines()[-1]
        fields = list(schema["properties"])
        places = [shape.index(f'"{field}"') for field in fields]
        assert places == sorted(places), name
        assert fields[0] == "reasoning"


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
    for kind in ("linear", "projectile", "fall", "static"):
        sentence = motion_sentence("the orange\n ball", kind, "contact", (1.0, 0.0), 0.0)
        assert sentence.startswith("The orange ball ")
        assert len(sentence.splitlines()) == 1
        assert "constant speed" not in sentence
    assert "constant speed" in motion_sentence("ball", "linear", "ballistic", (1.0, 0.0), 0.0), "nothing stops it"
