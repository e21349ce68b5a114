"""What a simulation found, in words for the prompt of an answer: facts and how sure they are, never what to answer."""

import numpy as np
from numpy.typing import NDArray

from cow_service.media.overlay import named_strip
from cow_service.narration.summary import found_in, label_of_changes, narrate
from cow_service.narration.words import bare_name, phrases_of
from cow_service.readers.base import Imagined
from cow_service.readers.mllm.replies import text_of
from cow_service.records import MEETINGS, Simulation

ENGLISH = phrases_of("en")
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

    # The story, how many versions agree in each world, and what that rests on; nothing without an outcome.
    facts: list[str] = []
    worlds = {"": trajectory} if trajectory.factual is None else {changed: trajectory, AS_IT_IS: trajectory.factual}
    if all(world.outcome is not None for world in worlds.values()) and trajectory.outcome is not None:
        facts = [text_of(narrate(simulation.grounding, trajectory, "en").story)]
        for name, world in worlds.items():
            found = found_in(simulation.grounding.object, world, ENGLISH)
            facts += [text_of(f"{name}: {found}" if name else found)] if found else []
        doubts = [ENGLISH(f"doubt-{doubt}") for doubt in trajectory.outcome.depends_on]
        facts += [f"It depends most on {', '.join(doubts)}."] if doubts else []

    encounters: list[str] = []
    for each in () if facts else trajectory.encounters:
        covered = "" if each.share is None else f", at most {each.share:.0%} covered"
        counted, total = "", trajectory.ensemble
        if each.probability is not None:
            counted = f"; in {round(each.probability * total)} of {total} simulated versions"
        meets = f"{MEETINGS[each.kind]} the {bare_name(each.object)}"
        time = each.first_frame / trajectory.fps if each.time is None else each.time
        encounters.append(f"{meets}, {time:.1f} s in{covered}{counted}")
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
    """What is changed before the motion, as in: With the white mug next to the vase; empty where nothing is."""
    return label_of_changes(simulation.grounding, simulation.trajectory, ENGLISH)
