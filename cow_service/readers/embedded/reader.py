"""The reader that needs no weights: rules for the question, classical vision for the image. It never guesses."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from cow_service import __version__, records
from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.narration.words import phrases_of, same_name
from cow_service.perception.facing import facing
from cow_service.physics.camera import depth_motion, way_to
from cow_service.readers import base
from cow_service.readers.base import MotionReading, ReaderInput
from cow_service.readers.embedded import changes, matching, motions
from cow_service.readers.embedded.answers import MAX_UNREAD, answer_from
from cow_service.readers.embedded.english import noun_phrases
from cow_service.readers.embedded.english.asked import read_alternatives, read_asked, unread
from cow_service.readers.embedded.english.lexicon import ARROWS, ObjectPhrase
from cow_service.readers.embedded.english.motion import MotionWords
from cow_service.readers.embedded.english.questions import Question, parse
from cow_service.readers.options import plain
from cow_service.readers.remedies import GIVE_DIRECTION, GIVE_PLACE
from cow_service.records import DIRECTED_KINDS, BBox, Grounding, LocatedObject, MotionKind, ObjectPrior, Source
from cow_service.settings import Settings
from cow_service.vision.masks import is_same_object
from cow_service.vision.regions import Region
from cow_service.vision.scene import Scene, arrow_of


class EmbeddedReader:
    """Colour and noun of the mover, words and arrows for its direction, encounters for the answer."""

    source: Source = "embedded"
    info = records.ReaderInfo(name="embedded", revision=__version__)  # rules change with the version alone
    fingerprint = f"embedded {__version__}"

    heeds_seed = False
    heeds_objections = False

    def repeats_answers(self, votes: int) -> bool:
        """Always: rules draw no random numbers."""
        return True

    def read_question(self, question: str) -> base.QuestionReading:
        """What the grammar reads."""
        read, words = parse(question), question.lower()
        named = (
            base.NamedChange(
                kind=change.kind,
                object=change.object.text,
                relation=change.relation,
                targets=tuple(target.text for target in change.targets),
            )
            for change in read.interventions
        )
        drawings = frozenset(each for each in ("arrow", "box") if each in words)
        trail_named, nouns, said = read.motion.trail is not None, matching.nouns_of(read), read.motion
        way = base.WayReading(
            along_arrow=None if said.arrow is None else said.arrow == "along",
            direction=said.direction,
            depth=said.depth,
            towards=None if said.towards is None else said.towards.text,
            forward=said.forward,
        )
        way = base.WayReading() if unread(read).turning or said.contradictory else way
        asked = read_asked(read)
        mover = None if asked is None or read.mover is None else read.mover.text
        return base.QuestionReading(asked, mover, tuple(named), trail_named, nouns, drawings, way)

    def read_name(self, name: str) -> ObjectPrior:
        """By its noun."""
        opening = noun_phrases.container_form(name)
        return ObjectPrior(
            shape=noun_phrases.shape_of(name),
            elongated=noun_phrases.is_vehicle(name),
            equal_sided=noun_phrases.is_cube(name),
            opening=None if opening == "unknown" else opening,
        )

    def likeness(self, words: str, name: str) -> base.Likeness:
        """By their colours, nouns and numbers, and the forms of their nouns."""
        return noun_phrases.likeness(words, name)

    def names_meant(self, words: str, names: Sequence[str]) -> tuple[str, ...]:
        """Those of a kind such as "both mugs", where there are as many as is said; else the words themselves."""
        kind = noun_phrases.kind_of(words)
        if kind is None or any(plain(name) == plain(words) for name in names):
            return (words,)
        found = tuple(name for name in names if noun_phrases.may_name(kind.phrase, name))
        return found if found and kind.count in (None, len(found)) else (words,)

    def ground(self, given: ReaderInput) -> base.GroundingReading:
        """The region that fits the mover's words. Raises `CannotGround` if none or several do."""
        question = parse(given.question)
        mover, motion, left = question.mover, question.motion, unread(question)
        parts = (motion.kind, motion.arrow, motion.direction, motion.forward, motion.towards, motion.trail)
        says_motion = bool(motion.verb or motion.depth) or any(part is not None for part in parts)
        if mover is None or not says_motion:
            named = ("', '".join((*left.turning, *left.beside)) or given.question)[:MAX_UNREAD]
            raise CannotGround(
                "The question does not say in words what moves and how, as far as the embedded reader understands it; "
                f"it reads English. It did not understand '{named}'. "
                f'Ask like "If the red ball moves to the left, will it hit the vase?".',
                remedy=GIVE_PLACE,
            )
        with given.cpu():
            changes.check_changes(question)
            scene, assumed = motions.scene_of_mover(given.scene, question)
            if given.find is not None and scene.side_view is None:
                scene = matching.with_found(scene, given.find(matching.nouns_of(question, given.sought)))
            removed = changes.find_removed(scene, question, given.known)
            regions = changes.without(scene.regions, [change.object.bbox for change in removed])
            bbox = _mover(scene, regions, question, mover)
            placed = changes.find_placed(scene, regions, question, (mover, bbox), given.known)
            # The other things of the question, and those that the caller wants located under other words.
            words = [phrase.text for phrase in (mover, *question.others)]
            sought = [name for name in given.sought if not any(same_name(name, each) for each in words)]
            phrases = [(name, noun_phrases.parse_noun_phrase(name)) for name in sought]
            wanted = [*question.others, *(replace(phrase, text=name) for name, phrase in phrases if phrase is not None)]
            others: dict[BBox, LocatedObject] = {}
            for phrase in wanted:
                place = _bbox_of(regions, phrase, bbox, wanted)
                if place is not None:
                    others.setdefault(place, LocatedObject(object=phrase.text, bbox=place))
            located = (*others.values(), *matching.things_of_kinds(regions, question, bbox, given.known))
            boxes = {other.object: other.bbox for other in located}
            besides = [each for each in regions if each.bbox != bbox]
            meant = partial(matching.best_matches, besides, others=wanted)
            missing = [
                f"{matching.unclear(each, meant(each), besides)}. No encounter is listed under that name."
                for each in question.others
                if each.text not in boxes
                and not matching.is_kind_asked(each, question)
                and changes.given_as(each, given.known) is None
            ]
            asked, (phrase, before) = read_asked(question), noun_phrases.table_at_end(question.items)
            lands = records.Asked(relation="lands") if asked is None else asked
            if scene.side_view is not None and phrase is not None and lands.relation == "lands":
                # Seen from the side, a table is a thing, and the floor is another.
                table = matching.table_among([each for each in regions if each.bbox != bbox])
                located += () if table is None else (LocatedObject(object=phrase.text, bbox=table.bbox),)
                if before in {"on", "onto", "upon"} and not lands.negated:
                    on_it = lands.model_copy(update={"relation": "touches", "target": phrase.text})
                    asked = None if table is None else on_it
            boxes |= {mover.text: bbox}
            things = [(each, boxes[each.text]) for each in (mover, *question.others) if each.text in boxes]
            doubts, doubtful = matching.noun_doubts(scene, things)
        doubts += [f"The words '{each}' were not understood, so no outcome is given." for each in left.turning]
        doubts += [f"The words '{each}' were not understood and changed nothing." for each in left.beside]
        return base.GroundingReading(
            mover.text,
            bbox,
            others=tuple(each.model_copy(update={"is_doubtful": each.bbox in doubtful}) for each in located),
            warnings=(*assumed, *missing, *doubts),
            interventions=(*removed, *placed),
            asked=asked,
            is_doubtful=bbox in doubtful,
        )

    def read_motion(self, given: ReaderInput, grounding: Grounding, hints: base.MotionHints | None) -> MotionReading:
        """Kind and direction from the words, and from the arrow where the words speak of one.

        Raises `CannotReadDirection`.
        """
        with given.cpu():
            scene, question = given.scene, parse(given.question)
            words = question.motion
            on = motions.along_trail(scene, grounding, words) if words.trail is not None else None
            reading = on or _read_motion(scene, question, grounding)
            parted = any(each.share is not None for each in words.quantities)
            goal = _towards(scene, words.towards, grounding) if parted and words.towards is not None else None
            way = None if goal is None else way_to(goal.bbox, grounding.bbox, reading.kind == "linear")
            return replace(
                reading,
                steps=motions.step_readings(words.steps, grounding.bbox),
                others=motions.other_readings(scene, words.others, grounding),
                **motions.quantities(words.quantities, None if way is None else math.hypot(*way), grounding.bbox),
            )

    def answer(
        self,
        given: ReaderInput,
        options: Sequence[records.AnswerOption],
        grounding: Grounding | None,
        imagined: base.Imagined | None,
        votes: int,
    ) -> tuple[base.AnswerReading, ...]:
        """The world's answer to the question, the same for every vote; not sure if it has none."""
        question = parse(given.question)
        simulation = None if imagined is None else imagined.simulation
        asked, say = read_asked(question) if grounding is None else grounding.asked, phrases_of(given.language)
        reading = answer_from(options, asked, simulation, say, read_alternatives(question), unread(question))
        if votes > 1:
            again = "The embedded reader gives the same answer every time: more votes say no more."
            reading = replace(reading, notes=(*reading.notes, again))
        return (reading,) * votes


