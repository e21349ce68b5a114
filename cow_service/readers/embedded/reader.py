"""The reader without weights: sentence forms for the question, classical vision for the image. It never guesses."""

from collections.abc import Sequence
from dataclasses import replace

from cow_service import __version__, records
from cow_service.errors import CannotGround
from cow_service.media.masks import is_among, is_same_object
from cow_service.narration.words import phrases_of, same_name
from cow_service.perception.base import Thing
from cow_service.perception.observation import Observation
from cow_service.readers import base
from cow_service.readers.base import GIVE_OBJECT, GIVE_PLACE
from cow_service.readers.embedded import matching, motions
from cow_service.readers.embedded.answers import MAX_UNREAD, answer_from
from cow_service.readers.embedded.english import noun_phrases
from cow_service.readers.embedded.english.lexicon import ObjectPhrase
from cow_service.readers.embedded.english.questions import ChangeWords, Question, parse, rewordings
from cow_service.readers.options import plain
from cow_service.settings import Settings

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

    def read_question(self, question: str, names: Sequence[str] = ()) -> base.WordsReading:
        """What the sentence forms read; things that are given under one of the names have it."""
        read = parse(question, tuple(names))
        said, mover = read.motion, None if read.asked is None or read.mover is None else read.mover.text
        way = {} if read.unread_motion or said.is_contradictory else motions.said_way(said, said.kind or "linear")
        kind = motions.settled_kind(read)
        return base.WordsReading(
            # Not checked: the stage tells what is wrong with a change that cannot be made.
            records.Reading.model_construct(
                grounding=None if mover is None else records.GroundingRequest(object=mover),
                motion=records.MotionRequest.model_validate({"kind": kind, **way}),
                objects=tuple(records.ObjectRequest(object=each.text) for each in read.others[: records.MAX_OBJECTS]),
                interventions=changes_of(read.changes),
                asked=read.asked,
            ),
            is_whole=kind is not None,
            trail_named=said.trail,
            nouns=matching.nouns_of(read),
            drawings_named=frozenset(each for each in ("arrow", "box") if each in question.lower()),
        )

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

    def read(self, given: base.ReaderInput) -> base.ReadResult:
        """The thing that fits the mover's words, or what is given under them, and its motion in words.

        Raises `CannotGround`, `CannotReadDirection`.
        """
        question = parse(given.question, names_of(given))
        mover, place, is_open = question.mover, given.given.grounding, given.motion_wanted
        is_placed = place is not None and place.has_place  # of such a thing a drawn arrow tells the motion, too
        if not is_placed and (mover is None or (is_open and not question.says_motion)):
            words = ("', '".join(question.unread) or given.question)[:MAX_UNREAD]
            like = " Or: ".join(rewordings(question) or ("If the red ball moves to the left, will it hit the vase?",))
            fault = (
                f"What moves and how is not said in words that the embedded reader knows: '{words}'; it reads English."
            )
            raise CannotGround(f"{fault} Ask like: {like}", remedy=LOCATE_IT)
        with given.cpu():
            observation, found = given.seen, base.ReadResult(records.Reading(grounding=place))
            if not is_placed and mover is not None:
                observation, found = self._located(given, question, mover)
            if not is_open or found.reading.grounding is None:
                return base.ReadResult() if is_placed else found
            things = (*given.known, *found.reading.objects)
            motion = motions.read_motion(question, observation, found.reading.grounding, things)
        update = {"motion": motion} | ({"grounding": None} if is_placed else {})
        return replace(found, reading=found.reading.model_copy(update=update))

    def _located(
        self, given: base.ReaderInput, question: Question, mover: ObjectPhrase
    ) -> tuple[Observation, base.ReadResult]:
        """Where the things are, and what is changed and asked; with trails that end as is said."""
        changes = question.changes if given.given.interventions is None else ()
        _check_changes(question, changes)
        observation, warnings = motions.with_trail_as_said(given.seen, question)
        if given.find is not None and observation.side_view is None:
            observation = observation.with_found(given.find(matching.nouns_of(question, given.sought)))
        finder = _Finder(observation, given.known)
        bbox, changed = finder.changed(changes, mover, question.names_arrow)
        named, things, unclear = finder.others(question, given, bbox)
        is_told = given.given.asked is None or given.given.interventions is None
        doubts, doubtful = matching.noun_doubts(observation, [*named, *([] if mover.is_given else [(mover, bbox)])])
        left = question.unread if is_told else ()
        own = finder.known.get(mover.text) or records.GroundingRequest()
        # A thing has one name: that under which it is asked about goes before that of a change.
        beside = {each.bbox: each for each in reversed([*things, *(thing for _, all in changed for thing in all)])}
        beside.pop(bbox, None)
        names = {each: thing.object for each, thing in beside.items()} | {bbox: mover.text}
        known = {each.object for each in given.known}
        reading = records.Reading(
            grounding=records.GroundingRequest(
                **own.model_dump(include={"shape", "size", "stands_on"}),
                object=mover.text,
                bbox=bbox,
                is_doubtful=bbox in doubtful or own.is_doubtful or bool(left and given.given.asked is not None),
            ),
            objects=tuple(
                thing.model_copy(update={"is_doubtful": box in doubtful})
                for box, thing in reversed(beside.items())
                if thing.object not in known
            )[: records.MAX_OBJECTS],
            interventions=tuple(
                records.InterventionRequest(
                    kind=change.kind,
                    object=names[each.bbox],
                    relation=change.relation,
                    targets=tuple(names[target.bbox] for target in targets),
                )
                for change, (each, *targets) in changed
            ),
            asked=question.asked if given.given.asked is None else None,
        )
        told = (f"The words '{each}' were not understood, so no outcome is sure." for each in left)
        return observation, base.ReadResult(reading, (*warnings, *(unclear if is_told else ()), *doubts, *told))

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


