"""Puts a question into plain tokens: things as `X0`, idioms as one word in capitals, verbs in their base form.

"If the red ball rolls in the direction of the arrow, will it bump into the mug?" becomes
"if X0 roll ALONG , will it bump into X1 ?". The sentence forms are written over these tokens.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from cow_service.readers.base import Quantity, Unit
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.forms import forms
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, QuantityWords
from cow_service.readers.options import plain
from cow_service.records import Shape

_COLOUR = "|".join(lex.COLOURS)
_NUMBER = r"(\d+(?:\.\d+)?|half an?|an?|" + "|".join((*lex.NUMBER_WORDS, "ten", "twenty", "thirty", "fifty")) + ")"
_ABOUT = r"(?:(?:about|only|just|roughly|approximately|exactly) )?"
_LENGTH = "(" + "|".join(("px", "pixels?", *lex.METRES)) + r")\b"
_SECOND = r"(?:seconds?|secs?|s)\b"
_HALT = r"(?:,? (?:but |and )?(?:then )?(?:it )?(?:stops|halts|pauses)(?: dead| there)?\b)?"
_CONTRACTED = ((r"\bcan ?not\b", "can not"), (r"\bwo ?n't\b", "will not"), (r"\bca n't\b|\bcan't\b", "can not"), (r"n't\b", " not"),
    (r"\b(what|where|it|there|that|here|who|which)'s\b", r"\1 is"), (r"\bwhat's\b", "what is"), (r"\bit'd\b", "it would"), (r"\bi'd\b", "i would"))  # fmt: skip
_TOKEN = re.compile(r"N\d+N|[A-Z]+\d*|\d+(?:\.\d+)?|[a-z]+(?:['-][a-z]+)*|\w+|[.,;:?!()-]")
_BEHIND_NOUN = lex.words("safe both last earlier hard each together neither either nearest closest farthest able")


@dataclass(frozen=True)
class Tokens:
    """A question in plain tokens; `said` are its words in their place, `things` those of `X0`, `X1`, ..."""

    plain: tuple[str, ...]
    said: tuple[str, ...]
    things: tuple[ObjectPhrase, ...]
    quantities: tuple[QuantityWords, ...]


@dataclass
class _Reader:
    """What is made of the words from first to last."""

    names: Sequence[str]
    things: list[ObjectPhrase] = field(default_factory=list[ObjectPhrase])
    quantities: list[QuantityWords] = field(default_factory=list[QuantityWords])
    plain: list[str] = field(default_factory=list[str])
    said: list[str] = field(default_factory=list[str])
    going: list[str] = field(default_factory=list[str])

    def add(self, token: str, said: str) -> None:
        self.plain.append(token)
        self.said.append(said)

    def thing(self, phrase: ObjectPhrase) -> str:
        """The token of a thing: one that was named before keeps its own."""
        known = next((at for at, each in enumerate(self.things) if plain(each.text) == plain(phrase.text)), None)
        if known is None:
            self.things.append(phrase)
        return f"X{len(self.things) - 1 if known is None else known}"


def tokens_of(text: str, names: Sequence[str] = ()) -> Tokens:
    """The question in plain tokens. A given name that stands in it is a name there, whatever its words."""
    text = " ".join(text.replace("’", "'").lower().split())
    for idiom, said in _CONTRACTED:
        text = re.sub(idiom, said, text)
    text = re.sub(r" [–—-] |[:—–]", " , ", text)
    reader = _Reader(names)
    for at, name in sorted(enumerate(names), key=lambda each: -len(each[1])):
        words = r"\s+".join(map(re.escape, name.lower().split()))
        text = re.sub(rf"(?<![\w'-]){words}(?![\w'-])", f"N{at}N", text)
    text = _with_quantities(text, reader.quantities)
    for token, idiom in forms()["idioms"]:
        text = " ".join(idiom.sub(token, text).split())
    words = _TOKEN.findall(text)
    at = 0
    while at < len(words):
        at = _read_phrase(reader, words, at)
    return Tokens((*reader.plain, *reader.going), (*reader.said, *reader.going), tuple(reader.things), tuple(reader.quantities))


def _value(word: str) -> float:
    if word[0].isdigit():
        return float(word)
    numbers = lex.NUMBER_WORDS | {"twenty": 20, "thirty": 30, "fifty": 50, "a": 1, "an": 1}
    return 0.5 if word.startswith("half") else float(numbers[word])


_QUANTITIES: tuple[tuple[str, str], ...] = (
    (rf"(?:(?:at|with) )?(?:(?:a|an) )?(?:(?:constant|steady|initial) )?(?:(?:speed|velocity|pace) (?:of |is )?)?{_ABOUT}{_NUMBER} ?{_LENGTH} ?(?:per|/|an?) ?(?:second|sec|s)\b", "speed"),
    (r"(?:(?:very|quite|rather) )?(slowly|gently|softly|lightly|slow)|(?:at|with) (?:a )?(low|slow|small) speed|at (?:a )?(constant|steady) (?:speed|velocity)", "slow"),
    (r"(?:(?:very|quite|rather) )?(quickly|rapidly|swiftly|fast|hard|forcefully)|(?:at|with) (?:a )?(?:high|full|great) speed", "fast"),
    (rf"(?:within|in less than|in under) {_ABOUT}{_NUMBER} {_SECOND}|(?:within|in|for|during) the first (?:{_NUMBER} )?{_SECOND}(?: of (?:its|the) \w+)?", "within"),
    (rf"(?:for|during) {_ABOUT}{_NUMBER} {_SECOND}{_HALT}", "duration"),
    (rf"(?:(?:though )?(?:by|for) )?{_ABOUT}(?:a distance of )?{_NUMBER} ?{_LENGTH}{_HALT}", "distance"),
    (rf"(?:by |though )*{_ABOUT}(twice|{_NUMBER[1:-1]}) (?:times |of )?its own (?:width|diameter)s?{_HALT}", "own_widths"),
    (rf"(?:,? (?:but|and|then) )?(?:(?:it )?(?:stops?|only goes|goes) )?(?:halfway|midway)(?! between){_HALT}", "share"),
    (r"(?:until|till) it (?:hits|meets|touches|reaches|runs into|bumps into) (?:some|any)thing(?: else)?", "until"),
)  # fmt: skip
_COMPILED = tuple((re.compile(rf"(?<![\w'-]){idiom}(?![\w'-])"), what) for idiom, what in _QUANTITIES)


def _with_quantities(text: str, found: list[QuantityWords]) -> str:
    """The text, each quantity as `Q0`, `Q1`, ...; what a name says ("the slow ball") is none."""

    def read(match: re.Match[str], what: str) -> str:
        groups = [group for group in match.groups() if group is not None]
        value = _value(groups[0]) if groups and what not in {"slow", "fast"} and groups[0] != "twice" else 2.0
        size, unit = lex.METRES.get(groups[-1], 1.0) if groups else 1.0, "m" if groups and groups[-1] in lex.METRES else "px"
        units: tuple[Unit, Unit] = ("m", "m/s") if unit == "m" else ("px", "px/s")
        match what:
            case "speed":
                said = QuantityWords(speed=Quantity(value * size, units[1]))
            case "slow":
                if groups[0] in {"constant", "steady"}:
                    return ""
                said = QuantityWords(speed="slow")
            case "fast":
                said = QuantityWords(speed="fast")
            case "within":
                said = QuantityWords(within=value if groups else 1.0)
            case "duration":
                said = QuantityWords(duration=value)
            case "distance":
                said = QuantityWords(distance=Quantity(value * size, units[0]))
            case "own_widths":
                said = QuantityWords(own_widths=value)
            case "share":
                said = QuantityWords(share=0.5)
            case _:
                said = QuantityWords(until="contact")
        found.append(said)
        return f"Q{len(found) - 1}"

    for idiom, what in _COMPILED:
        kept = rf"(?<!\bthe )(?<!\ban )(?<!\bhow )(?<!\bas )(?:{idiom.pattern})" if what in {"slow", "fast"} else idiom
        text = re.sub(kept, lambda match, what=what: read(match, what), text)
    return text


def _is_determiner(words: Sequence[str], at: int) -> bool:
    word, after = words[at], words[at + 1] if at + 1 < len(words) else "."
    if word not in lex.DETERMINERS:
        return False
    if word in {"that", "this"} and after in lex.DETERMINERS:
        return False
    closed = not after[0].islower() and not after.startswith("N") or after in lex.FUNCTION and after not in lex.PLACES
    return not (closed or (after in lex.VERBS and (word in {"that", "which", "what", "this"} or lex.VERBS[after].form == "s")))


def _belongs(words: Sequence[str], at: int, first: int, start: int, has_noun: bool) -> bool:
    """Whether a word belongs to the phrase that begins at `start`, with determiners up to `first`."""
    word, after = words[at], words[at + 1] if at + 1 < len(words) else "."
    begun, determined = at > start, first > start
    if word == "and":
        return begun and not has_noun and words[at - 1] in lex.COLOURS and after in lex.COLOURS
    if word == "can" and not has_noun and begun:
        return True
    if word.isdigit():
        return has_noun and len(word) < 3
    if has_noun and (word in _BEHIND_NOUN or word in lex.PLACES or (word in lex.COLOURS and words[at - 1] not in lex.COLOURS)):
        return False
    if word in lex.PLACES or word in {"one", "other", "first"}:
        return not has_noun and determined and (word != "one" or begun)
    if not word[0].islower() or word in lex.FUNCTION or word in lex.DETERMINERS:
        return False
    if word.endswith("ly") and word not in {"family", "jelly", "butterfly", "belly"}:
        return determined and not has_noun
    if word not in lex.VERBS:
        return True
    form = lex.VERBS[word].form
    if words[at - 1] == "orange" and word not in set().union(*lex.NOUNS.values()):
        return False  # a thing, where no noun follows
    if not has_noun:
        return begun and form != "s" and word not in {"is", "are", "will"}
    return form == "base" and after in lex.VERBS and (lex.VERBS[after].form == "s" or after in {"is", "was"})


_PATH_END = re.compile(r"(?:at|on|of) the (?:(start|beginning|first|end|last)(?: position| point)? of the )?(?:\w+ )?(?:path|trail|line|track|trajectory)(?: |$)")
_AT_PLACE = re.compile(rf"(?:on|at|in) the (?:far )?(?:{'|'.join(lex.PLACES)})(?: side)?(?= [,.?A-Z]| (?:{'|'.join(sorted(lex.VERBS))})(?: |$)|$)")
_IN_BOX = re.compile(rf"(?:in|inside|within|marked (?:by|with)) (?:the|a) (?:(?:{_COLOUR}|bounding|drawn) )*(?:box|rectangle|bbox|circle|outline)(?= |$)")
_WITH = re.compile(rf"with (?:an? |no |two |three )?(?:(?:{_COLOUR}|{'|'.join(lex.ADJECTIVES)}|cream) )*[a-z-]+(?= |$)")
_SOME = {"both": "ALLOF", "all": "ALLOF", "each": "ALLOF", "every": "ALLOF", "either": "SOMEOF", "any": "SOMEOF",
    "some": "SOMEOF", "one": "SOMEOF", "neither": "NOOF", "none": "NOOF", "no": "NOOF"}  # fmt: skip


def _read_phrase(reader: _Reader, words: Sequence[str], at: int) -> int:
    """Adds the noun phrase that begins at a word, else the word; returns the place behind it."""
    first = at
    while first < len(words) and _is_determiner(words, first):
        first += 1
    end, has_noun, named = first, False, None
    while end < len(words) and end - first < 10:
        if re.fullmatch(r"N\d+N", words[end]):
            name = reader.names[int(words[end][1:-1])]
            more = end + 1 < len(words) and _belongs(words, end + 1, first, at, lex.is_modifier(name) is False)
            named = None if more and lex.is_modifier(name.lower()) else name  # "orange" in "the orange toy car"
            words = words if named else [*words[:end], name.lower(), *words[end + 1 :]]
            if named:
                end += 1
                break
        if not _belongs(words, end, first, at, has_noun):
            break
        has_noun = has_noun or not (lex.is_modifier(words[end]) or words[end] == "other")
        end += 1
        if words[end - 1] in {"one", "ones"}:
            break
    bare = all(word in lex.ADJECTIVES or word in {"one", "first"} for word in words[first:end]) and words[end - 1] != "one"
    if end == first or (bare and not named) or list(words[first:end]) == ["one"]:
        word = words[at]
        reader.add(lex.lemma(word), word)
        return at + 1
    content, determiners = list(words[first:end]), list(words[at:first])
    # "The falling ball" says how it moves.
    going = content[0] if len(content) > 1 and content[0] in lex.VERBS and lex.lemma(content[0]) in lex.KINDS else ""
    content = content[1:] if going.endswith("ing") else content
    text = list(content)
    if named:
        text[-1] = named
    path_end, in_box = None, False
    while end < len(words):
        behind = " ".join(words[end : end + 12])
        before = reader.plain[-1] if reader.plain else ""
        if behind.startswith("of ") and end + 1 < len(words) and _belongs(words, end + 1, end + 1, end, False) and words[end + 1] not in lex.VERBS:
            length = 2
        elif (found := _WITH.match(behind)) is not None and has_noun:
            length = len(found[0].split())
        elif (found := _PATH_END.match(behind)) is not None:
            length = len(found[0].split())
            path_end = "start" if found[1] in {"start", "beginning", "first"} or (content[0] == "first" and not found[1]) else "end"
        elif (found := _IN_BOX.match(behind)) is not None and before not in lex.VERBS and before not in {"put", "the"}:
            length, in_box = len(found[0].split()), True
        elif (found := _AT_PLACE.match(behind)) is not None and before not in lex.CAUSES | {"put", "place"}:
            length = len(found[0].split())
        else:
            break
        text += words[end : end + length]
        end += length
    said = " ".join([*determiners, *text])
    phrase = object_phrase([*content[:-1], *named.lower().split()] if named else content, " ".join(text))
    phrase = replace(phrase, inside_box=in_box, path_end=path_end)
    given = named if named and text == [named] else match_given(phrase, reader.names)
    if given is not None:
        phrase = replace(object_phrase(given.lower().split(), given), is_given=True)
    _add_phrase(reader, phrase, content, determiners, said)
    if going.endswith("ing"):
        reader.going += [".", reader.plain[-1], lex.lemma(going)]
    return end


def _add_phrase(reader: _Reader, phrase: ObjectPhrase, content: list[str], determiners: list[str], said: str) -> None:
    """Adds a noun phrase as a thing, a kind, several things or one that acts."""
    before = [word for word in reader.said[-3:]]
    last = content[-1]
    is_plural = not phrase.is_given and last != lex.singular(last) and last not in {"ones"}
    counted = before[-1:] == ["of"] and before[-2:-1] and before[-2] in _SOME
    quantifier = next((word for word in determiners if word in _SOME), before[-2] if counted else None)
    asks = "which" in determiners or "what" in determiners
    generic = phrase.noun is None or phrase.head in lex.GENERIC
    if phrase.head in lex.AGENTS and not (phrase.colour or phrase.is_given):
        reader.add("AG", said)
    elif asks or (reader.plain[-2:] == ["how", "many"] or (reader.plain[-3:-1] == ["how", "many"] and counted is False)):
        at = reader.thing(phrase)
        reader.add("which" if asks else "", determiners[0] if asks else "")
        reader.add(f"K{at[1:]}", said)
    elif quantifier is not None and not (quantifier == "no" and not is_plural and phrase.noun):
        if counted:
            del reader.plain[-2:], reader.said[-2:]
        bare = " ".join(word for word in content if word not in {"other"})
        name = f"{quantifier} {bare}" if quantifier in {"both", "either", "neither"} else bare
        at = reader.thing(replace(phrase, text=name))
        reader.add(_SOME[quantifier], "")
        reader.add(f"S{at[1:]}", said)
    elif quantifier == "no":
        reader.add("no", "no")
        reader.add(reader.thing(phrase), said)
    elif is_plural and not phrase.path_end:
        reader.add(f"P{reader.thing(phrase)[1:]}", said)
    elif generic and not (phrase.colour or phrase.inside_box or phrase.path_end or "other" in content or len(content) > 1):
        reader.add("it" if phrase.noun is None else "OBJ", said)
    else:
        reader.add(reader.thing(_meant(phrase, reader.things)), said)


def _meant(phrase: ObjectPhrase, before: Sequence[ObjectPhrase]) -> ObjectPhrase:
    """What a phrase means among the things named before: "the black one" is the last of that colour, else of the one
    kind that was named; "the car" is the red car."""
    if phrase.is_given:
        return phrase
    if phrase.noun is None and phrase.colour is not None:
        same = [each for each in before if each.colour == phrase.colour and each.noun]
        kinds = {each.noun for each in before if each.noun} if not same else set[str | None]()
        noun = next(iter(kinds)) if len(kinds) == 1 else None
        if same or noun is None:
            return same[-1] if same else phrase
        return replace(phrase, noun=noun, text=" ".join([*phrase.text.split()[:-1], noun]))
    # No word in it that the earlier phrase lacks.
    fuller = [each for each in before if phrase.noun and phrase.words < each.words and each.head == phrase.head]
    return fuller[0] if len(fuller) == 1 and not phrase.path_end else phrase


def object_phrase(content: Sequence[str], text: str) -> ObjectPhrase:
    """The phrase with these lower case words, behind its determiners."""
    said = [word for word in content if word not in {"and"} and not word.isdigit()] or list(content)
    cut = next((at for at, word in enumerate(said) if at and word in {"of", "with", "labeled", "labelled"}), len(said))
    said = said[:cut]
    nouns, head = [word for word in said[:-1] if not lex.is_modifier(word)], said[-1]
    return ObjectPhrase(
        text=text,
        colour=next((lex.COLOURS[word] for word in said[:-1] or said if word in lex.COLOURS), None),
        noun=None if head in {"one", "ones", "other"} else " ".join([*nouns, lex.singular(head)]),
    )


def parse_noun_phrase(text: str) -> ObjectPhrase | None:
    """The noun phrase of a text such as "the red toy car"; None if there is none."""
    words = re.findall(r"[\w'-]+", text.lower())
    while words and words[0] in lex.DETERMINERS:
        del words[0]
    ends = (at for at, word in enumerate(words) if at and (word in lex.FUNCTION or word in lex.DETERMINERS) and word != "one")
    words = words[: next(ends, len(words))]
    if not words or words[0] in lex.FUNCTION:
        return None
    bare = text.strip(" .,!?")
    while bare.lower().split()[0] in lex.DETERMINERS:
        bare = bare.split(None, 1)[1]
    phrase = object_phrase(words, bare)
    return replace(phrase, colour=lex.COLOURS[phrase.noun]) if phrase.colour is None and phrase.noun in lex.COLOURS else phrase


def match_given(phrase: ObjectPhrase, names: Sequence[str]) -> str | None:
    """The one given name that a phrase means: the same words, all words of one in the other, or the same noun."""
    said = set(plain(phrase.text).split()) - {"one"}
    named = [(name, set(plain(name).split()), parse_noun_phrase(name)) for name in names]
    same = [name for name, words, _ in named if words == said]
    within = [name for name, words, _ in named if said and (said < words or words < said) and words]
    heads = [
        name for name, _, other in named
        if other is not None and other.head == phrase.head and (phrase.colour is None or other.colour == phrase.colour)
        and len(said) == 1
    ]  # fmt: skip
    # "The black one": of that colour.
    tinted = [name for name, _, other in named if phrase.noun is None and phrase.colour and other and other.colour == phrase.colour]
    for found in (same, within, heads, tinted):
        if found:
            return found[0] if len(found) == 1 else None
    return None


_SHAPE_NOUNS: dict[Shape, frozenset[str]] = {
    "sphere": lex.NOUNS["sphere"], "box": lex.NOUNS["box"] | lex.NOUNS["vehicle"], "cone": lex.NOUNS["cone"],
    "cylinder": lex.NOUNS["cylinder"],
}  # fmt: skip


def _head(name: str) -> str | None:
    phrase = parse_noun_phrase(name)
    return None if phrase is None else phrase.head


def shape_of(name: str) -> Shape | None:
    """The shape of what is called so; None if the noun does not say."""
    head = _head(name)
    return next((shape for shape, nouns in _SHAPE_NOUNS.items() if head in nouns), None)


def is_vehicle(name: str) -> bool:
    """Whether it is longer along its heading than across."""
    return _head(name) in lex.NOUNS["vehicle"]


def is_cube(name: str) -> bool:
    """Whether it is a box as wide as high."""
    return _head(name) in lex.NOUNS["cube"]


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
    quantifiers = lex.words("any every each all no none some many a an other the") | numbers.keys()
    rest = [word for word in said if word not in quantifiers and not word.isdecimal()]
    head = lex.singular(rest[-1]) if rest else ""
    if not rest or (said[0] not in quantifiers - {"the", "other"} and head == rest[-1]):
        return None
    phrase = parse_noun_phrase(" ".join([*rest[:-1], head]))
    return None if phrase is None else Kind(phrase, counts[0] if counts else None)


ContainerForm = Literal["round", "square", "none", "unknown"]


def container_form(name: str) -> ContainerForm:
    """Round or square for what is called a container, `none` for a solid thing, `unknown` where the noun says nothing.

    A box is a container: a question about a solid one would not ask what goes into it.
    """
    head = _head(name)
    if head in lex.NOUNS["round"]:
        return "round"
    if head in lex.NOUNS["square"]:
        return "square"
    return "unknown" if shape_of(name) is None else "none"


def may_name(phrase: ObjectPhrase, name: str) -> bool:
    """Whether a phrase may mean the object of that name: they share a colour or a noun, and differ in none."""
    other = parse_noun_phrase(name)
    if other is None:
        return False
    if plain(phrase.text) == plain(name):
        return True
    nouns = [each.head if each.head not in lex.GENERIC else None for each in (phrase, other)]
    pairs = ((phrase.colour, other.colour), tuple(nouns))
    said = [(one, two) for one, two in pairs if one is not None and two is not None]
    return bool(said) and all(one == two for one, two in said)
