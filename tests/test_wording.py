"""A trajectory in words, for notebooks, tools and the command line: contacts, probabilities, the outcome."""

from __future__ import annotations

from typing import Any

import pytest
from sdk import SIMULATION

from cow_service.client.display import outcome_words, simulation_html
from cow_service.mcp.results import simulation_text
from cow_service.records import Asked, Outcome, Simulation

FACTS = "The red ball bounces once and meets the blue mug after 1.1 s"


def body(name: str) -> dict[str, Any]:
    place = {"size": [0.1, 0.1, 0.1], "position": [0, 0, 2], "support": "floor", "source": "embedded", "confidence": 1}
    return {"object": name, "bbox": [5, 5, 15, 15], "shape": "sphere", **place}


def outcome(**given: Any) -> Outcome:
    return Outcome.model_validate({"asked": Asked(relation="touches"), "sure": True, "robust": True} | given)


WORLD = {
    "law": "contact",
    "bodies": [body("red ball"), body("blue mug")],
    "contacts": [
        {"a": 0, "b": None, "time": 0, "point": [1, 1], "impulse": 0},
        {"a": 0, "b": 1, "time": 1.125, "point": [9, 9], "impulse": 0.4},
    ],
    "encounters": [
        {"object": "blue mug", "bbox": [20, 5, 30, 15], "first_frame": 1, "kind": "touches", "probability": 0.925}
    ],
    "ensemble": 200,
    "moving_until": 2.5,
    "outcome": outcome(probability=0.925, object="blue mug", facts=FACTS, depends_on=("speed", "heading")),
}


@pytest.fixture
def simulation() -> Simulation:
    old = Simulation.model_validate(SIMULATION)
    trajectory = old.trajectory.model_dump() | WORLD
    return Simulation.model_validate(old.model_dump() | {"trajectory": trajectory})


def test_a_tool_tells_contacts_probabilities_and_the_outcome(simulation: Simulation) -> None:
    text = simulation_text(simulation, "")
    for part in ("92% of the worlds", FACTS, "it depends on speed and heading", "red ball and blue mug at 1.1 s"):
        assert part in text


def test_a_notebook_shows_the_same(simulation: Simulation) -> None:
    html = simulation_html(simulation, lambda _: None)
    for part in ("touches blue mug at 0.1 s (92% of the worlds)", FACTS, "Nothing moves in the image from 2.5 s on"):
        assert part in html


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"probability": 0.97}, "what is asked happens in 97% of the worlds; robust"),
        ({"sure": False, "robust": False, "depends_on": ("camera",)}, "not sure; it depends on camera"),
        ({"asked": Asked(form="which-first", relation="touches"), "first": "mug"}, "first: mug; robust"),
        (
            {"asked": Asked(form="how-many", relation="touches"), "count": 2, "probability": 0.8},
            "count: 2, 80% of the worlds",
        ),
        (
            {"asked": Asked(form="when", relation="touches"), "time": 1.13, "time_band": (0.9, 1.4)},
            "after 1.1 s (0.9 to 1.4 s)",
        ),
    ],
)
def test_an_outcome_in_words(given: dict[str, Any], told: str) -> None:
    assert outcome_words(outcome(**given)).startswith(told)
