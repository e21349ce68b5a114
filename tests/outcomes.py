"""Outcomes of a simulation, and simulations that hold nothing else."""

from __future__ import annotations

from typing import Any

from sdk import SIMULATION

from cow_service.narration.summary import narrate
from cow_service.records import Asked, AskedForm, CandidateOutcome, Outcome, Simulation, Trajectory

HIT = Asked(relation="touches", target="vase")
MISS = Asked(relation="touches", target="vase", negated=True)
FIRST, COUNT = Asked(form="which-first", relation="touches"), Asked(form="how-many", relation="touches")
WHEN = Asked(form="when", relation="touches", target="vase")


def outcome(asked: Asked, probability: float | None = 0.95, **values: Any) -> Outcome:
    found: dict[str, Any] = {"object": asked.target, "sure": True, "robust": True}
    return Outcome(asked=asked, probability=probability, **(found | values))


def of_each(form: AskedForm, among: bool = True, as_it_is: float | None = None, **meant: bool) -> Outcome:
    """What is so of candidates, named with underscores."""
    names = {name.replace("_", " "): 0.9 if is_meant else 0.1 for name, is_meant in meant.items()}
    candidates = tuple(CandidateOutcome(object=name, probability=share, sure=True) for name, share in names.items())
    asked = Asked(form=form, relation="touches", among=tuple(names) if among else ())
    return outcome(asked, candidates=candidates, as_it_is=as_it_is)


ONE = of_each("which", cardboard_box=True, basketball=False)
BOTH, NEITHER = of_each("which", red_box=True, blue_box=True), of_each("which", red_box=False, blue_box=False)
WITHOUT = of_each("which-to-remove", False, 0.95, vase=True, red_box=True, duck=False)
NEEDLESS = of_each("which-to-remove", True, 0.04, red_box=True, duck=True)
YES, NO = outcome(HIT), outcome(HIT, 0.03)
AT = outcome(WHEN, time=1.1, time_band=(1.0, 1.3))
CHOICES: list[tuple[Outcome, list[str], str | None]] = [
    (YES, ["Yes", "No", "Not sure"], "A"),
    (NO, ["Yes", "No", "Not sure"], "B"),
    (YES, ["No, it misses", "Yes, it hits"], "B"),
    (YES, ["Yes", "No"], "A"),
    (YES, ["the vase", "the mug"], None),
    (YES, ["Yes, at once", "Yes, later", "No"], None),
    (NO, ["Yes", "No", "No idea, not sure"], "B"),
    (YES, ["It hits the vase", "It misses the vase"], "A"),
    (NO, ["It hits the vase", "It misses the vase"], "B"),
    (NO, ["Hit", "Miss"], "B"),
    (NO, ["It will", "It won't"], "B"),
    (NO, ["The red ball touches the vase", "The red ball doesn't touch it"], "B"),
    (NO, ["Collision", "No collision"], "B"),
    (YES, ["It hits the vase", "It hits the mug"], "A"),
    (NO, ["It hits the vase", "It hits nothing"], None),
    (NO, ["It hits the vase", "It flies over the vase"], None),
    (outcome(MISS), ["Yes", "No"], "A"),
    (outcome(MISS), ["It hits the vase", "It misses the vase"], "B"),
    (outcome(MISS), ["Contact", "No contact"], "B"),
    (outcome(Asked(relation="covers", target="vase")), ["Visible", "Hidden"], "B"),
    (outcome(Asked(relation="covers", target="vase", negated=True)), ["It stays visible", "It is hidden"], "A"),
    (outcome(Asked(relation="covers", target="vase")), ["The mug is hidden", "No"], None),
    (outcome(Asked(relation="touches"), 0.1, object=None), ["It hits something", "It hits nothing"], "B"),
    (outcome(FIRST, first="red cube"), ["The red cube", "The blue mug", "Neither"], "A"),
    (outcome(FIRST, first="red object"), ["the blue cube", "the red cube", "none"], "B"),
    (outcome(FIRST, first="grey cone"), ["the gray cone", "the grey cube"], "A"),
    (outcome(FIRST, first="cube"), ["the red cube", "the blue cube"], None),
    (outcome(FIRST, first="green cone"), ["the red cube", "the blue mug", "none of them"], None),
    (outcome(FIRST, first="red cube"), ["the red cube", "the blue mug", "both"], None),
    (outcome(FIRST), ["the red cube", "It hits nothing"], "B"),
    (AT, ["1 s", "2 s", "3 s", "never"], "A"),
    (AT, ["about 2 seconds", "about one second"], "B"),
    (AT, ["less than 1 second", "between 1 and 2 seconds", "more than 2 s"], None),
    (AT, ["0-0.5 s", "0.5 to 1.5 s", "over 1.5 s"], "B"),
    (AT, ["500 ms", "1,5 s"], None),
    (AT, ["after half a second", "after two seconds"], None),
    (AT, ["soon", "late"], None),
    (outcome(WHEN, 0.04, time=0.9), ["1 s", "It never hits it"], "B"),
    (outcome(COUNT, count=2), ["one", "two", "three or more"], "B"),
    (outcome(COUNT, count=4), ["1", "2 objects", "three or more"], "C"),
    (outcome(COUNT, count=0), ["none", "1", "2"], "A"),
    (outcome(COUNT, count=2), ["1-2", "2-3"], None),
    (outcome(COUNT, count=2), ["1", "2-3"], "B"),
    (outcome(COUNT, count=3), ["1-2", "3"], "B"),
    (outcome(HIT, 0.7, sure=False), ["Yes", "No"], None),
    (ONE, ["only the cardboard box", "only the basketball", "both", "neither", "Not sure"], "A"),
    (ONE, ["The basketball", "The cardboard box"], "B"),
    (ONE, ["Just the ball", "Both of them", "The box alone", "None of them"], "C"),
    (ONE, ["the mug", "the basketball"], None),
    (BOTH, ["only the red box", "only the blue box", "both", "neither", "Not sure"], "C"),
    (BOTH, ["the red box", "the blue box", "the red box and the blue box"], "C"),
    (BOTH, ["the red box", "the blue box"], None),
    (BOTH, ["the box", "all of them", "none"], "B"),
    (NEITHER, ["only the red box", "only the blue box", "both", "neither the red box nor the blue box"], "D"),
    (WITHOUT, ["Removing the red box", "Removing the duck", "both", "neither"], "A"),
    (WITHOUT, ["The duck", "None of them"], "B"),
    (WITHOUT, ["Remove the vase", "Remove the red box", "Both", "Not sure"], "C"),
    (WITHOUT, ["both", "neither"], None),
    (NEEDLESS, ["the red box", "the duck", "both", "neither"], "D"),
    (of_each("which", red_box=True, duck=False).model_copy(update={"sure": False}), ["the red box", "the duck"], None),
]  # fmt: skip


def simulated(outcome: Outcome, **world: Any) -> Simulation:
    """A simulation with an outcome, and nothing else in its world."""
    given = {"outcome": outcome, "ensemble": 50, "law": "contact"} | world
    old = Simulation.model_validate(SIMULATION)
    trajectory = Trajectory.model_validate(old.trajectory.model_dump() | given)
    narration = narrate(old.grounding, trajectory, "en")
    return old.model_copy(update={"trajectory": trajectory, "narration": narration})
