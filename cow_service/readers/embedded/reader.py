"""The reader without weights: sentence forms for the question, classical vision for the image. It never guesses."""

import math
from collections.abc import Sequence
from dataclasses import replace

from cow_service import __version__, records
from cow_service.errors import CannotGround
from cow_service.narration.words import phrases_of, same_name
from cow_service.physics.camera import way_to
from cow_service.readers import base
from cow_service.readers.embedded import matching, motions
from cow_service.readers.embedded.answers import MAX_UNREAD, answer_from
from cow_service.readers.embedded.english import noun_phrases
from cow_service.readers.embedded.english.lexicon import ObjectPhrase
from cow_service.readers.embedded.english.questions import ChangeWords, Question, parse, rewordings
from cow_service.readers.options import plain
from cow_service.readers.remedies import GIVE_OBJECT, GIVE_PLACE
from cow_service.settings import Settings
from cow_service.vision.masks import is_among, is_same_object
from cow_service.vision.regions import Region
from cow_service.vision.scene import Scene

LOCATE_IT = f"{GIVE_PLACE} Or click it on the page, or have a multimodal LLM read the image (COW_MLLM)."


class EmbeddedReader:
    """Colour and noun of the mover, words and arrows for its direction, encounters for the answer."""

    source: records.Source = "embedded"
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
        said, towards = read.motion, None if read.motion.towards is None else read.motion.towards.text
        way = base.WayReading(said.along_arrow, said.direction, said.depth, towards, said.forward)
        way = base.WayReading() if read.unread_motion or said.is_contradictory else way
        nouns, mover = matching.nouns_of(read), None if read.asked is None or read.mover is None else read.mover.text
        kind, others = motions.settled_kind(read), tuple(each.text for each in read.others)
        return base.QuestionReading(read.asked, mover, changes, said.trail, nouns, drawings, way, kind, others)

    def read_name(self, name: str) -> records.ObjectPrior:
        """By its noun."""
        return noun_phrases.prior_of(name)

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

    def ground(self, given: base.ReaderInput) -> base.GroundingReading:
        """What is given under the mover's words, or the region that fits them. Raises `CannotGround`."""
        question = parse(given.question, names_of(given))
        mover, asked, unread = question.mover, question.asked, question.unread
        changes = question.changes if given.changes_wanted else ()
        if mover is None or (given.motion_wanted and not question.says_motion):
            words = ("', '".join(unread) or given.question)[:MAX_UNREAD]
            like = " Or: ".join(rewordings(question) or ("If the red ball moves to the left, will it hit the vase?",))
            fault = (
                f"What moves and how is not said in words that the embedded reader knows: '{words}'; it reads English."
            )
            raise CannotGround(f"{fault} Ask like: {like}", remedy=LOCATE_IT)
        _check_changes(question, changes)
        with given.cpu():
            scene, warnings = motions.scene_of_mover(given.scene, question)
            if given.find is not None and scene.side_view is None:
                scene = matching.with_found(scene, given.find(matching.nouns_of(question, given.sought)))
            finder = _Finder(scene, given.known)
            gone = [change.object for change in changes if change.kind == "remove"]
            away = [each for phrase in gone for each in finder.found(phrase, f"takes '{phrase.text}' away")]
            removed = [records.Intervention(kind="remove", object=each) for each in away]
            finder.regions = finder.without([each.bbox for each in away])
            bbox = finder.mover(mover, question.names_arrow)
            finder.taken = {mover.text: bbox}
            put = [finder.placed(change) for change in changes if change.kind == "place" and change.targets]
            # The other things of the question, and those that the caller wants located under other words.
            words = [phrase.text for phrase in (mover, *question.others)]
            sought = [name for name in given.sought if not any(same_name(name, each) for each in words)]
            parsed = [(name, noun_phrases.parse_noun_phrase(name)) for name in sought]
            wanted = [*question.others, *(replace(phrase, text=name) for name, phrase in parsed if phrase is not None)]
            # An object outlined by models is separate, even if its box is nearly that of the mover in front of it.
            apart = [each for each in finder.regions if each.bbox != bbox]
            beside = [each for each in apart if each.called or not is_same_object(each.bbox, bbox)]
            alone, sought = beside[0] if len(beside) == 1 else None, [each for each in wanted if not each.is_given]
            others = [(each, alone if each.is_other else matching.match_one(beside, each)) for each in sought]
            of_kinds = matching.things_of_kinds(finder.regions, question, bbox, given.known)
            named = ((phrase.text, each.bbox) for phrase, each in reversed(others) if each is not None)
            located = {bbox: records.LocatedObject(object=name, bbox=bbox) for name, bbox in named}
            located |= {each.bbox: each for each in of_kinds}
            warnings += tuple(
                f"{matching.unclear(phrase, beside)}. No encounter is listed under that name."
                for phrase, each in others
                if each is None and phrase in question.others and (given.asked_wanted or given.changes_wanted)
            )
            things = [(phrase, each.bbox) for phrase, each in others if each is not None and phrase in question.others]
            things += [] if mover.is_given else [(mover, bbox)]
            doubts, doubtful = matching.noun_doubts(scene, things)
        left = unread if given.asked_wanted or given.changes_wanted else ()
        doubts += [f"The words '{each}' were not understood, so no outcome is sure." for each in left]
        own = finder.known.get(mover.text)
        seen = reversed(located.values())
        in_doubt = bbox in doubtful or (own is not None and own.is_doubtful) or bool(left and not given.asked_wanted)
        return base.GroundingReading(
            mover.text,
            bbox,
            others=tuple(each.model_copy(update={"is_doubtful": each.bbox in doubtful}) for each in seen),
            warnings=(*warnings, *doubts),
            interventions=(*removed, *put),
            asked=asked if given.asked_wanted else None,
            prior=None if own is None else own.prior,
            is_doubtful=in_doubt,
        )

    def read_motion(
        self, given: base.ReaderInput, grounding: records.Grounding, hints: base.MotionHints | None
    ) -> base.MotionReading:
        """Kind and direction from the words, and from the arrow where the words speak of one.

        Raises `CannotReadDirection`.
        """
        with given.cpu():
            scene, question = given.scene, parse(given.question, names_of(given, grounding))
            words = question.motion
            on = motions.along_trail(scene, grounding, words) if words.trail else None
            reading = on or motions.read_way(scene, question, grounding)
            goal, on_floor = reading.towards, reading.kind == "linear"
            way = None if goal is None else math.hypot(*way_to(goal.bbox, grounding.bbox, on_floor))
            said = motions.quantities(words.quantities, way, grounding.bbox)
            return replace(
                reading,
                **dict(zip(("speed", "distance", "duration", "until"), said, strict=True)),
                steps=motions.step_readings(words.steps, grounding.bbox),
                others=motions.other_readings(words.others, scene, grounding),
            )

    def answer(
        self,
        given: base.ReaderInput,
        options: Sequence[records.AnswerOption],
        grounding: records.Grounding | None,
        imagined: base.Imagined | None,
        votes: int,
    ) -> tuple[base.AnswerReading, ...]:
        """The world's answer to the question, the same for every vote; not sure if it has none."""
        question = parse(given.question, names_of(given, grounding))
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