AGREES = 0.5  # cosine of the angle from which an arrow and a direction that is named are two things
_ON_FLOOR = frozenset({"slide", "roll", "drive", "glide", "skid"})  # such an object keeps touching its support
_RISES = frozenset({"lift", "raise", "rise", "ascend", "float"})  # what does so upwards leaves it
_SEVERAL = frozenset({"both", "two", "three", "all", "four", "several"})


def create(settings: Settings) -> EmbeddedReader:
    """Factory for the registry."""
    return EmbeddedReader()


def _mover(scene: Scene, regions: Sequence[Region], question: Question, phrase: ObjectPhrase) -> BBox:
    if phrase.text.lower().split()[0] in _SEVERAL:
        raise CannotGround(
            f"The question moves '{phrase.text}' at once: ask of one thing, or name each.", remedy=GIVE_PLACE
        )
    if phrase.inside_box:
        return matching.inside_drawn_box(scene, phrase)
    if not scene.regions:
        raise CannotGround(
            f"Looked for '{phrase.text}', but the image is too cluttered (or too plain) for the embedded reader to "
            f"tell its objects apart.",
            remedy=GIVE_PLACE,
        )
    fitting = matching.best_matches(regions, phrase, question.others)
    if len(fitting) > 1 and question.mentions_arrow:
        fitting = scene.at_arrow(fitting) or fitting
    if len(fitting) != 1 or (matching.says_nothing(phrase, fitting) and len(scene.regions) > 1):
        told = matching.unclear(phrase, fitting, scene.regions)
        raise CannotGround(f"What moves is not clear: {told}.", remedy=GIVE_PLACE)
    return fitting[0].bbox


