"""Cuts a sentence into noun phrases and the words between them, without a list of nouns.

A phrase runs from its determiner up to a word that cannot be inside one: a function word, a verb form, a direction
behind the noun. Positions are those of the question's own characters.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import takewhile

from lark import Token, Tree

from cow_service.readers.base import Quantity, SpeedWord, Unit
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import may_begin, parse_from, read_from, terminals
from cow_service.readers.embedded.english.lexicon import (
    PUNCTUATION,
    QUANTITY,
    Item,
    ObjectPhrase,
    PlaceWords,
    QuantityWords,
    Word,
    is_count,
    key_at,
    object_phrase,
    plain_words,
    tokens,
)

_WINDOW = 12  # words
_MAX_TRIES = 6  # of one question: each takes some ms
_MEASURES = frozenset({"_SLOWLY", "_QUICKLY", "_SECOND", "_TEMPO", "LENGTH", "WIDTH"})  # terminals
_BARE = lex.words("width diameter height halfway midway way until till push shove")  # measures, too
_ADJECTIVE_BEHIND = lex.DETERMINERS | lex.COLOURS.keys() | lex.ADJECTIVES | lex.words("how as so is are be")
_NUMERALS = lex.NUMBER_WORDS | {"twenty": 20, "thirty": 30, "forty": 40, "fifty": 50, "sixty": 60, "hundred": 100}
_PARTS = {"half": 0.5, "halfway": 0.5, "quarter": 0.25, "third": 1 / 3, "two_thirds": 2 / 3, "twice": 2.0}
_WITH_UNIT = re.compile(r"(\d+(?:\.\d+)?)([a-z]+)")


def with_quantities(found: Sequence[Item]) -> list[Item]:
    """The words of a question, each quantity in them joined to one item."""
    joined: list[Item] = []
    at = tries = 0
    while at < len(found):
        read = None
        if tries < _MAX_TRIES and _may_start(found, at):
            tries += 1
            read = _read(found, at)
        if read is None:
            joined.append(found[at])
            at += 1
        else:
            quantity, end = read
            words = tuple(item.key for item in found[at:end])
            joined.append(Item(QUANTITY, found[at].start, found[end - 1].end, None, words, quantity))
            at = end
    return joined


def _may_start(found: Sequence[Item], at: int) -> bool:
    key, before = found[at].key, found[at - 1].key if at else ""
    if (key in {"slow", "fast", "hard", "halfway"} and before in _ADJECTIVE_BEHIND) or before == "number":
        return False
    if key in _PARTS and key_at(found, at + 1) == "between":
        return False
    measured = any(
        each.key in _BARE or _WITH_UNIT.fullmatch(each.key) or not _MEASURES.isdisjoint(terminals(each.key))
        for each in found[at : at + 8]
    )
    return measured and may_begin("quantity", _words(key, at)[0])


def _read(found: Sequence[Item], at: int) -> tuple[QuantityWords, int] | None:
    """The quantity that begins at a place, and the place behind it."""
    words = [word for place in range(at, min(at + _WINDOW, len(found))) for word in _words(found[place].key, place)]
    parsed = parse_from("quantity", words)
    if parsed is None:
        return None
    tree, length = parsed
    end = words[length].at if length < len(words) else words[-1].at + 1
    return _quantity(tree), end


def _words(key: str, at: int) -> list[Word]:
    joined = _WITH_UNIT.fullmatch(key)
    if joined is not None:
        return [Word("NUMBER", joined[1], at), Word("", joined[2], at)]
    if key in _NUMERALS or re.fullmatch(r"[0-9]+(\.[0-9]+)?", key):
        return [Word("NUMBER", key, at)]
    return plain_words([key], at)


def _quantity(tree: Tree[Token]) -> QuantityWords:
    kind = tree.children[0]
    assert isinstance(kind, Tree)
    number, length = _number(kind), _length(kind)
    own = next(kind.find_pred(lambda node: node.data in {"own_width", "own_height"}), None)
    until = "contact" if list(kind.find_data("contact")) else "out-of-view"
    match kind.data:
        case "speed":
            return QuantityWords(speed=_speed(kind, number, length))
        case "limit":
            return QuantityWords(within=number)
        case "duration":
            return QuantityWords(duration=number)
        case "distance" if own is not None:
            wide = own.data == "own_width"
            return QuantityWords(own_widths=number) if wide else QuantityWords(own_heights=number)
        case "distance":
            value, unit = length or (1.0, "widths")
            return QuantityWords(distance=Quantity(number * value, unit))
        case _:
            return QuantityWords(share=number) if kind.data == "share" else QuantityWords(until=until)


def _speed(kind: Tree[Token], number: float, length: tuple[float, Unit] | None) -> SpeedWord | Quantity:
    if length is None:
        return "slow" if any(node.data in {"slow", "slowly"} for node in kind.iter_subtrees()) else "fast"
    value, unit = length
    per_second: dict[str, Unit] = {"px": "px/s", "m": "m/s", "widths": "widths/s"}
    return Quantity(number * value, per_second[unit])


def _number(tree: Tree[Token]) -> float:
    """The number of a quantity; 1 for "a second"."""
    part = next((_PARTS[str(node.data)] for node in tree.iter_subtrees() if node.data in _PARTS), None)
    if part is not None:
        return part
    said = [str(token) for token in tree.scan_values(lambda value: isinstance(value, Token)) if token.type == "NUMBER"]
    value = float(_NUMERALS.get(said[0]) or said[0]) if said else 1.0
    return value + 0.5 if list(tree.find_data("plus_half")) else value


def _length(tree: Tree[Token]) -> tuple[float, Unit] | None:
    """The size of a unit of length in the unit of a `Quantity`; None where there is none."""
    node = next(tree.find_data("length"), None)
    if node is None:
        return None
    unit = str(node.children[0])
    if unit.startswith("width"):
        return 1.0, "widths"
    return (1.0, "px") if unit.startswith("p") else (lex.METRES[unit], "m")


MAX_WORDS = 12  # of one phrase; what is longer is no phrase
_LINKS = lex.SETS["links"]
# Behind a noun they are no part of it: "the ball and the mug both move".
_BEHIND = lex.words(
    "safe both twice earlier later last hard all each together neither either nearest closest able farthest"
)
_CLOSED = lex.FUNCTION_WORDS | lex.DETERMINERS
_NUMBERED = lex.words("with labeled labelled marked numbered bearing carrying saying called")
_FINITE_BE = lex.words("be is are was were 's")


def items(text: str) -> list[Item]:
    """Noun phrases and the words between them, in order."""
    found = with_quantities(tokens(text))
    return list(_with_marks(text, list(_chunked(text, found))))


def _chunked(text: str, found: Sequence[Item]) -> Iterator[Item]:
    at, verb, asked = 0, -1, False
    while at < len(found):
        first, end = _phrase_span(found, at, asked)
        if end == first or at == verb:
            yield found[at]
            asked = at != verb and (_still_asked(found[at].key, asked) or _asks_state(found, at))
            at += 1
            continue
        if _ends_in_unknown_verb(found, at, first, end, asked):
            end = verb = end - 1
        keys = tuple(item.key for item in found[at:end])
        start, stop = found[first].start, found[end - 1].end
        phrase = object_phrase(text[start:stop], tuple(item.key for item in found[first:end]))
        yield Item("", start, stop, phrase, keys)
        at = end


def _is_determiner(found: Sequence[Item], at: int) -> bool:
    """A relative "that" or a bare "which" is no determiner: what follows it is no part of a noun phrase."""
    key, after = key_at(found, at), key_at(found, at + 1)
    if key not in lex.DETERMINERS:
        return False
    if key == "a":  # or the letter: "ball A moves"
        return not (after in _CLOSED or after in PUNCTUATION or (after in lex.VERBS and lex.VERBS[after].form == "s"))
    ambiguous = key in {"that", "this", "which", "what", "any", "some"}
    return not ambiguous or not (
        after in lex.VERBS or after in lex.FUNCTION_WORDS or after in lex.DETERMINERS or after in PUNCTUATION
    )


def _phrase_span(found: Sequence[Item], at: int, asked: bool) -> tuple[int, int]:
    """First word behind the determiners, and one past the last word; equal where no phrase begins here."""
    first = at
    while first - at < 3 and _is_determiner(found, first):
        first += 1
    has_noun, end = False, first
    while end - first < MAX_WORDS and _belongs(found, end, at, first, has_noun, asked):
        key = key_at(found, end)
        has_noun = has_noun or not (lex.is_modifier(key) or key in lex.NOUN_MODIFIERS)
        end += 1
    return first, end


def _still_asked(key: str, asked: bool) -> bool:
    """Whether an auxiliary still waits for its verb: only then can a verb behind a noun be in its base form."""
    if key in lex.AUXILIARIES or key in lex.CAUSATIVES:
        return True
    done = key in {".", "?", "!", ";"} or (key in lex.VERBS and lex.VERBS[key].form == "base")
    return asked and not done


def _asks_state(found: Sequence[Item], at: int) -> bool:
    """ "Is the mug hit?": a form of "be" that opens a clause waits for a participle."""
    return found[at].key in {"is", "are", "was", "were"} and (at == 0 or found[at - 1].key in PUNCTUATION)


def _belongs(found: Sequence[Item], at: int, start: int, first: int, has_noun: bool, asked: bool) -> bool:
    key, determined, inside = key_at(found, at), first > start, at > first
    if key == "and":
        return inside and not has_noun and key_at(found, at - 1) in lex.COLOURS and key_at(found, at + 1) in lex.COLOURS
    if key == "a" and (inside or key_at(found, at - 1) in _NUMBERED):
        return not _is_determiner(found, at)
    if key in lex.PLACES or key in {"one", "far", "can"}:
        return determined and not has_noun
    behind = (has_noun and key in _BEHIND) or _is_measure(found, at, has_noun)
    if key in PUNCTUATION or key in _CLOSED or behind or _is_shared_verb(found, at, start, has_noun):
        return False
    if lex.is_adverb(key) or key == "first":  # "will it hit the mug first?"
        return determined and not has_noun
    return key not in lex.VERBS or _verb_belongs(found, at, has_noun, asked, determined or inside)


def _is_shared_verb(found: Sequence[Item], at: int, start: int, has_noun: bool) -> bool:
    """ "The ball and the mug (both) move to the right": a verb of two subjects is in its base form."""
    if not has_noun:
        return at == start and key_at(found, at) in {"both", "each"} and key_at(found, at + 1) in lex.VERBS
    verb, after = lex.VERBS.get(key_at(found, at)), key_at(found, at + 1)
    moves = verb is not None and verb.form == "base" and verb.kind not in {None, "static"}
    return moves and key_at(found, start - 1) == "and" and (after in lex.PLACES or after in _CLOSED)


def _is_measure(found: Sequence[Item], at: int, has_noun: bool) -> bool:
    """ "the mug 10 cm to the left": the measure is no part of the mug."""
    key = key_at(found, at)
    return has_noun and key[0].isdigit() and (not key.isdecimal() or key_at(found, at + 1) in lex.MEASURES)


def _verb_belongs(found: Sequence[Item], at: int, has_noun: bool, asked: bool, begun: bool) -> bool:
    """Whether a verb's form is read as a noun or an adjective: "the travel mug", "the red block"."""
    verb, after = lex.VERBS[key_at(found, at)], key_at(found, at + 1)
    closed = after in lex.PLACES or after in _CLOSED or after in PUNCTUATION
    if begun and (closed or asked) and key_at(found, at - 1) in lex.PLACES:
        return False  # "the balls to the left move up"
    if not has_noun:
        before = key_at(found, at - 1)
        if before in {"one", "two", "both"} and ((verb.form == "base" and asked) or (verb.form == "ing" and closed)):
            return False  # "will the two collide?", "any chance of those two running into each other?"
        if verb.form == "s" and before == "one":
            return False  # "the orange one slides"
        begun = begun or (verb.form == "base" and _is_label(found, at + 1))
        # "orange" is the one colour that is also a thing that moves: "the orange falls".
        return begun and not (verb.form == "s" and verb.kind is not None and before == "orange")
    going = after in {"put", "clear"} or (after in lex.VERBS and lex.VERBS[after].form == "ing")
    goes_on = going and (verb.kind == "static" or verb.lemma in lex.WEAK)  # "will the mug remain standing?"
    if verb.form == "base":
        return not asked or (not goes_on and (after in lex.VERBS or after in _FINITE_BE))
    return verb.form == "s" and after in {"are", "were"}


