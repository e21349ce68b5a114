"""What a multimodal LLM reads of a simulation before it answers: story and agreement, as a hypothesis."""

from __future__ import annotations

from typing import Any

import numpy as np
from outcomes import simulated

from cow_service.readers.base import Imagined
from cow_service.readers.options import read_choices
from cow_service.readers.prompts import load_prompt
from cow_service.records import Intervention, LocatedObject

OPTIONS = read_choices("", ["Yes", "No", "Not sure"])
MUG = {"object": "the blue mug", "bbox": (60, 20, 80, 40), "first_frame": 8}
PATH = {"states": [(0,) * 6] * 2, "points": [(1, 1)] * 2, "visible": [True] * 2, "scale": [1, 1], "tracks": []}


def prompt(removed: str | None = None, strips: bool = False, **trajectory: Any) -> str:
    """The text of the answer's prompt for a simulation with this trajectory, with something removed."""
    from cow_service.readers.mllm.answer import answer_calls

    frames = (np.zeros((4, 4, 3), np.uint8),)
    plain = {"outcome": None, "ensemble": 200, "fps": 16, "encounters": (), "encounters_known": True}
    simulation = simulated(**plain | trajectory)
    if removed is not None:
        change = Intervention(kind="remove", object=LocatedObject(object=removed, bbox=(50, 20, 60, 40)))
        grounding = simulation.grounding.model_copy(update={"interventions": (change,)})
        simulation = simulation.model_copy(update={"grounding": grounding})
    imagined = Imagined(simulation, frames, frames if strips else ())
    (call,) = answer_calls("Will it hit the cube?", OPTIONS, (b"", b""), imagined, 1, 100)
    return load_prompt(call.prompt).render(**call.inputs)


def outcome(**fields: Any) -> dict[str, Any]:
    asked = {"relation": "touches", "target": "the white cube"} | fields.pop("asked", {})
    return {"asked": asked, "object": "the white cube", "sure": True, "robust": True} | fields


def test_the_outcome_is_told_as_a_hypothesis_that_names_no_option() -> None:
    text = prompt(
        outcome=outcome(probability=0.93, robust=False, depends_on=["speed", "heading"]),
        encounters=[MUG | {"kind": "touches"}],
    )
    lines = text.splitlines()
    assert "> In 186 of 200 simulated versions it hits the white cube." in lines
    assert any(line.startswith("> It depends most on") for line in lines)
    assert any(line.startswith("> The red ball moves to the right, hits the blue mug") for line in lines), "its story"
    assert "hypothesis" in text
    told = text[text.index("The simulation came to") : text.index("- `answer`")]
    assert not any(f"({option.letter})" in told or option.text in told.split() for option in OPTIONS)


def test_encounters_are_told_where_there_is_no_outcome() -> None:
    hidden = MUG | {"kind": "occludes", "share": 0.4, "probability": 0.9}
    lines = prompt(encounters=[MUG | {"kind": "touches"}, hidden]).splitlines()
    assert "> hits the blue mug, 0.5 s in" in lines
    passes = "> passes in front of the blue mug, 0.5 s in, at most 40% covered; in 180 of 200 simulated versions"
    assert passes in lines
    assert "The simulation found nothing" in prompt()
    assert "The simulation found nothing" not in prompt(encounters_known=False)
    assert "through whatever they meet" in prompt(law="ballistic")
    assert "through whatever they meet" not in prompt()


def test_both_worlds_of_a_removal_are_told_and_named() -> None:
    as_it_is = {"fps": 16, "paths": [PATH], "anchors": [], "ensemble": 200, "outcome": outcome(probability=0.02)}
    given = {"outcome": outcome(probability=0.97), "factual": as_it_is}
    text = prompt("The vase", strips=True, **given)
    assert '"Without the vase"' in text
    assert '"As it is"' in text
    assert "strip" in text
    lines = text.splitlines()
    assert "> Without the vase: In 194 of 200 simulated versions it hits the white cube." in lines
    assert "> As it is: In 196 of 200 simulated versions it misses the white cube." in lines
    assert "strip" not in prompt("The vase", **given)
    assert "changed" not in prompt()


def test_two_worlds_are_shown_as_two_strips_of_their_frames() -> None:
    from cow_service.readers.mllm.contents import pictures

    colours = np.array([(60, 0, 200), (120, 0, 200), (180, 0, 200), (240, 0, 200)], np.uint8)  # none is a grey
    frames = tuple(np.tile(colour, (40, 60, 1)) for colour in colours)
    simulation = simulated(None)
    assert pictures(Imagined(simulation, frames)) == frames
    changed, factual = pictures(Imagined(simulation, frames, frames[::-1]))
    assert changed.shape == factual.shape
    assert (changed == colours[0]).all(axis=2).sum() == 40 * 60, "all of a frame is seen"
    first = np.argwhere((changed == colours[0]).all(axis=2))[0]
    assert ((changed == colours[1]).all(axis=2).nonzero()[1] > first[1]).all(), "in their order, from left to right"
    assert (factual[: first[0]] > 150).any(), "the name is written above"