def _bbox_of(
    regions: Sequence[Region], phrase: ObjectPhrase, mover: BBox, others: Sequence[ObjectPhrase]
) -> BBox | None:
    """The box of the one region, besides the mover, that fits a phrase; None if several fit."""
    # An object outlined by models is separate, even if its box is nearly that of the mover in front of it.
    beside = [each for each in regions if each.bbox != mover and (each.called or not is_same_object(each.bbox, mover))]
    region = matching.match_one(beside, phrase, others)
    return None if region is None else region.bbox


def _read_motion(scene: Scene, question: Question, grounding: Grounding) -> MotionReading:
    words, name = question.motion, grounding.object
    kind = words.kind or "linear"
    if kind == "static" and question.names_direction:
        raise CannotReadDirection(
            f"The question says that the {name} does not move, and speaks of a direction all the same: "
            f"which is meant was not understood.",
            remedy=GIVE_DIRECTION,
        )
    if words.contradictory:
        raise CannotReadDirection(
            f"The verb '{words.verb}' and the direction that the question gives for the {name} contradict "
            f"each other: which is meant was not understood.",
            remedy=GIVE_DIRECTION,
        )
    motions.refuse_unclear_fall(scene, words, grounding)
    if kind not in DIRECTED_KINDS:
        return MotionReading(kind, None, "gravity" if kind == "fall" else "text")
    if scene.side_view is not None and words.direction == (0.0, 1.0) and kind == "linear":
        return MotionReading("fall", None, "gravity")  # down a slope, or over an edge, by its weight
    if scene.side_view is not None and words.depth:
        raise CannotReadDirection(
            "The image is a drawing seen from the side: nothing in it moves towards the viewer, or away.",
            remedy=GIVE_DIRECTION,
        )
    said = _as_said(scene, words, kind, grounding)
    if said is not None:
        return said
    if words.forward is None:
        return motions.along_trail(scene, grounding, words) or _along_arrow(scene, question, grounding, kind)
    # Forward or backward, by the way that a vehicle is seen to face.
    told = f"The question says that the {name} moves {'forward' if words.forward else 'backward'}."
    if not noun_phrases.is_vehicle(name):
        raise CannotReadDirection(
            f"{told} The embedded reader sees only of vehicles with wheels which way they face.",
            remedy=GIVE_DIRECTION,
        )
    way = facing(scene.clean, scene.silhouette(grounding.bbox), grounding.bbox)
    if way is None:
        raise CannotReadDirection(f"{told} Which way it faces could not be seen for certain.", remedy=GIVE_DIRECTION)
    return MotionReading(kind, way if words.forward else (-way[0], -way[1]), "orientation")


