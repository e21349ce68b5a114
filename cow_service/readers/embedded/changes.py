"""Finds what a question takes away or puts somewhere. It refuses if the object or its new place is not found."""

from collections.abc import Sequence

from cow_service.errors import CannotGround
from cow_service.narration.words import same_name
from cow_service.readers.embedded.english.asked import read_asked
from cow_service.readers.embedded.english.lexicon import ObjectPhrase
from cow_service.readers.embedded.english.noun_phrases import kind_of
from cow_service.readers.embedded.english.questions import Question
from cow_service.readers.embedded.matching import best_matches, match_one, match_several, unclear
from cow_service.readers.remedies import GIVE_OBJECT
from cow_service.records import BBox, Intervention, LocatedObject
from cow_service.vision.masks import is_among
from cow_service.vision.regions import Region
from cow_service.vision.scene import Scene


def check_changes(question: Question) -> None:
    """Raises `CannotGround` if the mover is taken away, or something is put into itself."""
    asked = read_asked(question)
    about = () if asked is None else [name for name in (asked.subject, asked.target, *asked.among) if name is not None]
    for change in question.interventions:
        name, is_removed = change.object.text, change.kind == "remove"
        if is_removed and (change.then_moves or change.object == question.mover):
            raise CannotGround(f"The question takes '{name}' away and says that it moves: ask one of both.")
        if is_removed and any(same_name(each, name) for each in about):
            raise CannotGround(f"The question takes '{name}' away and asks what becomes of it: ask one of both.")
        if change.object in change.targets:
            relation = change.relation or "beside"
            raise CannotGround(f"The question puts '{name}' {relation} itself: name another thing.")


def _is_plural(phrase: ObjectPhrase) -> bool:
    """ "Both mugs", "the mugs"."""
    last = phrase.text.lower().split()[-1]
    return phrase.text.lower().startswith("both ") or (last != phrase.head and last == f"{phrase.head}s")


def find_removed(scene: Scene, question: Question, given: Sequence[LocatedObject] = ()) -> tuple[Intervention, ...]:
    """What is taken away: `given` under that name, or where exactly one region fits. Raises `CannotGround`."""
    removed = [change.object for change in question.interventions if change.kind == "remove"]
    names = [each for each in (question.mover, *question.others, *removed) if each is not None and not _is_plural(each)]
    taken: list[LocatedObject] = []
    for phrase in removed:
        left = [each for each in scene.regions if all(each.bbox != one.bbox for one in taken)]
        others = [each for each in names if all(each.text != one.object for one in taken)]
        one = None if _is_plural(phrase) else _one(left, phrase, others, given)
        found = _both(left, phrase, others) if _is_plural(phrase) else [] if one is None else [one]
        if not found:
            raise _not_found(left, f"takes '{phrase.text}' away", phrase)
        taken += found
    return tuple(Intervention(kind="remove", object=each) for each in taken)


def given_as(phrase: ObjectPhrase, given: Sequence[LocatedObject]) -> LocatedObject | None:
    """The object that the caller gave under the words of a phrase."""
    return next((each for each in given if same_name(each.object, phrase.text)), None)


def _one(
    regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase], given: Sequence[LocatedObject]
) -> LocatedObject | None:
    """What was given under the words of a phrase, or the one region that fits them."""
    named, region = given_as(phrase, given), match_one(regions, phrase, others)
    return named or (None if region is None else _located(phrase.text, region.bbox))


def _both(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase]) -> list[LocatedObject]:
    """ "Both cylinders", each under its colour. Raises `CannotGround` for another number."""
    kind = kind_of(phrase.text)
    if kind is not None and kind.count not in (None, 2):
        raise CannotGround(f"The question changes '{phrase.text}' at once: name each of them.", remedy=GIVE_OBJECT)
    found = match_several(regions, phrase, others, 2)
    return [_located(f"{region.colour} {phrase.head or 'object'}", region.bbox) for region in found]


def without(regions: Sequence[Region], removed: Sequence[BBox]) -> tuple[Region, ...]:
    """The regions that remain without the objects in some boxes."""
    return tuple(region for region in regions if not is_among(region.bbox, removed))


def find_placed(
    scene: Scene,
    regions: Sequence[Region],
    question: Question,
    mover: tuple[ObjectPhrase, BBox],
    given: Sequence[LocatedObject] = (),
) -> tuple[Intervention, ...]:
    """What is put somewhere, and where; what is `given` under its name is not looked for. Raises `CannotGround`."""
    placed: list[Intervention] = []
    for change in question.interventions:
        if change.kind != "place":
            continue
        puts, others = f"puts '{change.object.text}'", [*question.others, change.object]
        known, found = [mover], list[LocatedObject]()
        # The object itself first, then the ones that it is put to.
        for phrase in (change.object, *change.targets):
            if found and _is_plural(phrase) and change.relation == "between":
                found += _both(without(regions, [found[0].bbox]), phrase, others)
                continue
            again = next((bbox for other, bbox in known if other == phrase), None)
            free = without(regions, [bbox for _, bbox in known])
            names = [each for each in others if all(each != other for other, _ in known)]
            thing = _one(free, phrase, names, given) if again is None else _located(phrase.text, again)
            if thing is None:
                where = f"{change.relation} '{phrase.text}'" if found else "somewhere"
                raise _not_found(free, f"{puts} {where}", phrase)
            found.append(thing)
            known.append((phrase, thing.bbox))
        if change.relation == "between" and len(found) != 3:
            raise _not_found(scene.regions, f"{puts} between", change.targets[0])
        targets = tuple(found[1:])
        placed.append(Intervention(kind="place", object=found[0], relation=change.relation, targets=targets))
    return tuple(placed)


def _located(name: str, bbox: BBox) -> LocatedObject:
    return LocatedObject(object=name, bbox=bbox, source="embedded")


def _not_found(regions: Sequence[Region], told: str, phrase: ObjectPhrase) -> CannotGround:
    why = unclear(phrase, best_matches(regions, phrase), regions)
    return CannotGround(f"The question {told}, and {why}.", remedy=GIVE_OBJECT)