def _in_clause(key: str) -> bool:
    return key not in PUNCTUATION and key not in lex.AUXILIARIES


def _is_label(found: Sequence[Item], at: int) -> bool:
    """ "block 3", "block C"; but not "hit 3 balls", where a noun follows the number."""
    key, after = key_at(found, at), key_at(found, at + 1)
    ended = after in PUNCTUATION or after in _CLOSED or after in lex.VERBS or after in lex.PLACES
    return ended and (key.isdecimal() or (len(key) == 1 and key.isalpha() and key not in _CLOSED))


def _ends_in_unknown_verb(found: Sequence[Item], start: int, first: int, end: int, asked: bool) -> bool:
    """Verbs are a closed list here: one that is not in it is seen by its place, behind a noun that already stands."""
    last = key_at(found, end - 1)
    if end - first < 2 or lex.is_modifier(last) or lex.is_modifier(key_at(found, end - 2)):
        return False
    if asked:
        return _is_determiner(found, end)
    if key_at(found, start - 1) not in lex.CONDITIONALS or not last.endswith("s") or last.endswith("ss"):
        return False
    ahead = list(takewhile(_in_clause, (item.key for item in found[end : end + 8])))
    return not any(word in lex.VERBS or word in lex.BE for word in ahead)


def _with_marks(text: str, found: list[Item]) -> Iterator[Item]:
    """Joins an object with the mark that singles it out: "the object inside the red box", "the ball labeled 3"."""
    at = 0
    while at < len(found):
        item, end = found[at], at + 1
        while item.phrase and end < len(found) and end - at < 6 and found[end].key in _LINKS:
            end += 1
        if item.phrase and at + 1 < end < len(found) and found[end].phrase:
            joined = _joined(text, item, [link.key for link in found[at + 1 : end]], found[end])
            if joined:
                yield joined
                at = end + 1
                continue
        yield item
        at += 1


