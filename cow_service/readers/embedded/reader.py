"""The reader that needs no weights: sentence forms for the question, classical vision for the image. It never guesses."""

import math
from collections.abc import Sequence
from dataclasses import replace

from cow_service import __version__, records
from cow_service.errors import CannotGround
from cow_service.narration.words import phrases_of, same_name
from cow_service.physics.camera import way_to
from cow_service.readers import base
from cow_service.readers.base import MotionReading, ReaderInput
from cow_service.readers.embedded import matching, motions
from cow_service.readers.embedded.answers import MAX_UNREAD, answer_from
from cow_service.readers.embedded.english import noun_phrases
from cow_service.readers.embedded.english.lexicon import ObjectPhrase
from cow_service.readers.embedded.english.questions import Question, parse, rewordings
from cow_service.readers.options import plain
from cow_service.readers.remedies import GIVE_OBJECT, GIVE_PLACE
from cow_service.records import BBox, Grounding, Intervention, LocatedObject, ObjectPrior, Source
from cow_service.settings import Settings
from cow_service.vision.masks import is_among, is_same_object
from cow_service.vision.regions import Region
from cow_service.vision.scene import Scene

LOCATE_IT = f"{GIVE_PLACE} Or click it on the page, or have a multimodal LLM read the image (COW_MLLM)."


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

    def read_question(self, question: str, names: Sequence[str] = ()) -> base.QuestionReading:
        """What the sentence forms read; things that are given under one of the names have it."""
        read = parse(question, tuple(names))
        changes = tuple(
            base.NamedChange(each.kind, each.object.text, each.relation, tuple(target.text for target in each.targets))
            for each in read.changes
            if each.kind == "remove" or each.targets
        )
        drawings = frozenset(each for each in ("arrow", "box") if each in question.lower())
        said, way = read.motion, base.WayReading()
        if not read.unread and not said.is_contradictory:
            towards = None if said.towards is None else said.towards.text
            way = base.WayReading(said.along_arrow, None if said.depth else said.direction, towards)
        nouns = matching.nouns_of(read)
        return base.QuestionReading(read.asked, changes, said.trail is not None, nouns, drawings, way)

    def read_name(self, name: str) -> ObjectPrior:
        """By its noun."""
        opening = noun_phrases.container_form(name)
        return ObjectPrior(
            shape=noun_phrases.shape_of(name),
            elongated=noun_phrases.is_vehicle(name),
            equal_sided=noun_phrases.is_cube(name),
            opening=None if opening == "unknown" else opening,
        )

    def names_meant(self, words: str, names: Sequence[str]) -> tuple[str, ...]:
        """Those of a kind such as "both mugs", where there are as many as is said; else the words themselves."""
        kind = noun_phrases.kind_of(words)
        if kind is None or any(plain(name) == plain(words) for name in names):
            return (words,)
        found = tuple(name for name in names if noun_phrases.may_name(kind.phrase, name))
        return found if found and kind.count in (None, len(found)) else (words,)

    def ground(self, given: ReaderInput) -> base.GroundingReading:
        """What is given under the mover's words, or the region that fits them. Raises `CannotGround`."""
        question = parse(given.question, names_of(given))
        mover, changes = question.mover, question.changes if given.changes_wanted else ()
        if mover is None or (given.motion_wanted and not question.says_motion):
            raise _not_said(question, given)
        with given.cpu():
            _check_changes(question, changes)
            scene, assumed = motions.scene_of_mover(given.scene, question)
            if given.find is not None and scene.side_view is None:
                scene = matching.with_found(scene, given.find(matching.nouns_of(question, given.sought)))
            finder = _Finder(scene, given.known, question)
            removed = [each for change in changes if change.kind == "remove" for each in finder.removed(change.object)]
            finder.take_away([each.bbox for each in removed])
            bbox = finder.mover(mover)
            placed = [
                Intervention(
                    kind="place", object=things[0], relation=change.relation, targets=tuple(things[1:])
                )
                for change in changes
                if change.kind == "place" and change.targets
                for things in [finder.placed(change.object, change.relation or "into", change.targets, (mover, bbox))]
            ]  # fmt: skip
            # The other things of the question, and those that the caller wants located under other words.
            words = [phrase.text for phrase in (mover, *question.others)]
            sought = [name for name in given.sought if not any(same_name(name, each) for each in words)]
            phrases = [(name, noun_phrases.parse_noun_phrase(name)) for name in sought]
            wanted = [*question.others, *(replace(phrase, text=name) for name, phrase in phrases if phrase is not None)]
            others = dict[BBox, LocatedObject]()
            for phrase in wanted:
                thing = finder.other(phrase, bbox, wanted)
                if thing is not None:
                    others.setdefault(thing.bbox, thing)
            located = [*others.values()]
            located += matching.things_of_kinds(finder.regions, question, bbox, given.known)
            boxes = {other.object: other.bbox for other in (*located, *given.known)}
            besides = [each for each in finder.regions if each.bbox != bbox]
            warnings = [
                f"{matching.unclear(each, matching.best_matches(besides, each, wanted), besides)}. "
                "No encounter is listed under that name."
                for each in question.others
                if each.text not in boxes and not matching.is_kind_asked(each, question)
            ]
            asked = question.asked if given.asked_wanted else None
            if asked is not None and question.table is not None and scene.side_view is not None:
                # Seen from the side, a table is a thing, and the floor is another.
                table = matching.table_among(besides)
                update = {"relation": "touches", "target": question.table.text}
                asked = None if table is None else asked.model_copy(update=update)
                if table is not None:
                    located.append(LocatedObject(object=question.table.text, bbox=table.bbox))
            things = [(each, boxes[each.text]) for each in question.others if each.text in boxes and not each.is_given]
            things += [] if mover.is_given else [(mover, bbox)]
            doubts, doubtful = matching.noun_doubts(scene, things)
        left = [] if not (given.asked_wanted or given.changes_wanted) else list(question.unread)
        warnings += doubts + [f"The words '{each}' were not understood, so no outcome is sure." for each in left]
        return base.GroundingReading(
            mover.text,
            bbox,
            others=tuple(each.model_copy(update={"is_doubtful": each.bbox in doubtful}) for each in located),
            warnings=(*assumed, *warnings),
            interventions=(*(Intervention(kind="remove", object=each) for each in removed), *placed),
            asked=asked,
            is_doubtful=bbox in doubtful or (bool(left) and not given.asked_wanted),
        )

    def read_motion(self, given: ReaderInput, grounding: Grounding, hints: base.MotionHints | None) -> MotionReading:
        """Kind and direction from the words, and from the arrow where the words speak of one.

        Raises `CannotReadDirection`.
        """
        with given.cpu():
            scene = given.scene
            question = parse(given.question, names_of(given) or tuple(each.object for each in grounding.others))
            words = question.motion
            on = motions.along_trail(scene, grounding, words) if words.trail is not None else None
            reading = on or motions.read_way(scene, question, grounding)
            parted = any(each.share is not None for each in words.quantities) and words.towards is not None
            goal = motions.goal_of(scene, words.towards, grounding) if parted and words.towards else None
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
        names = () if grounding is None else (grounding.object, *(each.object for each in grounding.others))
        question = parse(given.question, names_of(given) or names)
        simulation = None if imagined is None else imagined.simulation
        asked, say = question.asked if grounding is None else grounding.asked, phrases_of(given.language)
        reading = answer_from(options, asked, simulation, say, question.alternatives, question.unread)
        notes = list(reading.notes)
        if asked is None and (like := rewordings(question)):
            notes.append(f"Ask like: {' Or: '.join(like)}")
        if votes > 1:
            notes.append("The embedded reader gives the same answer every time: more votes say no more.")
        return (replace(reading, notes=tuple(notes)),) * votes


