"""Cuts a sentence into noun phrases, quantities and the words between them; and what a noun says of a shape.

Nouns have no list. A phrase runs from its determiner up to a word that cannot be inside one: a function word, a verb
form, a direction behind the noun. Positions are those of the question's own characters.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Literal

from cow_service.readers.base import Likeness, Quantity, SpeedWord, Unit
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import Node, read_from, terminals
from cow_service.readers.embedded.english.lexicon import Item, ObjectPhrase, QuantityWords, key_at
from cow_service.readers.options import plain
from cow_service.records import Shape

_QUANTITY_WINDOW, _PLACE_WINDOW = 14, 9  # words
_MEASURES = frozenset({"_SLOWLY", "_QUICKLY", "_SECOND", "_TEMPO", "LENGTH"})  # terminals
_BARE = lex.words("width widths diameter diameters halfway midway until till push shove")  # measures, too
_ADJECTIVE_BEHIND = lex.DETERMINERS | lex.COLOURS.keys() | lex.SETS["adjectives"] | lex.words("how as so is are be")
_PARTS = {"half": 0.5, "halfway": 0.5, "twice": 2.0}


def _joined(found: Sequence[Item], join: Callable[[int], tuple[Item, int] | None]) -> list[Item]:
    """The items, some runs as one: `join` gives the one for a run that begins at a place, and the place behind it."""
    kept: list[Item] = []
    at = 0
    while at < len(found):
        item, at = join(at) or (found[at], at + 1)
        kept.append(item)
    return kept


def _with_quantities(found: Sequence[Item]) -> list[Item]:
    """The words of a question, each quantity in them joined to one item."""
    measures = [item.key[0].isdigit() or item.key in _BARE or bool(_MEASURES & terminals(item.key)) for item in found]

    def join(at: int) -> tuple[Item, int] | None:
        key, before = found[at].key, key_at(found, at - 1)
        adjective = key in {"slow", "fast", "hard", "halfway"} and before in _ADJECTIVE_BEHIND
        place = key in _PARTS and key_at(found, at + 1) == "between"
        if adjective or place or before == "number" or not any(measures[at : at + 8]):
            return None
        parsed = read_from("quantity", found, at, _QUANTITY_WINDOW)
        if parsed is None:
            return None
        tree, end = parsed
        words = tuple(item.key for item in found[at:end])
        return Item("~", found[at].start, found[end - 1].end, None, words, _read_quantity(tree)), end

    return _joined(found, join)


def _read_quantity(tree: Node) -> QuantityWords:
    names = tree.names
    part = next((_PARTS[name] for name in names if name in _PARTS), None)
    numeral = next((word.text for word in tree.words if word.text in lex.NUMERALS or word.text[0].isdigit()), None)
    number = part or (1.0 if numeral is None else float(lex.NUMERALS.get(numeral, numeral)))  # 1 for "a second"
    length = next((node.words[0].text for node in tree.find("length")), None)
    units: tuple[float, Unit, Unit] = (1.0, "px", "px/s")
    size, unit, per_second = (lex.METRES[length], "m", "m/s") if length in lex.METRES else units
    match names[1]:
        case "speed":
            pace: SpeedWord = "fast" if {"slow", "slowly"}.isdisjoint(names) else "slow"
            said = QuantityWords(speed=pace if length is None else Quantity(number * size, per_second))
        case "distance" if "own_width" in names:
            said = QuantityWords(own_widths=number)
        case "distance":
            said = QuantityWords(distance=Quantity(number * size, unit))
        case "until":
            said = QuantityWords(until="contact")
        case "limit":
            said = QuantityWords(within=number)
        case "duration":
            said = QuantityWords(duration=number)
        case _:
            said = QuantityWords(share=number)
    return said


MAX_WORDS = 12  # of one phrase; what is longer is no phrase
# Behind a noun they are no part of it: "the ball and the mug both move".
_BEHIND = lex.words(
    "safe both twice earlier later last hard all each together neither either nearest closest able farthest"
)
_NUMBERED = lex.words("with labeled labelled marked numbered bearing carrying saying called")
_FINITE_BE = lex.words("be is are was were 's")


def items(text: str) -> list[Item]:
    """Noun phrases and the words between them, in order."""
    found = list(_chunked(text, _with_quantities(lex.tokens(text))))

    def join(at: int) -> tuple[Item, int] | None:
        """Joins an object with the mark that singles it out: "the object inside the red box", "the ball labeled 3"."""
        end = at + 1
        while found[at].phrase and end < len(found) and end - at < 6 and found[end].key in lex.SETS["links"]:
            end += 1
        if not found[at].phrase or not at + 1 < end < len(found) or not found[end].phrase:
            return None
        marked = _with_mark(text, found[at], [link.key for link in found[at + 1 : end]], found[end])
        return None if marked is None else (marked, end + 1)

    return _joined(found, join)


def _chunked(text: str, found: Sequence[Item]) -> Iterator[Item]:
    """The items, noun phrases joined.

    `asked`: an auxiliary still waits for its verb, and only then can a verb behind a noun be in its base form.
    """
    at, verb, asked = 0, -1, False
    while at < len(found):
        first = at
        while first - at < 3 and _is_determiner(found, first):
            first += 1
        has_noun, end = False, first
        while end - first < MAX_WORDS and _belongs(found, end, at, first, has_noun, asked):
            key = key_at(found, end)
            has_noun = has_noun or not (lex.is_modifier(key) or key in lex.SETS["noun_modifiers"])
            end += 1
        if end == first or at == verb:
            yield found[at]
            key = found[at].key
            # "Is the mug hit?": a form of "be" that opens a clause waits for a participle.
            opens = key in {"is", "are", "was", "were"} and (at == 0 or found[at - 1].key in lex.PUNCTUATION)
            waits = key in lex.AUXILIARIES or key in lex.CAUSATIVES or opens
            asked = at != verb and (waits or (asked and key not in lex.ENDS and not lex.is_form(key, "base")))
            at += 1
            continue
        if _ends_in_unknown_verb(found, at, first, end, asked):
            end = verb = end - 1
        keys = tuple(item.key for item in found[at:end])
        start, stop = found[first].start, found[end - 1].end
        yield Item("", start, stop, lex.object_phrase(text[start:stop], keys[first - at :]), keys)
        at = end


def _is_determiner(found: Sequence[Item], at: int) -> bool:
    """A relative "that" or a bare "which" is no determiner: what follows it is no part of a noun phrase."""
    key, after = key_at(found, at), key_at(found, at + 1)
    closed = after in lex.CLOSED or after in lex.PUNCTUATION
    if key == "a":  # or the letter: "ball A moves"
        return not closed and not lex.is_form(after, "s")
    ambiguous = key in {"that", "this", "which", "what", "any", "some"}
    return key in lex.DETERMINERS and not (ambiguous and (closed or after in lex.VERBS))


def _belongs(found: Sequence[Item], at: int, start: int, first: int, has_noun: bool, asked: bool) -> bool:
    """Whether a word belongs to the phrase that begins at `start`, with determiners up to `first`."""
    key, before, after = (key_at(found, place) for place in (at, at - 1, at + 1))
    determined, inside = first > start, at > first
    if key == "and":
        return inside and not has_noun and before in lex.COLOURS and after in lex.COLOURS
    adverb = key == "first" or (len(key) > 4 and key.endswith("ly") and key not in lex.SETS["not_adverbs"])
    if key in lex.PLACES or key in {"one", "far", "can"}:
        return determined and not has_noun
    if has_noun:
        # "the mug 10 cm to the left": the measure is no part of the mug.
        measure = key[0].isdigit() and (not key.isdecimal() or after in lex.SETS["measures"])
        ends = measure or adverb or key in _BEHIND  # "will it hit the mug first?"
    else:
        ends = (at == start and key in {"both", "each"} and after in lex.VERBS) or (adverb and not determined)
    if ends or key in lex.PUNCTUATION or key in lex.CLOSED:
        return False
    return adverb or key not in lex.VERBS or _verb_belongs(found, at, has_noun, asked, determined or inside)


def _verb_belongs(found: Sequence[Item], at: int, has_noun: bool, asked: bool, begun: bool) -> bool:
    """Whether a verb's form is read as a noun or an adjective: "the travel mug", "the red block"."""
    verb, before, after = lex.VERBS[key_at(found, at)], key_at(found, at - 1), key_at(found, at + 1)
    closed = after in lex.PLACES or after in lex.CLOSED or after in lex.PUNCTUATION
    if begun and (closed or asked) and before in lex.PLACES:
        return False  # "the balls to the left move up"
    if not has_noun:
        if before in {"one", "two", "both"} and ((verb.form == "base" and asked) or (verb.form == "ing" and closed)):
            return False  # "will the two collide?", "any chance of those two running into each other?"
        if verb.form == "s" and before == "one":
            return False  # "the orange one slides"
        # "orange" is the one colour that is also a thing that moves: "the orange falls".
        return begun and not (verb.form == "s" and verb.kind is not None and before == "orange")
    if verb.form == "base":
        goes_on = verb.kind == "static" or verb.lemma in lex.SETS["weak"]  # "will the mug remain standing?"
        goes_on = goes_on and (after in {"put", "clear"} or lex.is_form(after, "ing"))
        return not asked or (not goes_on and (after in lex.VERBS or after in _FINITE_BE))
    return verb.form == "s" and after in {"are", "were"}