def _joined(text: str, item: Item, links: Sequence[str], mark: Item) -> Item | None:
    noun, marking = item.phrase, mark.phrase
    if noun is None or marking is None or noun.noun is None or noun.head in lex.ABSTRACT:
        return None
    words = [word for word in mark.words if word not in lex.DETERMINERS]
    closing = text[mark.end : mark.end + 1].strip(" ,;:.!?")  # of a label in quotation marks
    quoted = closing in {"'", '"', "’", "”"}
    longer = replace(noun, text=" ".join(text[item.start : mark.end + quoted].split()))
    if _NUMBERED.intersection(links) and (all(is_count(word) for word in words) or len(words[-1]) == 1):
        return replace(item, end=mark.end, phrase=replace(longer, number=marking.number))
    colour_only = all(word in lex.COLOURS for word in words)
    drawn = all(lex.is_modifier(word) or word in {"bounding"} for word in words[:-1])
    if drawn and _is_box(words) and not {"on", "of", "at"}.intersection(links):
        return replace(item, end=mark.end, phrase=replace(longer, inside_box=True))
    if colour_only and lex.MARKED.intersection(links):
        return replace(item, end=mark.end, phrase=replace(longer, inside_box=True))
    if links in (["on"], ["at"], ["in"]) and all(word in lex.PLACES or word == "far" for word in words):
        return replace(item, end=mark.end, phrase=longer)
    return None