def create(settings: Settings) -> EmbeddedReader:
    """Factory for the registry."""
    return EmbeddedReader()


def names_of(given: ReaderInput) -> tuple[str, ...]:
    """The names of the given things."""
    return tuple(each.object for each in given.known)


def _not_said(question: Question, given: ReaderInput) -> CannotGround:
    """What a question does not say in a form that is read, and how to say it."""
    unread = ("', '".join(question.unread) or given.question)[:MAX_UNREAD]
    fault = f"The question does not say in words what moves and how: '{unread}' was not understood."
    if question.mover is not None and not question.unread:
        fault = f"The question does not say how the {question.mover.text} moves."
    like = rewordings(question) or ("If the red ball moves to the left, will it hit the vase?",)
    return CannotGround(f"{fault} Ask like: {' Or: '.join(like)}", remedy=LOCATE_IT)


def _check_changes(question: Question, changes: Sequence[object]) -> None:
    """Raises `CannotGround` if what is taken away moves or is asked about, or something is put into itself."""
    asked = question.asked
    about = () if asked is None else [name for name in (asked.subject, asked.target, *asked.among) if name is not None]
    for change in question.changes if changes else ():
        name = change.object.text
        if change.kind == "remove" and change.object == question.mover:
            raise CannotGround(f"The question takes '{name}' away and says that it moves: ask one of both.")
        if change.kind == "remove" and any(same_name(each, name) for each in about):
            raise CannotGround(f"The question takes '{name}' away and asks what becomes of it: ask one of both.")
        if change.object in change.targets:
            raise CannotGround(f"The question puts '{name}' {change.relation} itself: name another thing.")