def _ends_in_unknown_verb(found: Sequence[Item], start: int, first: int, end: int, asked: bool) -> bool:
    """Verbs are a closed list here: one that is not in it is seen by its place, behind a noun that already stands."""
    last = key_at(found, end - 1)
    if end - first < 2 or lex.is_modifier(last) or lex.is_modifier(key_at(found, end - 2)):
        return False
    if asked:
        return _is_determiner(found, end)
    if key_at(found, start - 1) not in lex.CONDITIONALS or not last.endswith("s") or last.endswith("ss"):
        return False
    ahead = (item.key for item in found[end : end + 8])
    clause = takewhile(lambda key: key not in lex.PUNCTUATION and key not in lex.AUXILIARIES, ahead)
    return not any(word in lex.VERBS or word in lex.BE for word in clause)


def _with_mark(text: str, item: Item, links: Sequence[str], mark: Item) -> Item | None:
    noun, marking = item.phrase, mark.phrase
    if noun is None or marking is None or noun.noun is None or noun.head in lex.ABSTRACT:
        return None
    words = [word for word in mark.words if word not in lex.DETERMINERS]
    closing = text[mark.end : mark.end + 1].strip(" ,;:.!?")  # of a label in quotation marks
    quoted = closing in {"'", '"', "’", "”"}
    longer = replace(noun, text=" ".join(text[item.start : mark.end + quoted].split()))
    last, coloured = words[-1] if words else "", [word in lex.COLOURS for word in words]
    # "in the frame" is in the image; a frame with a colour is drawn.
    box = last in lex.SETS["mark_nouns"] and (last != "frame" or any(coloured))
    box = box and all(lex.is_modifier(word) or word == "bounding" for word in words[:-1])
    box = box and {"on", "of", "at"}.isdisjoint(links)
    if _NUMBERED.intersection(links) and (all(map(lex.is_count, words)) or len(last) == 1):
        longer = replace(longer, number=marking.number)
    elif box or (all(coloured) and lex.SETS["marked"].intersection(links)):
        longer = replace(longer, inside_box=True)
    elif links not in (["on"], ["at"], ["in"]) or any(word not in lex.PLACES and word != "far" for word in words):
        return None
    return replace(item, end=mark.end, phrase=longer)


