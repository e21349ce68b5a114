"""The mover of a trail: which of the positions that are shown is the present one, and how it moves on."""

from __future__ import annotations

from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.physics.trail_fit import is_thrown
from cow_service.readers.base import MotionReading
from cow_service.readers.embedded.english.interventions import TrailWords
from cow_service.readers.embedded.english.motion import MotionWords
from cow_service.readers.embedded.english.questions import Question
from cow_service.readers.embedded.matching import best_matches, describe, match_one
from cow_service.readers.remedies import GIVE_DIRECTION, GIVE_PLACE
from cow_service.records import FALLING_KINDS, BBox, Grounding
from cow_service.vision.scene import Scene
from cow_service.vision.trails import Trail, TrailEnd, trail_of


def scene_of_mover(scene: Scene, question: Question) -> tuple[Scene, tuple[str, ...]]:
    """The scene in which the trail that the question may be about ends where the question says, and a warning.

    Where neither the image nor the words tell the end, it is that from which the path leads on to what is asked about.
    Raises `CannotGround` where the thing that the words tell the end by was not found.
    """
    words, phrase = question.motion.trail, question.mover
    if phrase is None or not scene.trails:
        return scene, ()
    fitting = best_matches(scene.regions, phrase, question.others)
    trails = [trail for trail in (trail_of(scene.trails, region.bbox) for region in fitting) if trail is not None]
    if len(trails) != 1:
        return scene, ()
    trail, warnings = trails[0], ()
    if words is not None:
        trail = trail.ending(TrailEnd(_near(scene, words, trail), words.side, is_oldest=not words.last))
    if not trail.end_known:
        name, bbox = _ahead(scene, question, trail)
        trail = trail.ending(TrailEnd(bbox))
        warnings = (
            f"The image shows the {phrase.text} in {len(trail.positions)} places one after another, and neither they "
            f"nor the question tell which is the last: the one nearest to the {name} was taken for it. Say otherwise "
            f'like "on along its trail, the last of which is the leftmost". {GIVE_PLACE}',
        )
    return scene.with_mover(trail.present.bbox), warnings


def _ahead(scene: Scene, question: Question, trail: Trail) -> tuple[str, BBox]:
    """What may lie ahead of a trail: the first thing that is asked about, else the middle of the image."""
    beside = [region for region in scene.regions if trail_of((trail,), region.bbox) is None]
    for phrase in question.others:
        found = match_one(beside, phrase)
        if found is not None:
            return phrase.text, found.bbox
    x, y = scene.width / 2, scene.height / 2
    return "middle of the image", (x, y, x, y)


def _near(scene: Scene, words: TrailWords, trail: Trail) -> BBox | None:
    """The box of the thing that the words name an end of the trail by. Raises `CannotGround` where it is not found."""
    if words.near is None:
        return None
    found = match_one([r for r in scene.regions if trail_of((trail,), r.bbox) is None], words.near)
    if found is None:
        raise CannotGround(
            f"The question tells the end of the trail by '{words.near.text}', which was not found, or not for certain. "
            f"Seen: {describe(scene.regions)}. {GIVE_PLACE}"
        )
    return found.bbox


def along_trail(scene: Scene, grounding: Grounding, words: MotionWords) -> MotionReading | None:
    """On from the present position of the trail at the mover; None where there is none.

    Raises `CannotReadDirection` where the words speak of one all the same.
    """
    trail = trail_of(scene.trails, grounding.bbox)
    if trail is not None:
        thrown = is_thrown(trail.positions) or words.kind in FALLING_KINDS
        earlier = tuple(position.centre for position in trail.older)
        return MotionReading("projectile" if thrown else "linear", trail.heading, "trail", trail=earlier)
    if words.trail is None:
        return None
    raise CannotReadDirection(
        f"The question speaks of a trail, and no three positions of the {grounding.object} one after another were "
        f"found in the image. {GIVE_DIRECTION}"
    )