def changes_of(changes: Sequence[ChangeWords]) -> tuple[records.InterventionRequest, ...]:
    """The changes by the names of their things; not checked, as one phrase may mean two: "between both mugs"."""
    return tuple(
        records.InterventionRequest.model_construct(
            kind=each.kind,
            object=each.object.text,
            relation=each.relation,
            targets=tuple(target.text for target in each.targets),
        )
        for each in changes
        if each.kind == "remove" or each.targets
    )


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
        if len(set(change.targets)) < len(change.targets):
            raise CannotGround(f"The question puts '{name}' {change.relation} one thing: name another one, too.")


class _Finder:
    """Finds the things of one question: what is given under their words first, then what is seen."""

    def __init__(self, observation: Observation, known: Sequence[records.ObjectRequest]) -> None:
        self.observation, self.seen = observation, tuple(observation.things)
        self.known, self.taken = {each.object: each for each in known}, dict[str, records.BBox]()
        self._given = f" Given: {', '.join(self.known)}." if known else ""

    def without(self, boxes: Sequence[records.BBox]) -> tuple[Thing, ...]:
        """The things that are in none of some boxes."""
        return tuple(thing for thing in self.seen if not is_among(thing.bbox, boxes))

    def mover(self, phrase: ObjectPhrase, names_arrow: bool) -> records.BBox:
        """The box of what moves. Raises `CannotGround`."""
        observation = self.observation
        if phrase.is_given:
            return self.known[phrase.text].bbox or (0.0, 0.0, 0.0, 0.0)
        if phrase.inside_box:
            return matching.inside_drawn_box(observation, phrase)
        fitting = matching.best_matches(self.seen, phrase)
        if len(fitting) > 1 and (names_arrow or phrase.path_end == "start"):
            fitting = observation.at_arrow(fitting) or fitting
        if len(fitting) == 1 and noun_phrases.kind_of(phrase.text) is None:
            return fitting[0].bbox
        fault = f"What moves is not clear: {matching.unclear(phrase, observation.things)}."
        if noun_phrases.kind_of(phrase.text) is not None:
            fault = f"The question moves '{phrase.text}' at once: ask of one thing, or name each."
        elif not observation.things:
            fault = f"Looked for '{phrase.text}', but no objects could be told apart in the image."
        raise CannotGround(fault + self._given, remedy=LOCATE_IT)

    def changed(
        self, changes: Sequence[ChangeWords], mover: ObjectPhrase, names_arrow: bool
    ) -> tuple[records.BBox, list[tuple[ChangeWords, list[records.ObjectRequest]]]]:
        """The box of what moves, and each change with what it changes and what that is put to. Raises `CannotGround`.

        What is taken away is found first: it is none of the others.
        """
        changed = list[tuple[ChangeWords, list[records.ObjectRequest]]]()
        for change in (each for each in changes if each.kind == "remove"):
            things = self._found(change.object, f"takes '{change.object.text}' away")
            changed += [(change, [thing]) for thing in things]
        gone = [thing.bbox for _, (thing,) in changed if thing.bbox is not None]
        self.seen = self.without(gone)
        bbox = self.mover(mover, names_arrow)
        self.taken = {mover.text: bbox}
        for change in (each for each in changes if each.kind == "place" and each.targets):
            puts, things = f"puts '{change.object.text}'", list[records.ObjectRequest]()
            for phrase in (change.object, *change.targets):
                things += self._found(phrase, puts, 2)
                self.taken[phrase.text] = things[-1].bbox or bbox
            if len(things) != (3 if change.relation == "between" else 2):
                raise CannotGround(f"The question {puts}, and between which things is not clear.", remedy=GIVE_OBJECT)
            changed.append((change, things))
        return bbox, changed

    def others(
        self, question: Question, given: base.ReaderInput, bbox: records.BBox
    ) -> tuple[list[tuple[ObjectPhrase, records.BBox]], list[records.ObjectRequest], list[str]]:
        """The other things that the question names, each with its box; all that are located; and what is unclear.

        Located are also those of the kinds that are asked about, and those that the caller wants under other words.
        """
        words = [phrase.text for phrase in (question.mover, *question.others) if phrase is not None]
        sought = [name for name in given.sought if not any(same_name(name, each) for each in words)]
        parsed = [(name, noun_phrases.parse_noun_phrase(name)) for name in sought]
        wanted = [*question.others, *(replace(phrase, text=name) for name, phrase in parsed if phrase is not None)]
        # An object outlined by models is separate, even if its box is nearly that of the mover in front of it.
        apart = [each for each in self.seen if each.bbox != bbox]
        beside = [each for each in apart if each.called or not is_same_object(each.bbox, bbox)]
        alone = beside[0] if len(beside) == 1 else None
        fitting = [
            (each, alone if each.is_other else matching.match_one(beside, each)) for each in wanted if not each.is_given
        ]
        of_kinds = matching.things_of_kinds(self.seen, question, bbox, given.known)
        seen = [records.ObjectRequest(object=phrase.text, bbox=each.bbox) for phrase, each in fitting if each]
        unclear = [
            f"{matching.unclear(phrase, beside)}. No encounter is listed under that name."
            for phrase, each in fitting
            if each is None and phrase in question.others
        ]
        named = [(phrase, each.bbox) for phrase, each in fitting if each is not None and phrase in question.others]
        return named, [*of_kinds, *seen], unclear

    def _found(self, phrase: ObjectPhrase, told: str, count: int | None = None) -> list[records.ObjectRequest]:
        """One thing, or several such as "both cylinders". Raises `CannotGround`."""
        if phrase.is_given:
            return [self.known[phrase.text]]
        taken, kind = self.taken.get(phrase.text), noun_phrases.kind_of(phrase.text)
        free = self.without(list(self.taken.values()))
        if kind is not None and kind.count in (None, 2) and taken is None:
            kind = replace(kind, count=kind.count or count)
            things = matching.named_by_colour(matching.match_several(free, kind), kind, self.taken)
        else:
            thing = matching.match_one(free, phrase) if kind is None and taken is None else None
            box = thing.bbox if thing is not None else taken
            things = [records.ObjectRequest(object=phrase.text, bbox=box)] if box else []
        if not things:
            why = matching.unclear(phrase, free)
            raise CannotGround(f"The question {told}, and {why}.{self._given}", remedy=GIVE_OBJECT)
        return things