def names_of(given: base.ReaderInput, grounding: records.Grounding | None = None) -> tuple[str, ...]:
    """The names of the given things, or of those that were found."""
    found = () if grounding is None else (grounding.object, *(each.object for each in grounding.others))
    return tuple(each.object for each in given.known) or found


def _check_changes(question: Question, changes: Sequence[ChangeWords]) -> None:
    """Raises `CannotGround` if what is taken away moves or is asked about, or something is put into itself."""
    asked = question.asked
    about = () if asked is None else [name for name in (asked.subject, asked.target, *asked.among) if name is not None]
    for change in changes:
        name, is_removed = change.object.text, change.kind == "remove"
        if is_removed and (change.object == question.mover or any(same_name(each, name) for each in about)):
            raise CannotGround(f"The question takes '{name}' away and says or asks what it does: ask one of both.")
        if change.object in change.targets:
            raise CannotGround(f"The question puts '{name}' {change.relation} itself: name another thing.")


class _Finder:
    """Finds the things of one question: what is given under their words first, then what is seen."""

    def __init__(self, scene: Scene, known: Sequence[records.LocatedObject]) -> None:
        self.scene, self.regions = scene, tuple(scene.regions)
        self.known, self.taken = {each.object: each for each in known}, dict[str, records.BBox]()
        self._given = f" Given: {', '.join(self.known)}." if known else ""

    def without(self, boxes: Sequence[records.BBox]) -> tuple[Region, ...]:
        """The regions that are in none of some boxes."""
        return tuple(region for region in self.regions if not is_among(region.bbox, boxes))

    def mover(self, phrase: ObjectPhrase, names_arrow: bool) -> records.BBox:
        """The box of what moves. Raises `CannotGround`."""
        scene = self.scene
        if phrase.is_given:
            return self.known[phrase.text].bbox
        if phrase.inside_box:
            return matching.inside_drawn_box(scene, phrase)
        fitting = matching.best_matches(self.regions, phrase)
        if len(fitting) > 1 and (names_arrow or phrase.path_end == "start"):
            fitting = scene.at_arrow(fitting) or fitting
        if len(fitting) == 1 and noun_phrases.kind_of(phrase.text) is None:
            return fitting[0].bbox
        fault = f"What moves is not clear: {matching.unclear(phrase, scene.regions)}."
        if noun_phrases.kind_of(phrase.text) is not None:
            fault = f"The question moves '{phrase.text}' at once: ask of one thing, or name each."
        elif not scene.regions:
            fault = f"Looked for '{phrase.text}', but no objects could be told apart in the image."
        raise CannotGround(fault + self._given, remedy=LOCATE_IT)

    def found(self, phrase: ObjectPhrase, told: str, count: int | None = None) -> list[records.LocatedObject]:
        """One thing, or several such as "both cylinders". Raises `CannotGround`."""
        if phrase.is_given:
            return [self.known[phrase.text]]
        taken, kind = self.taken.get(phrase.text), noun_phrases.kind_of(phrase.text)
        free = self.without(list(self.taken.values()))
        if kind is not None and kind.count in (None, 2) and taken is None:
            kind = replace(kind, count=kind.count or count)
            things = matching.named_by_colour(matching.match_several(free, kind), kind)
        else:
            region = matching.match_one(free, phrase) if kind is None and taken is None else None
            box = region.bbox if region is not None else taken
            things = [records.LocatedObject(object=phrase.text, bbox=box, source="embedded")] if box else []
        if not things:
            why = matching.unclear(phrase, free)
            raise CannotGround(f"The question {told}, and {why}.{self._given}", remedy=GIVE_OBJECT)
        return things

    def placed(self, change: ChangeWords) -> records.Intervention:
        """What is put somewhere, and what it is put to. Raises `CannotGround`."""
        puts, found = f"puts '{change.object.text}'", list[records.LocatedObject]()
        for phrase in (change.object, *change.targets):
            found += self.found(phrase, puts, 2)
            self.taken[phrase.text] = found[-1].bbox
        if len(found) != (3 if change.relation == "between" else 2):
            raise CannotGround(f"The question {puts}, and between which things is not clear.", remedy=GIVE_OBJECT)
        return records.Intervention(kind="place", object=found[0], relation=change.relation, targets=tuple(found[1:]))
