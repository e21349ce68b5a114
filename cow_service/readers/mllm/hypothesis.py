"""What a simulation found, in words for the prompt of an answer: facts and how sure they are, never what to answer."""

import numpy as np
from numpy.typing import NDArray

from cow_service.media.overlay import named_strip
from cow_service.narration import DOUBTS, EVENTS, OF_ITSELF, OF_TARGET, bare_name, state_words
from cow_service.readers.base import Imagined
from cow_service.readers.mllm.replies import text_of
from cow_service.records import MEETINGS, Outcome, Simulation

AS_IT_IS = "As it is"  # the name of the frames with nothing changed


def pictures(imagined: Imagined) -> tuple[NDArray[np.uint8], ...]:
    """What is shown of a simulation: its frames or, of two worlds, a named strip of each."""
    if not imagined.factual_frames:
        return imagined.frames
    name = _changed(imagined.simulation)
    return named_strip(imagined.frames, name), named_strip(imagined.factual_frames, AS_IT_IS)


def hypothesis(imagined: Imagined) -> dict[str, object]:
    """What the simulation found, as inputs of the prompt; encounters only where there is no outcome to tell."""
    simulation = imagined.simulation
    trajectory, changed = simulation.trajectory, _changed(simulation)

    # The facts of the outcome, how probable they are in each world, and what they rest on; none without an outcome.
    worlds = {"": trajectory} if trajectory.factual is None else {changed: trajectory, AS_IT_IS: trajectory.factual}
    outcomes = {name: (each, each.outcome) for name, each in worlds.items() if each.outcome is not None}
    facts: list[str] = []
    if trajectory.outcome is not None and len(outcomes) == len(worlds):
        facts += [text_of(trajectory.outcome.facts)] if trajectory.outcome.facts else []
        for name, (world, outcome) in outcomes.items():
            if outcome.probability is not None:
                event = _event(outcome, simulation.grounding.object)
                told = f"{_share(outcome.probability, world.ensemble)}: {event}."
                facts.append(f"{name}, {told[0].lower()}{told[1:]}" if name else told)
        if trajectory.outcome.depends_on:
            facts.append(f"It depends most on {', '.join(DOUBTS[doubt] for doubt in trajectory.outcome.depends_on)}.")

    encounters: list[str] = []
    for each in () if facts else trajectory.encounters:
        covered = "" if each.share is None else f", at most {each.share:.0%} covered"
        sure = "" if each.probability is None else f"; {_share(each.probability, trajectory.ensemble).lower()}"
        meets = f"{MEETINGS[each.kind]} the {bare_name(each.object)}"
        encounters.append(f"{meets}, {each.first_frame / trajectory.fps:.2f} s in{covered}{sure}")
    return {
        "sentence": simulation.motion.sentence,
        "times": ", ".join(f"{frame.time:.2f} s" for frame in simulation.frames),
        "law": trajectory.law,
        "changed": changed,
        "as_it_is": AS_IT_IS if imagined.factual_frames else "",
        "facts": tuple(facts),
        "encounters": tuple(encounters),
        "encounters_known": simulation.encounters_known,
    }


def _changed(simulation: Simulation) -> str:
    """What is changed before the motion, as in: With the vase removed; empty where nothing is."""
    changes = simulation.grounding.interventions
    removed = " and ".join(f"the {bare_name(each.object.object)}" for each in changes if each.kind == "remove")
    put = {each.object for each in simulation.trajectory.placed}
    placed = [state_words(each) for each in changes if each.kind == "place" and each.object.object in put]
    told = [*([f"{removed} removed"] if removed else []), *placed]
    return f"With {' and '.join(told)}" if told else ""


def _event(outcome: Outcome, mover: str) -> str:
    """What `Outcome.probability` is that of."""
    asked = outcome.asked
    does, does_not = EVENTS[asked.relation]
    doing = does_not if asked.negated else does
    subject = f"the {bare_name(outcome.subject or mover)}"
    thing = text_of(outcome.object or asked.target or ("anything" if asked.negated else "something"))
    if asked.form == "changes":
        same = " not" if asked.negated else ""
        what = f"whether {subject} {does} {thing}" if asked.target is not None else f"what {subject} {does} first"
        return f"it does{same} make a difference to {what}"
    if asked.form in ("which-first", "where", "what-happens"):
        return f"the first thing that {subject} {does} is {text_of(outcome.first or 'nothing')}"
    if asked.form == "how-many":
        return f"the number of things that {subject} {does} is {outcome.count or 0}"
    if asked.relation in OF_TARGET:
        event = f"{thing} {doing}"
    else:
        event = f"{subject} {doing}" + ("" if asked.relation in OF_ITSELF else f" {thing}")
    event += f" within {asked.within:g} s" if asked.within is not None else ""
    if asked.form != "when" or outcome.time is None:
        return event
    early, late = outcome.time_band or (outcome.time, outcome.time)
    return f"{event}, first after {outcome.time:.2f} s ({early:.2f} to {late:.2f} s in the middle 80% of the worlds)"


def _share(probability: float, worlds: int) -> str:
    if not worlds:
        return f"With a computed probability of {probability:.0%}"
    return f"In {probability:.0%} of {worlds} computed worlds"