def _is_box(words: Sequence[str]) -> bool:
    # "in the frame" is in the image; a frame with a colour is drawn.
    return words[-1] in lex.MARK_NOUNS and (words[-1] != "frame" or any(word in lex.COLOURS for word in words))


_REFERRING = frozenset([("the", "latter"), ("the", "former")])
_OTHER = frozenset([("the", "other", "one"), ("the", "other")])


def with_nouns(found: Sequence[Item]) -> list[Item]:
    """The items, where a reference has what it means.

    "The latter" is what was named last, "the other one" is of the kind named, and "the red one" of the kind that is
    asked for, or of that of all things before it.
    """
    kinds = {_kind_of(item.phrase) for at, item in enumerate(found) if item.phrase and _is_asked_for(found, at)} - {""}
    before: set[str] = set()
    said: list[Item] = []
    things: list[Item] = []
    for item in found:
        nouns, phrase = kinds or before, item.phrase
        if item.words in _REFERRING and len(things) > 1:
            meant = things[-1] if item.words == ("the", "latter") else things[-2]
            said.append(replace(item, phrase=meant.phrase, words=meant.words))
            continue
        if item.words[:1] == ("that",) and phrase is not None and (again := _last_like(phrase, things)):
            said.append(replace(item, phrase=again, words=("that", *again.text.split())))
            continue
        if item.words in _OTHER and len(nouns) == 1:
            noun = next(iter(nouns))
            other = ObjectPhrase(f"other {noun}", None, noun)
            said.append(replace(item, phrase=other, words=("the", "other", *noun.split())))
            continue
        if phrase is not None and phrase.is_thing and phrase.noun and all(phrase != each.phrase for each in things):
            things.append(item)
        colour_alone = (
            len(item.words) == 2 and item.words[0] == "the" and item.words[1] in lex.COLOURS.keys() - {"orange"}
        )
        if phrase is not None and kinds and colour_alone:
            phrase = replace(phrase, noun=None)  # "which mug does it hit first, the blue or the white?"
        if phrase is not None and phrase.noun is None and _singles_out(item, phrase) and len(nouns) == 1:
            said.append(replace(item, phrase=_of_kind(phrase, next(iter(nouns)))))
        else:
            said.append(item)
            before |= {_kind_of(phrase)} - {""}
    return said