def _as_said(scene: Scene, words: MotionWords, kind: MotionKind, grounding: Grounding) -> MotionReading | None:
    """The motion whose direction the words give; None if they give none."""
    if words.arrow is not None:
        x, y = arrow_of(scene, grounding, GIVE_DIRECTION).direction
        along = words.arrow == "along"
        x, y = (x, y) if along else (-x, -y)
        said = words.direction or (x, y)
        if x * said[0] + y * said[1] < AGREES * math.hypot(x, y) * math.hypot(*said):
            raise CannotReadDirection(
                "The question names the arrow and another direction, and the arrow does not point there.",
                remedy=GIVE_DIRECTION,
            )
        return MotionReading(kind, (x, y), "arrow", along_arrow=along)
    if words.direction is not None and words.verb in _ON_FLOOR and words.direction[0] == 0.0 and not words.depth:
        direction, depth = depth_motion(-math.copysign(1.0, words.direction[1]))  # up the image is away on the floor
        return MotionReading(kind, direction, "text", depth=depth)
    if words.direction is not None:
        rises = words.verb in _RISES and words.direction[1] < 0
        return MotionReading(kind, words.direction, "text", depth=words.depth, rises=rises)
    if words.depth:
        direction, depth = depth_motion(words.depth)
        return MotionReading(kind, direction, "text", depth=depth)
    if words.towards is not None:
        goal = _towards(scene, words.towards, grounding)
        return MotionReading(kind, way_to(goal.bbox, grounding.bbox, kind == "linear"), "text", towards=goal)
    return None


def _along_arrow(scene: Scene, question: Question, grounding: Grounding, kind: MotionKind) -> MotionReading:
    """Along the only arrow drawn at the mover, where the question names no direction at all."""
    near = scene.arrows_near(grounding.bbox)
    clause = (item for item in question.clause if item.phrase is not None and item.phrase.head in ARROWS)
    if any(item.start not in question.read for item in clause):
        raise CannotReadDirection(
            f"How the {grounding.object} moves by the arrow that the question names was not understood.",
            remedy=GIVE_DIRECTION,
        )
    if near and question.names_direction:
        raise CannotReadDirection(
            "The question has words of direction that could not be read as the motion's, so the drawn arrow was "
            "not followed either.",
            remedy=GIVE_DIRECTION,
        )
    if len(near) != 1:
        raise CannotReadDirection(
            "The question names no direction (left, right, up, down, towards, away, along the arrow), and the "
            f"image shows {len(near) or 'no'} arrow{'s' if len(near) > 1 else ''} at the {grounding.object}.",
            remedy=GIVE_DIRECTION,
        )
    note = "The question names no direction; the arrow drawn at the object was followed."
    return MotionReading(kind, near[0].direction, "arrow", along_arrow=True, warnings=(note,))


def _towards(scene: Scene, phrase: ObjectPhrase, grounding: Grounding) -> LocatedObject:
    """The thing that the mover moves towards. Raises `CannotReadDirection`."""
    goal = next((other for other in grounding.others if other.object == phrase.text), None)
    if goal is not None:
        return goal
    bbox = _bbox_of(scene.regions, phrase, grounding.bbox, ())
    if bbox is None:
        besides = [each for each in scene.regions if each.bbox != grounding.bbox]
        told = matching.unclear(phrase, matching.best_matches(besides, phrase), besides)
        raise CannotReadDirection(f"Where the {grounding.object} moves to is not clear: {told}.", remedy=GIVE_DIRECTION)
    return LocatedObject(object=phrase.text, bbox=bbox)
