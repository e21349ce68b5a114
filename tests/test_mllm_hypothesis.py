"""The description of a simulation in an MLLM's prompt: the embedded reader's facts, as a hypothesis."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cow_service.readers.base import Imagined
from cow_service.readers.mllm.answer import answer_calls
from cow_service.readers.mllm.hypothesis import pictures
from cow_service.readers.options import read_choices
from cow_service.readers.prompts import load_prompt
from cow_service.records import Intervention, LocatedObject, Simulation

SHA = "0" * 64
OPTIONS = read_choices("", ["Yes", "No", "Not sure"])
FACTS = "The ball bounces once and meets\nthe white cube after 1.1 s."
MUG = {"object": "the blue mug", "bbox": (60, 20, 80, 40), "first_frame": 8}


def simulated(**trajectory: Any) -> Simulation:
    """A simulation with this trajectory."""
    image = {"sha256": SHA, "url": f"/artifacts/{SHA}", "media_type": "image/png", "size": 1}
    path = {"states": [(0,) * 6] * 2, "points": [(1, 1)] * 2, "visible": [True] * 2, "scale": [1, 1], "tracks": []}
    return Simulation.model_validate(
        {
            "id": "x", "created_at": "", "question": "q", "frames": (), "video": None, "overlay": image,
            "image": {"sha256": SHA, "width": 96, "height": 64},
            "grounding": {"object": "the ball", "point": (1, 1), "bbox": (0, 0, 9, 9), "source": "mllm"},
            "motion": {
                "kind": "linear", "direction": (1, 0), "cue": "text", "speed": 10, "sentence": "The ball rolls.",
                "metres_per_pixel": {"value": 0.01, "source": "default"}, "source": "mllm",
            },
            "trajectory": {"law": "contact", "fps": 16, "paths": [path], "anchors": [], "ensemble": 200} | trajectory,
            "generator": {"name": "cutout", "seed": 0}, "reader": {"name": "mllm"}, "timings": {},
        }
    )  # fmt: skip


def prompt(removed: str | None = None, strips: bool = False, **trajectory: Any) -> str:
    """The text of the answer's prompt for a simulation with this trajectory, with something removed."""
    simulation, frames = simulated(**trajectory), (np.zeros((4, 4, 3), np.uint8),)
    if removed is not None:
        change = Intervention(kind="remove", object=LocatedObject(object=removed, bbox=(50, 20, 60, 40)))
        grounding = simulation.grounding.model_copy(update={"interventions": (change,)})
        simulation = simulation.model_copy(update={"grounding": grounding})
    imagined = Imagined(simulation, frames, frames if strips else ())
    (call,) = answer_calls("Will it hit the cube?", OPTIONS, (b"", b""), imagined, 1, 100)
    return load_prompt(call.prompt).render(**call.inputs)


def outcome(**fields: Any) -> dict[str, Any]:
    asked = {"relation": "touches", "target": "the white cube"} | fields.pop("asked", {})
    return {"asked": asked, "object": "the white cube", "sure": True, "robust": True, "facts": FACTS} | fields