def _last_like(phrase: ObjectPhrase, things: Sequence[Item]) -> ObjectPhrase | None:
    """ "That mug": the mug that was named last."""
    if phrase.noun is None or phrase.text.lower() != phrase.noun:
        return None
    return next((each.phrase for each in reversed(things) if each.phrase and each.phrase.noun == phrase.noun), None)


def _singles_out(item: Item, phrase: ObjectPhrase) -> bool:
    """ "The red one", "the left one", "the one on the left"."""
    words = phrase.text.lower().split()
    return phrase.colour is not None or (item.words[-1:] == ("one",) and len(words) > 1)


def _is_asked_for(found: Sequence[Item], at: int) -> bool:
    """ "Which cone", "which of the cones"."""
    return found[at].words[:1] in {("which",), ("what",)} or (
        key_at(found, at - 1) == "of" and key_at(found, at - 2) in {"which", "what"}
    )


def _kind_of(phrase: ObjectPhrase | None) -> str:
    """The noun of a phrase that names a thing by one; empty otherwise."""
    named = phrase is not None and phrase.is_thing and phrase.head not in lex.GENERIC | lex.AGENTS
    return phrase.noun or "" if phrase is not None and named else ""


def _of_kind(phrase: ObjectPhrase, noun: str) -> ObjectPhrase:
    words = phrase.text.split()
    if "one" not in words:
        return replace(phrase, text=" ".join([*words, noun]), noun=noun)
    return replace(phrase, text=" ".join(noun if word == "one" else word for word in words), noun=noun)


TABLES = lex.words("table desk tabletop")
_PLACE = lex.words(
    "on onto upon off across over along around above atop at from to in through within under beneath below underneath"
    " inside of leave leaves leaving"
)


def with_tables(found: Sequence[Item]) -> list[Item]:
    """The items; "the table" is a thing where it is not behind a preposition that makes it a place."""
    return [_as_thing(found, at) for at in range(len(found))]


def _as_thing(found: Sequence[Item], at: int) -> Item:
    item, before = found[at], key_at(found, at - 1) if at else ""
    if item.phrase is None or item.phrase.head not in TABLES:
        return item
    in_front = before == "of" and key_at(found, at - 2) == "front"
    if before in _PLACE and not in_front:
        return item
    return replace(item, phrase=replace(item.phrase, as_thing=True))


_PLACE_WINDOW = 9  # words
_PUTS = lex.words("put place insert set position lower stand stick pop plonk plop")


def with_places(found: Sequence[Item]) -> list[Item]:
    """The items, each thing with what is said behind it of its place joined to one."""
    texts = [item.phrase.text.lower() for item in found if item.phrase is not None]
    joined: list[Item] = []
    at = 0
    while at < len(found):
        item, end = found[at], at + 1
        thing = item.phrase is not None and item.phrase.is_thing and end < len(found)
        parsed = read_from("place", found, end, _PLACE_WINDOW) if thing else None
        read = None if parsed is None else _place(found, parsed[0])
        if item.phrase is not None and parsed is not None and read is not None and not _is_goal(found, at):
            comma, end = key_at(found, end) == ",", parsed[1]
            end += comma and key_at(found, end) == ","
            words = " ".join(" ".join(each.words) or each.key for each in found[at + 1 : end])
            several = texts.count(item.phrase.text.lower()) > 1
            text = f"{item.phrase.text} {words}" if several else item.phrase.text
            item = replace(item, end=found[end - 1].end, phrase=replace(item.phrase, text=text, place=read))
        joined.append(item)
        at = end
    return joined


def _place(found: Sequence[Item], tree: Tree[Token]) -> PlaceWords | None:
    relation = next(str(node.data) for node in tree.iter_subtrees() if str(node.data).endswith("_it"))
    token = next(tree.scan_values(lambda value: isinstance(value, Token)), None)
    phrase = None if token is None else found[token.line or 0].phrase
    if token is not None and (phrase is None or not phrase.is_thing):
        return None
    return PlaceWords(relation.removesuffix("_it"), phrase)


def _is_goal(found: Sequence[Item], at: int) -> bool:
    """ "Push the ball behind the mug", "put the ball on the mug": where it gets to, not where it is."""
    verb = lex.VERBS.get(key_at(found, at - 1))
    moved = verb is not None and (verb.kind not in {None, "static"} or verb.lemma in _PUTS)
    return moved and key_at(found, at + 1) not in {"that", "which", ","}
