"""A trajectory in words, for notebooks, tools and the command line: contacts, probabilities, the outcome."""

from __future__ import annotations

from typing import Any

import pytest
from sdk import SIMULATION

from cow_service.client.display import simulation_html
from cow_service.mcp.results import simulation_text
from cow_service.records import Asked, Outcome, Simulation

NARRATION = {
    "answer": "Yes",
    "summary": "Yes, it hits the blue mug after about 1.1 s. 185 of 200 simulated versions agree.",
    "story": "The red ball bounces once and hits the blue mug after about 1.1 s.",
}


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
    "outcome": outcome(probability=0.925, object="blue mug"),
}


@pytest.fixture
def simulation() -> Simulation:
    old = Simulation.model_validate(SIMULATION)
    trajectory = old.trajectory.model_dump() | WORLD
    return Simulation.model_validate(old.model_dump() | {"trajectory": trajectory, "narration": NARRATION})


def test_a_tool_tells_contacts_probabilities_and_the_outcome(simulation: Simulation) -> None:
    text = simulation_text(simulation, "")
    for part in (
        "hits blue mug after 0.1 s (185 of 200 simulated versions)",
        *list(NARRATION.values())[1:],
        "red ball and blue mug after 1.1 s",
    ):
        assert part in text


def test_a_notebook_shows_the_same(simulation: Simulation) -> None:
    html = simulation_html(simulation, lambda _: None)
    for part in (
        "hits blue mug after 0.1 s (185 of 200 simulated versions)",
        *list(NARRATION.values())[1:],
        "Nothing moves in the image from 2.5 s on",
    ):
        assert part in html