def test_the_outcome_is_told_as_a_hypothesis() -> None:
    text = prompt(
        outcome=outcome(probability=0.93, robust=False, depends_on=["speed", "heading"]),
        encounters=[MUG | {"kind": "touches"}],
    )
    lines = text.splitlines()
    assert "> The ball bounces once and meets the white cube after 1.1 s." in lines
    assert "> In 93% of 200 computed worlds: the ball touches the white cube." in lines
    assert "> It depends most on how fast it moves, which way it heads in depth." in lines
    assert "blue mug" not in text
    assert "a computed hypothesis about the first image" in text
    assert "It can be wrong" in text
    told = text[text.index("The simulation came to") : text.index("- `answer`")]
    assert not any(f"({option.letter})" in told or option.text in told.split() for option in OPTIONS)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"asked": {"negated": True}}, "the ball does not touch the white cube."),
        ({"asked": {"relation": "covers", "negated": True}}, "the ball does not hide the white cube."),
        ({"asked": {"relation": "covered"}}, "the ball is hidden by the white cube."),
        ({"asked": {"target": None}, "object": None}, "the ball touches something."),
        ({"asked": {"target": None, "negated": True}, "object": None}, "the ball does not touch anything."),
        ({"asked": {"form": "which-first"}, "first": "red\nbox"}, "the first thing that the ball touches is red box."),
        ({"asked": {"form": "which-first"}}, "the first thing that the ball touches is nothing."),
        ({"asked": {"form": "how-many"}, "count": 2}, "the number of things that the ball touches is 2."),
        ({"asked": {"form": "when"}, "time": 1.1, "time_band": (0.9, 1.4)}, "first after 1.10 s (0.90 to 1.40 s"),
    ],
)
def test_every_form_of_question_is_put_in_words(fields: dict[str, Any], told: str) -> None:
    text = prompt(outcome=outcome(probability=0.5, **fields))
    (line,) = [line for line in text.splitlines() if line.startswith("> In 50% of 200 computed worlds: ")]
    assert told in line
    assert "depends" not in text


def test_encounters_are_told_where_there_is_no_outcome() -> None:
    hidden = MUG | {"kind": "occludes", "share": 0.4, "probability": 0.9}
    text = prompt(encounters=[MUG | {"kind": "touches"}, hidden])
    assert "> touches the blue mug, 0.50 s in" in text.splitlines()
    line = "> passes in front of the blue mug, 0.50 s in, at most 40% covered; in 90% of 200 computed worlds"
    assert line in text.splitlines()
    assert "a computed hypothesis" in text
    assert "The simulation found nothing" in prompt()
    assert "The simulation found nothing" not in prompt(encounters_known=False)
    assert "The simulation found nothing" in prompt(outcome=outcome(facts=""))  # an outcome that tells nothing


def test_a_law_without_contacts_is_told() -> None:
    assert "move on through whatever they meet" in prompt(law="ballistic")
    assert "move on through whatever they meet" not in prompt()


def test_both_worlds_of_a_removal_are_told_and_named() -> None:
    path = {"states": [(0,) * 6] * 2, "points": [(1, 1)] * 2, "visible": [True] * 2, "scale": [1, 1], "tracks": []}
    as_it_is = {"fps": 16, "paths": [path], "anchors": [], "ensemble": 200, "outcome": outcome(probability=0.02)}
    given = {"outcome": outcome(probability=0.97), "factual": as_it_is}
    text = prompt("The vase", strips=True, **given)
    assert 'first strip, named "With the vase removed"' in text
    assert 'named "As it is"' in text
    lines = text.splitlines()
    told = "in 97% of 200 computed worlds: the ball touches the white cube."
    assert f"> With the vase removed, {told}" in lines
    assert f"> As it is, {told.replace('97', '2')}" in lines
    without_strips = prompt("The vase", **given)
    assert 'changed from the beginning: "With the vase removed"' in without_strips
    assert "strip" not in without_strips
    assert "changed" not in prompt()


def test_two_worlds_are_shown_as_two_strips_of_their_frames() -> None:
    colours = np.array([(60, 0, 200), (120, 0, 200), (180, 0, 200), (240, 0, 200)], np.uint8)  # none is a grey
    frames = tuple(np.tile(colour, (40, 60, 1)) for colour in colours)
    simulation = simulated()
    assert pictures(Imagined(simulation, frames)) == frames
    changed, factual = pictures(Imagined(simulation, frames, frames[::-1]))
    assert changed.shape == factual.shape
    assert (changed == colours[0]).all(axis=2).sum() == 40 * 60, "all of a frame is seen"
    first = np.argwhere((changed == colours[0]).all(axis=2))[0]
    assert ((changed == colours[1]).all(axis=2).nonzero()[1] > first[1]).all(), "in their order, from left to right"
    assert (factual[: first[0]] > 150).any(), "the name is written above"
