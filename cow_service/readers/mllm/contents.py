"""What a multimodal LLM can be shown with a question: the imagined frames, or a placebo instead.

A placebo has as many pictures of the same size, and tells nothing of what would happen. What the imagined frames gain
over it is what imagining brings; what a placebo gains over the image alone is what more pictures bring. What a
simulation found is told in words, too: facts and how sure they are, never what to answer.
"""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from cow_service.errors import CannotReadDirection
from cow_service.media.images import decode
from cow_service.media.overlay import named_strip
from cow_service.narration.summary import found_in, label_of_changes, narrate
from cow_service.narration.words import bare_name, phrases_of
from cow_service.readers.base import Imagined
from cow_service.readers.mllm.replies import text_of
from cow_service.records import DIRECTED_KINDS, MEETINGS, Encounter, Simulation, Trajectory
from cow_service.weights.manifests import EXAMPLES

# `true`: frames drawn along the path that is known to be true. `text`: what the simulation found, in words.
Content = Literal["none", "simulated", "still", "wrong-direction", "other-item", "text", "true"]
PLACEBOS: tuple[Content, ...] = ("still", "wrong-direction", "other-item")
STEEP = 0.05  # of a unit vector
QUESTIONS = {  # about the example pictures
    "ball-and-mug": "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?",
    "falling-ball": "If the black ball falls freely from its current position, will it land on the orange cylinder?",
    "bottle-passes-cylinder": "If the red bottle moves along the arrow, will the white cylinder be occluded?",
    "thrown-ball": "If the pink ball is thrown in the direction of the arrow, will it hit the white cube?",
}
_ENDS = ("distance", "duration", "until")


def facts_of(simulation: Simulation) -> tuple[str, ...]:
    """The findings of a simulation, in the words that `/answer` sends to a multimodal LLM."""
    told: Any = hypothesis(Imagined(simulation, ()))
    nothing = "The moving object meets nothing." if told["encounters_known"] else "It is not known what it meets."
    return (*told["facts"], *told["encounters"]) or (nothing,)


def opposite_motion(simulation: Simulation) -> dict[str, Any]:
    """The field `motion` of a request for the same scene, with the motion the other way round.

    A throw keeps its rise; a fall becomes a motion to the side. Raises `CannotReadDirection` for what goes nowhere.
    """
    motion = simulation.motion
    if motion.kind == "fall":
        return {"kind": "linear", "direction": (1.0, 0.0)}
    if motion.kind not in DIRECTED_KINDS or motion.direction is None:
        raise CannotReadDirection(f"A {motion.kind} motion has no direction, so there is no wrong one.")
    right, down = motion.direction
    if motion.kind == "projectile" and abs(right) < STEEP and abs(motion.depth) < STEEP:
        raise CannotReadDirection("What is thrown straight up or down has no opposite direction.")
    return {
        "kind": motion.kind,
        "direction": (-right, down if motion.kind == "projectile" else -down),
        "depth": -motion.depth,
        "speed": motion.speed,
        **{name: value for name in _ENDS if (value := getattr(motion, name)) is not None},
    }


def other_item(image: NDArray[np.uint8]) -> tuple[bytes, str]:
    """Another picture (JPEG) and a question about it: the example that looks least like the image (height, width, 3).

    An example that is the image itself is never taken, whatever it was encoded as.
    """

    def thumbnail(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
        return as_large_as(pixels, 16, 16).astype(np.float64)

    files = {name: EXAMPLES[name].file("image").read_bytes() for name in QUESTIONS}
    unlike = {name: np.abs(thumbnail(decode(file).pixels) - thumbnail(image)).mean() for name, file in files.items()}
    name = max(unlike, key=lambda each: float(unlike[each]))
    return files[name], QUESTIONS[name]


def as_large_as(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """The middle of a picture (height, width, 3), scaled to exactly that size (px)."""
    if pixels.shape[:2] == (height, width):
        return pixels
    return np.asarray(ImageOps.fit(Image.fromarray(pixels), (width, height)))


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

    return {
        "sentence": simulation.motion.sentence,
        "times": ", ".join(f"{frame.time:.2f} s" for frame in simulation.frames),
        "law": trajectory.law,
        "changed": changed,
        "as_it_is": AS_IT_IS if imagined.factual_frames else "",
        "facts": tuple(facts),
        "encounters": () if facts else tuple(meeting_words(each, trajectory) for each in trajectory.encounters),
        "encounters_known": simulation.encounters_known,
    }


def meeting_words(each: Encounter, trajectory: Trajectory) -> str:
    """An encounter in words, with its time and in how many versions it is so."""
    covered = "" if each.share is None else f", at most {each.share:.0%} covered"
    counted, total = "", trajectory.ensemble
    if each.probability is not None:
        counted = f"; in {round(each.probability * total)} of {total} simulated versions"
    time = each.first_frame / trajectory.fps if each.time is None else each.time
    return f"{MEETINGS[each.kind]} the {bare_name(each.object)}, {time:.1f} s in{covered}{counted}"


def _changed(simulation: Simulation) -> str:
    """What is changed before the motion, as in: With the white mug next to the vase; empty where nothing is."""
    return label_of_changes(simulation.grounding, simulation.trajectory, ENGLISH)
