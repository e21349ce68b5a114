"""Cuts a sentence into noun phrases and the words between them, without a list of nouns.

A phrase runs from its determiner up to a word that cannot be inside one: a function word, a verb form, a direction
behind the noun. Positions are those of the question's own characters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import takewhile

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import PUNCTUATION, Item, is_count, key_at, object_phrase, tokens
from cow_service.readers.question.quantities import with_quantities

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
        return determined and not has_noun and (key != "can" or _is_tin(found, at, asked))
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


def _is_tin(found: Sequence[Item], at: int, asked: bool) -> bool:
    """ "The green can"; but "the red can hit the blue"."""
    after = lex.VERBS.get(key_at(found, at + 1))
    return asked or after is None or after.form != "base"


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