class _Finder:
    """Finds the things of one question: what is given under their words first, then what is seen."""

    def __init__(self, scene: Scene, known: Sequence[LocatedObject], question: Question) -> None:
        self.scene, self.question, self.regions = scene, question, tuple(scene.regions)
        self._known = {each.object: each for each in known}

    def take_away(self, boxes: Sequence[BBox]) -> None:
        """Leaves out the regions of what is taken away."""
        self.regions = tuple(region for region in self.regions if not is_among(region.bbox, boxes))

    def _one(
        self, phrase: ObjectPhrase, regions: Sequence[Region], others: Sequence[ObjectPhrase]
    ) -> LocatedObject | None:
        """What is given under the words of a phrase, or the one region that fits them."""
        if phrase.is_given:
            return self._known.get(phrase.text)
        region = matching.match_one(regions, phrase, others)
        return None if region is None else LocatedObject(object=phrase.text, bbox=region.bbox, source="embedded")

    def mover(self, phrase: ObjectPhrase) -> BBox:
        """The box of what moves. Raises `CannotGround`."""
        scene = self.scene
        if phrase.is_given:
            return self._known[phrase.text].bbox
        if phrase.inside_box:
            return matching.inside_drawn_box(scene, phrase)
        if noun_phrases.kind_of(phrase.text) is not None:
            fault = f"The question moves '{phrase.text}' at once: ask of one thing, or name each."
            raise CannotGround(fault, remedy=GIVE_PLACE)
        if not scene.regions:
            raise CannotGround(
                f"Looked for '{phrase.text}', but the image is too cluttered (or too plain) for the embedded reader to "
                f"tell its objects apart.{self._given_names()}",
                remedy=LOCATE_IT,
            )
        fitting = matching.best_matches(self.regions, phrase, self.question.others)
        if len(fitting) > 1 and (self.question.names_arrow or phrase.path_end == "start"):
            fitting = scene.at_arrow(fitting) or fitting
        if len(fitting) != 1:
            told = matching.unclear(phrase, fitting, scene.regions)
            raise CannotGround(f"What moves is not clear: {told}.{self._given_names()}", remedy=LOCATE_IT)
        return fitting[0].bbox

    def _given_names(self) -> str:
        return f" Given: {', '.join(self._known)}." if self._known else ""

    def other(self, phrase: ObjectPhrase, mover: BBox, others: Sequence[ObjectPhrase]) -> LocatedObject | None:
        """Another thing; None where it is given, which the caller knows, or is not found for certain."""
        if phrase.is_given:
            return None
        # An object outlined by models is separate, even if its box is nearly that of the mover in front of it.
        beside = [
            each
            for each in self.regions
            if each.bbox != mover and (each.called or not is_same_object(each.bbox, mover))
        ]
        if phrase.is_other:
            return LocatedObject(object=phrase.text, bbox=beside[0].bbox) if len(beside) == 1 else None
        region = matching.match_one(beside, phrase, others)
        return None if region is None else LocatedObject(object=phrase.text, bbox=region.bbox)

    def removed(self, phrase: ObjectPhrase) -> list[LocatedObject]:
        """What is taken away, one thing or "both cylinders". Raises `CannotGround`."""
        changed = [change.object for change in self.question.changes if change.kind == "remove"]
        named = [self.question.mover, *self.question.others, *changed]
        others = [each for each in named if each is not None and noun_phrases.kind_of(each.text) is None]
        kind = None if phrase.is_given else noun_phrases.kind_of(phrase.text)
        one = self._one(phrase, self.regions, others) if kind is None else None
        found = [] if one is None else [one]
        if kind is not None:
            regions = matching.match_several(self.regions, kind.phrase, others, kind.count or 2)
            found = [LocatedObject(object=f"{each.colour} {kind.phrase.head}", bbox=each.bbox) for each in regions]
            found = found if kind.count in (None, 2) else []
        if not found:
            raise self._not_found(self.regions, f"takes '{phrase.text}' away", phrase)
        return [each.model_copy(update={"source": each.source or "embedded"}) for each in found]

    def placed(
        self, phrase: ObjectPhrase, relation: str, targets: Sequence[ObjectPhrase], mover: tuple[ObjectPhrase, BBox]
    ) -> list[LocatedObject]:
        """What is put somewhere, then what it is put to. Raises `CannotGround`."""
        known, found, others = [mover], list[LocatedObject](), [*self.question.others, phrase]
        for each in (phrase, *targets):
            free = [region for region in self.regions if not is_among(region.bbox, [bbox for _, bbox in known])]
            kind = None if each.is_given else noun_phrases.kind_of(each.text)
            if found and kind is not None and relation == "between":
                two = matching.match_several(free, kind.phrase, others, 2)
                found += [LocatedObject(object=f"{one.colour} {kind.phrase.head}", bbox=one.bbox) for one in two]
                continue
            again = next((bbox for other, bbox in known if other == each), None)
            names = [one for one in others if all(one != other for other, _ in known)]
            thing = self._one(each, free, names) if again is None else LocatedObject(object=each.text, bbox=again)
            if thing is None:
                where = f"{relation} '{each.text}'" if found else "somewhere"
                raise self._not_found(free, f"puts '{phrase.text}' {where}", each)
            found.append(thing)
            known.append((each, thing.bbox))
        if relation == "between" and len(found) != 3:
            raise self._not_found(self.regions, f"puts '{phrase.text}' between", targets[0])
        return [each.model_copy(update={"source": each.source or "embedded"}) for each in found]

    def _not_found(self, regions: Sequence[Region], told: str, phrase: ObjectPhrase) -> CannotGround:
        why = matching.unclear(phrase, matching.best_matches(regions, phrase), regions)
        return CannotGround(f"The question {told}, and {why}.{self._given_names()}", remedy=GIVE_OBJECT)