def parse_noun_phrase(text: str) -> ObjectPhrase | None:
    """The first noun phrase of a text such as "the red toy car"; None if there is none."""
    found = items("the " + text.removeprefix("the "))
    phrase = next((item.phrase for item in found if item.phrase is not None), None)
    if phrase is not None and phrase.colour is None and phrase.noun in lex.COLOURS:
        return replace(phrase, colour=lex.COLOURS[phrase.noun])  # "the dark blue"
    return phrase


TABLES = lex.words("table desk tabletop")
_PLACE = lex.words(
    "on onto upon off across over along around above atop at from to in through within under beneath below underneath"
    " inside of leave leaves leaving"
)


def with_tables(found: Sequence[Item]) -> list[Item]:
    """The items; "the table" is a thing where no preposition makes it a place, and a wall where it has a colour."""
    kept = list(found)
    for at, item in enumerate(found):
        before, in_front = key_at(found, at - 1), key_at(found, at - 1) == "of" and key_at(found, at - 2) == "front"
        if item.phrase is None:
            continue
        is_table = item.phrase.head in TABLES and (before not in _PLACE or in_front)
        if is_table or (item.phrase.head == "wall" and item.phrase.colour is not None):
            kept[at] = replace(item, phrase=replace(item.phrase, as_thing=True))
    return kept


