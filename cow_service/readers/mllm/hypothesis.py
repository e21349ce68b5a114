"""What a simulation found, in words for the prompt of an answer: facts and how sure they are, never what to answer."""

from __future__ import annotations

from cow_service.readers.base import Imagined
from cow_service.records import MEETINGS, AskedRelation, Doubt, Encounter, Outcome, Trajectory

EVENTS: dict[AskedRelation, tuple[str, str]] = {
    "touches": ("touches", "touch"),
    "covers": ("hides", "hide"),
    "covered": ("is hidden by", "be hidden by"),
}  # what the mover does, and what follows "does not" or "will"
DOUBTS: dict[Doubt, str] = {
    "speed": "the speed",
    "heading": "the heading in depth",
    "camera": "the camera",
    "size": "the sizes",
    "place": "how far away and how high things are",
    "friction": "the friction",
}


def hypothesis(imagined: Imagined) -> dict[str, object]:
    """What the simulation found, as inputs of the prompt; encounters only where there is no outcome to tell."""
    simulation = imagined.simulation
    trajectory = simulation.trajectory
    facts = _outcome_words(trajectory, simulation.grounding.object)
    return {
        "sentence": simulation.motion.sentence,
        "times": ", ".join(f"{frame.time:.2f} s" for frame in simulation.frames),
        "law": trajectory.law,
        "facts": facts,
        "encounters": () if facts else tuple(_encounter_words(each, trajectory) for each in trajectory.encounters),
        "encounters_known": simulation.encounters_known,
    }


def _outcome_words(trajectory: Trajectory, mover: str) -> tuple[str, ...]:
    """The facts of the outcome, how probable they are and what they rest on; empty where there are none."""
    outcome = trajectory.outcome
    if outcome is None:
        return ()
    lines = [_one_line(outcome.facts)] if outcome.facts else []
    if outcome.probability is not None:
        lines.append(f"{_share(outcome.probability, trajectory.ensemble)}: {_event(outcome, _one_line(mover))}.")
    if outcome.depends_on:
        lines.append(f"It depends most on {', '.join(DOUBTS[doubt] for doubt in outcome.depends_on)}.")
    return tuple(lines)


def _event(outcome: Outcome, mover: str) -> str:
    """What `Outcome.probability` is that of."""
    asked = outcome.asked
    does, do = EVENTS[asked.relation]
    thing = _one_line(outcome.object or asked.target or ("anything" if asked.negated else "something"))
    if asked.form == "which-first":
        return f"the first thing that the {_bare(mover)} {does} is {_one_line(outcome.first or 'nothing')}"
    if asked.form == "how-many":
        return f"the number of things that the {_bare(mover)} {does} is {outcome.count or 0}"
    event = f"the {_bare(mover)} {f'does not {do}' if asked.negated else does} {thing}"
    if asked.form != "when" or outcome.time is None:
        return event
    early, late = outcome.time_band or (outcome.time, outcome.time)
    return f"{event}, first after {outcome.time:.2f} s ({early:.2f} to {late:.2f} s in the middle 80% of the worlds)"


def _encounter_words(encounter: Encounter, trajectory: Trajectory) -> str:
    covered = "" if encounter.share is None else f", at most {encounter.share:.0%} covered"
    sure = "" if encounter.probability is None else f"; {_share(encounter.probability, trajectory.ensemble).lower()}"
    meets = f"{MEETINGS[encounter.kind]} the {_bare(encounter.object)}"
    return f"{meets}, {encounter.first_frame / trajectory.fps:.2f} s in{covered}{sure}"


def _share(probability: float, worlds: int) -> str:
    return (
        f"In {probability:.0%} of {worlds} computed worlds"
        if worlds
        else f"With a computed probability of {probability:.0%}"
    )


def _bare(name: str) -> str:
    """A name on one line, without its article."""
    return _one_line(name).removeprefix("the ").removeprefix("The ")


def _one_line(text: str) -> str:
    return " ".join(text.split())