def table_at_end(found: Sequence[Item]) -> tuple[ObjectPhrase | None, str]:
    """The table of "will it land on the table", where a question ends so, and the word before it."""
    at = max((place for place, item in enumerate(found) if item.phrase is not None), default=-1)
    phrase = found[at].phrase if found else None
    return phrase if phrase is not None and phrase.head in TABLES else None, key_at(found, at - 1)


def with_nouns(found: Sequence[Item]) -> list[Item]:
    """The items, with references replaced by what they mean.

    "The red one" is of the kind that is asked for ("which cone", "which of the cones"), or of that of all things
    before it.
    """
    which = {("which",), ("what",)}
    asked = {
        _kind_of(item.phrase)
        for at, item in enumerate(found)
        if item.words[:1] in which or (key_at(found, at - 1) == "of" and (key_at(found, at - 2),) in which)
    } - {""}
    before: set[str] = set()
    said: list[Item] = []
    things: list[ObjectPhrase] = []
    for item in found:
        nouns, phrase, words = asked or before, item.phrase, item.words
        noun = next(iter(nouns)) if len(nouns) == 1 else ""
        bare = phrase is not None and phrase.text.lower() == phrase.noun
        last = next((each for each in reversed(things) if phrase is not None and each.noun == phrase.noun), None)
        if words[:1] == ("that",) and bare and last is not None:  # "That mug": the mug that was named last.
            said.append(replace(item, phrase=last, words=("that", *last.text.split())))
            continue
        if item.thing is not None:
            things.append(item.thing)
        # "The red one", "the left one".
        one = words[-1:] == ("one",)
        if phrase is not None and phrase.noun is None and noun and (phrase.colour or (one and len(phrase.words) > 1)):
            text = [noun if word == "one" else word for word in phrase.text.split()]
            text += [] if "one" in phrase.text.split() else [noun]
            said.append(replace(item, phrase=replace(phrase, text=" ".join(text), noun=noun)))
        else:
            said.append(item)
            before |= {_kind_of(phrase)} - {""}
    return said


def _kind_of(phrase: ObjectPhrase | None) -> str:
    """The noun of a phrase that names a thing by one; empty otherwise."""
    named = phrase is not None and phrase.is_thing and phrase.head not in lex.GENERIC | lex.AGENTS
    return phrase.noun or "" if phrase is not None and named else ""


_PUTS = lex.words("put place insert set position lower stand stick pop plonk plop")


def with_places(found: Sequence[Item]) -> list[Item]:
    """The items, each object joined with the words after it about its place."""
    texts = [item.phrase.text.lower() for item in found if item.phrase is not None]

    def join(at: int) -> tuple[Item, int] | None:
        item, verb, after = found[at], lex.VERBS.get(key_at(found, at - 1)), key_at(found, at + 1)
        thing = item.thing
        if thing is None or at + 1 == len(found):
            return None
        # "Push the ball behind the mug", "put the ball on the mug": a destination, not where it is.
        moved = lex.moves(verb) or (verb is not None and verb.lemma in _PUTS)
        if moved and after not in {"that", "which", ","}:
            return None
        if (parsed := read_from("place", found, at + 1, _PLACE_WINDOW)) is None:
            return None
        tree, end = parsed
        other = next((found[word.at] for word in tree.words), None)
        if other is not None and other.thing is None:
            return None
        end += after == "," and key_at(found, end) == ","
        words = " ".join(" ".join(each.words) or each.key for each in found[at + 1 : end])
        text = f"{thing.text} {words}" if texts.count(thing.text.lower()) > 1 else thing.text
        relation = next(name for name in tree.names if name.endswith("_it")).removesuffix("_it")
        place = lex.PlaceWords(relation, None if other is None else other.thing)
        return replace(item, end=found[end - 1].end, phrase=replace(thing, text=text, place=place)), end

    return _joined(found, join)


_NOUNS = {shape: lex.words(text) for shape, text in lex.TABLES["shapes"].items()}
_SHAPES: dict[Shape, frozenset[str]] = {
    "sphere": _NOUNS["sphere"], "box": _NOUNS["box"] | _NOUNS["vehicle"], "cone": _NOUNS["cone"],
    "cylinder": _NOUNS["cylinder"],
}  # fmt: skip


def _head(name: str) -> str | None:
    phrase = parse_noun_phrase(name)
    return None if phrase is None else phrase.head


def shape_of(name: str) -> Shape | None:
    """The shape of what is called so; None if the noun does not say."""
    head = _head(name)
    return next((shape for shape, nouns in _SHAPES.items() if head in nouns), None)


def is_vehicle(name: str) -> bool:
    """Whether it is longer along its heading than across."""
    return _head(name) in _NOUNS["vehicle"]


def is_cube(name: str) -> bool:
    """Whether it is a box as wide as high."""
    return _head(name) in _NOUNS["cube"]


_SAID = lex.words("any every each all no none some many a an both either neither other the")


@dataclass(frozen=True)
class Kind:
    """What one of the things is called, and how many there are, where that is said."""

    phrase: ObjectPhrase
    count: int | None


def kind_of(name: str) -> Kind | None:
    """The kind that a name such as "both mugs" or "mugs" is of; None for the name of one thing."""
    said = name.lower().split()
    numbers = dict.fromkeys(("both", "either", "neither"), 2) | lex.NUMBER_WORDS
    counts = [int(word) if word.isdecimal() else numbers[word] for word in said if word.isdecimal() or word in numbers]
    rest = [word for word in said if word not in _SAID | numbers.keys() and not word.isdecimal()]
    head = lex.singular(rest[-1]) if rest else ""
    if not rest or (said[0] not in _SAID - {"the", "other"} and head == rest[-1]):
        return None
    phrase = parse_noun_phrase(" ".join([*rest[:-1], head]))
    return None if phrase is None else Kind(phrase, counts[0] if counts else None)


ContainerForm = Literal["round", "square", "none", "unknown"]


def container_form(name: str) -> ContainerForm:
    """Round or square for what is called a container, `none` for a solid thing, `unknown` where the noun says nothing.

    A box is a container: a question about a solid one would not ask what goes into it.
    """
    head = _head(name)
    if head in lex.SETS["round"]:
        return "round"
    if head in _NOUNS["square"]:
        return "square"
    return "unknown" if shape_of(name) is None else "none"


def may_name(phrase: ObjectPhrase, name: str) -> bool:
    """Whether a phrase may mean the object of that name: they share a colour, noun or number, and differ in none."""
    other = parse_noun_phrase(name)
    if other is None:
        return False
    if plain(phrase.text) == plain(name):
        return True
    nouns = [each.head if each.head not in lex.GENERIC else None for each in (phrase, other)]
    pairs = ((phrase.colour, other.colour), tuple(nouns), (phrase.number, other.number))
    said = [(one, two) for one, two in pairs if one is not None and two is not None]
    return bool(said) and all(one == two for one, two in said)


def likeness(words: str, name: str) -> Likeness:
    """Whether a phrase means the thing of a name; see `WordReader.likeness`."""
    phrase, other = parse_noun_phrase(words), parse_noun_phrase(name)
    if phrase is None or other is None:
        return "same" if plain(words) == plain(name) else "unknown"
    shapes = (shape_of(words), shape_of(name))
    differ = [(phrase.colour, other.colour), (phrase.number, other.number), shapes]
    if any(one is not None and two is not None and one != two for one, two in differ):
        return "other"
    return "same" if may_name(phrase, name) else "unknown"
