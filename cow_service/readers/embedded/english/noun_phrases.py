"""Puts a question into plain tokens: things as `X0`, idioms as one word in capitals, verbs in their base form.

"If the red ball rolls in the direction of the arrow, will it bump into the mug?" becomes
"if X0 roll ALONG , will it bump into X1 ?". The sentence forms are written over these tokens.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

from cow_service.readers.base import Likeness
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.options import plain
from cow_service.records import ObjectPrior, SpeedWord

_CONTRACTED = {
    r"\bcan ?not\b|\bcan't\b": "can not", r"\bwon't\b": "will not", r"n't\b": " not",
    r"\b(what|where|it|there|that|who|which)'s\b": r"\1 is", r"\b(it|i|you)'d\b": r"\1 would",
    r" [–—-] |[:—–]": " , ",
}  # fmt: skip
_TOKEN = re.compile(r"N\d+N|[A-Z]+\d*|\d+(?:\.\d+)?|[a-z]+(?:['-][a-z]+)*|\w+|[.,;?!()-]")
_BEHIND_NOUN = lex.words(
    "safe both last earlier hard each together neither either nearest closest farthest first one other"
)
_COLOURED = rf"(?:(?:{'|'.join(lex.COLOURS)}|{'|'.join(lex.LISTS['adjectives'])}|bounding|drawn|cream) )*"
# What belongs to the noun in front of it, and what it says.
_BEHIND = {
    "path": r"(?:at|on|of) the (?:(?P<end>start|beginning|first|end|last)(?: position| point)? of the )?(?:\w+ )?"
    r"(?:path|trail|line|track|trajectory)",
    "box": rf"(?:in|inside|within|marked (?:by|with)) (?:the|a) {_COLOURED}(?:box|rectangle|bbox|circle|outline)",
    "with": rf"with (?:an? |no |two |three )?{_COLOURED}[a-z-]+",
    "place": rf"(?:on|at|in) the (?:far )?(?:{'|'.join(lex.PLACES)})(?: side)?(?! [a-z]+ (?:{'|'.join(lex.PLACES)}))",
}
_SOME = {"both": "ALLOF", "all": "ALLOF", "each": "ALLOF", "every": "ALLOF", "either": "SOMEOF", "any": "SOMEOF",
    "some": "SOMEOF", "one": "SOMEOF", "neither": "NOOF", "none": "NOOF"}  # fmt: skip


@dataclass
class Tokens:
    """A question in plain tokens; `said` are its words in their place, `things` those of `X0`, `X1`, ..."""

    names: Sequence[str] = ()
    plain: list[str] = field(default_factory=list[str])
    said: list[str] = field(default_factory=list[str])
    things: list[lex.ObjectPhrase] = field(default_factory=list[lex.ObjectPhrase])
    quantities: list[lex.QuantityWords] = field(default_factory=list[lex.QuantityWords])

    def add(self, token: str, said: str) -> None:
        """Adds a token that stands for some words."""
        self.plain.append(token)
        self.said.append(said)

    def number(self, phrase: lex.ObjectPhrase) -> int:
        """The number of a thing: one that was named before keeps its own."""
        known = (at for at, each in enumerate(self.things) if plain(each.text) == plain(phrase.text))
        at = next(known, len(self.things))
        self.things += [phrase] if at == len(self.things) else []
        return at


def tokens_of(text: str, names: Sequence[str] = ()) -> Tokens:
    """The question in plain tokens. A given name that stands in it is a name there, whatever its words."""
    text, tokens = " ".join(text.replace("’", "'").lower().split()), Tokens(names)
    for contraction, said in _CONTRACTED.items():
        text = re.sub(contraction, said, text)
    for at, name in sorted(enumerate(names), key=lambda each: -len(each[1])):
        words = r"\s+".join(map(re.escape, name.lower().split()))
        text = re.sub(rf"(?<![\w'-]){words}(?![\w'-])", f"N{at}N", text)
    for what, pattern in lex.forms()["quantities"]:
        text = pattern.sub(lambda found, what=what: _quantity(tokens, what, lex.roles(found)), text)
    for token, idiom in lex.forms()["idioms"]:
        text = " ".join(idiom.sub(token, text).split())
    words, at, going = _TOKEN.findall(text), 0, list[str]()
    while at < len(words):
        at, verb = _read_phrase(tokens, words, at)
        going += [".", tokens.plain[-1], verb] if verb else []  # "the falling ball": how it moves
    tokens.plain, tokens.said = tokens.plain + going, tokens.said + going
    return tokens


def _quantity(tokens: Tokens, what: str, said: dict[str, str]) -> str:
    """The token of a quantity of some kind; nothing for what says none."""
    number, unit = said.get("n", "1"), said.get("u", "px")
    numbers = lex.NUMBER_WORDS | {"a": 1, "an": 1, "twice": 2, "half a": 0.5, "half an": 0.5, "half": 0.5}
    value = 0.5 if what == "share" else float(numbers.get(number, number)) * lex.METRES.get(unit, 1.0)
    if what in {"slow", "fast"}:
        tokens.quantities.append(lex.QuantityWords("speed", pace=cast(SpeedWord, what)))
    elif what:
        tokens.quantities.append(lex.QuantityWords(cast(lex.Measure, what), value, unit in lex.METRES))
    return f"{'W' if what == 'within' else 'Q'}{len(tokens.quantities) - 1}" if what else ""


def _is_open(word: str) -> bool:
    """Whether a word may be a noun, or a part of one."""
    return word[0].islower() and word not in lex.FUNCTION and word not in lex.DETERMINERS


def _is_determiner(words: Sequence[str], at: int) -> bool:
    """A "that" or "which" in front of a verb is none."""
    word, after = words[at], words[at + 1] if at + 1 < len(words) else "."
    relative = word in {"that", "this"} and after in lex.DETERMINERS
    acts = after in lex.VERBS and (word in {"that", "which", "what", "this"} or lex.VERBS[after].form == "s")
    follows = _is_open(after) or after in lex.PLACES or after == "first" or after in lex.DETERMINERS or after[0] == "N"
    return word in lex.DETERMINERS and follows and not relative and not acts


def _belongs(words: Sequence[str], at: int, first: int, start: int, has_noun: bool) -> bool:
    """Whether a word belongs to the phrase that begins at `start`, with determiners up to `first`."""
    word = words[at]
    begun, determined, form = at > start, first > start, lex.VERBS[word].form if word in lex.VERBS else ""
    if has_noun:
        coloured = word in lex.COLOURS and words[at - 1] not in lex.COLOURS
        is_behind = word in _BEHIND_NOUN or word in lex.PLACES or coloured or word.endswith("ly")
        return not is_behind and ((_is_open(word) and not form) or (word.isdigit() and len(word) < 3))
    if word in lex.PLACES or word in {"one", "other", "first"}:
        return determined and (word != "one" or begun)
    if not _is_open(word) or form:
        return _is_open(word) and begun and form != "s"
    return determined or not word.endswith("ly")


def _extent(tokens: Tokens, words: list[str], at: int) -> tuple[int, int, str]:
    """Where the content of the noun phrase that begins at a word begins and ends, and the given name that it ends in.

    A name that is no more than an adjective of the phrase ("orange" in "the orange toy car") becomes a word of it.
    """
    first, has_noun = at, False
    while first < len(words) and _is_determiner(words, first):
        first += 1
    end = first
    while end < len(words) and end - first < 10:
        if words[end][0] == "N" and words[end][1:-1].isdigit():
            name, behind = tokens.names[int(words[end][1:-1])], words[end + 1] if end + 1 < len(words) else "."
            if not (lex.is_modifier(name.lower()) and _is_open(behind) and behind not in lex.VERBS):
                return first, end + 1, name
            words[end] = name.lower()
        elif not _belongs(words, end, first, at, has_noun):
            break
        has_noun = has_noun or not (lex.is_modifier(words[end]) or words[end] in {"other", "first"})
        end += 1
        if words[end - 1] in {"one", "ones"}:
            break
    return first, end, ""


def _read_phrase(tokens: Tokens, words: list[str], at: int) -> tuple[int, str]:
    """Adds the noun phrase that begins at a word, else the word; the place behind it, and a verb that its noun has."""
    first, end, name = _extent(tokens, words, at)
    content = words[first:end]
    if not content or content == ["one"] or (not name and all(word in lex.SETS["adjectives"] for word in content)):
        tokens.add(lex.lemma(words[at]), words[at])
        return at + 1, ""
    verb = lex.lemma(content[0]) if len(content) > 1 and content[0].endswith("ing") else ""
    verb = verb if verb in lex.KINDS else ""
    content = content[1:] if verb else content
    phrase = object_phrase([*content[:-1], *(name.lower().split() or content[-1:])], "")
    start, (end, phrase) = end, _with_behind(tokens, words, end, phrase, content[0])
    text = [*content[:-1], name or content[-1], *words[start:end]]
    phrase = replace(phrase, text=" ".join(text))
    given = name if name and len(text) == 1 else match_given(phrase, tokens.names)
    if given is not None:
        phrase = replace(object_phrase(given.lower().split(), given), is_given=True)
    said = " ".join([*words[at:first], *([verb] if verb else []), *text])
    if phrase.head in lex.AGENTS and not phrase.is_given and phrase.colour is None:
        tokens.add("AG", said)
    else:
        _add_phrase(tokens, phrase, content, words[at:first], said)
    return end, verb


def _with_behind(
    tokens: Tokens, words: list[str], end: int, phrase: lex.ObjectPhrase, opening: str
) -> tuple[int, lex.ObjectPhrase]:
    """Where the words behind a noun that belong to it end, and the phrase with what they say."""
    is_put = bool(tokens.plain) and tokens.plain[-1] in {*lex.CAUSES, "put", "place", "set"}
    while end < len(words):
        behind = " ".join(words[end : end + 12])
        matches = ((what, re.match(rf"(?:{pattern})(?= |$)", behind)) for what, pattern in _BEHIND.items())
        found = [(what, match) for what, match in matches if match and not (is_put and what in {"box", "place"})]
        if found:
            what, match = found[0]
            end += len(match[0].split())
            is_start = what == "path" and (match["end"] or opening) in {"start", "beginning", "first"}
            path_end = phrase.path_end if what != "path" else "start" if is_start else "end"
            phrase = replace(phrase, inside_box=phrase.inside_box or what == "box", path_end=path_end)
        elif words[end] == "of" and end + 1 < len(words) and _is_open(words[end + 1]):
            end += 2  # "stack of books"
        else:
            break
    return end, phrase


def _add_phrase(
    tokens: Tokens, phrase: lex.ObjectPhrase, content: list[str], determiners: list[str], said: str
) -> None:
    """Adds a noun phrase as a thing, a kind or several things."""
    counted = tokens.said[-2:-1] and tokens.said[-2] in _SOME and tokens.said[-1] == "of"
    quantifier = next((word for word in determiners if word in _SOME), tokens.said[-2] if counted else None)
    is_plural = not phrase.is_given and content[-1] != lex.singular(content[-1]) and content[-1] != "ones"
    plain_noun = not (phrase.colour or phrase.is_given or phrase.inside_box or phrase.path_end)
    if "which" in determiners or "what" in determiners or tokens.plain[-2:] == ["how", "many"]:
        if determiners:
            tokens.add("which", determiners[0])
        tokens.add(f"K{tokens.number(phrase)}", said)
    elif quantifier is not None:
        if counted:
            del tokens.plain[-2:], tokens.said[-2:]
        bare = " ".join(word for word in content if word != "other")
        name = f"{quantifier} {bare}" if quantifier in {"both", "either", "neither"} else bare
        tokens.add(_SOME[quantifier], quantifier)
        tokens.add(f"S{tokens.number(replace(phrase, text=name))}", said)
    elif is_plural and not phrase.path_end:
        tokens.add(f"P{tokens.number(phrase)}", said)
    elif phrase.head in lex.GENERIC and plain_noun and len(content) == 1:
        tokens.add("OBJ", said)
    else:
        tokens.add("no", "no") if "no" in determiners else None
        tokens.add(f"X{tokens.number(_meant(phrase, tokens))}", said)


def _meant(phrase: lex.ObjectPhrase, tokens: Tokens) -> lex.ObjectPhrase:
    """What a phrase means among the things named before: "the black one" is of the kind that is asked for, or the last
    thing of that colour, or of the one kind that was named; "the car" is the red car."""
    before, kinds = tokens.things, {tokens.things[int(token[1:])].noun for token in tokens.plain if token[0] == "K"}
    if phrase.is_given or phrase.path_end:
        return phrase
    if phrase.noun is None and phrase.colour is not None:
        same = [each for each in before if each.colour == phrase.colour and each.noun and not kinds]
        kinds = kinds or {each.noun for each in before if each.noun}
        if same or len(kinds) != 1:
            return same[-1] if same else phrase
        noun = kinds.pop() or ""
        return replace(phrase, noun=noun, text=" ".join([*phrase.text.split()[:-1], noun]))
    # No word in it that the earlier phrase lacks.
    said, same_noun = set(phrase.text.lower().split()), [each for each in before if each.head == phrase.head]
    fuller = [each for each in same_noun if phrase.noun and said < set(each.text.lower().split())]
    return fuller[0] if len(fuller) == 1 else phrase


def object_phrase(content: Sequence[str], text: str) -> lex.ObjectPhrase:
    """The phrase with these lower case words, behind its determiners."""
    said = [word for word in content if not word.isdigit()] or list(content)
    said = said[: next((at for at, word in enumerate(said) if at and word in {"of", "with"}), len(said))]
    nouns, head = [word for word in said[:-1] if not lex.is_modifier(word)], said[-1]
    colour = next((lex.COLOURS[word] for word in said[:-1] or said if word in lex.COLOURS), None)
    noun = None if head in {"one", "ones", "other"} else " ".join([*nouns, lex.singular(head)])
    return lex.ObjectPhrase(text, colour, noun)


def parse_noun_phrase(text: str) -> lex.ObjectPhrase | None:
    """The noun phrase of a text such as "the red toy car"; None if there is none."""
    said = text.strip(" .,!?").split()
    while said and said[0].lower() in lex.DETERMINERS:
        del said[0]
    words = re.findall(r"[\w'-]+", " ".join(said).lower())
    closing = (lex.FUNCTION | lex.DETERMINERS) - {"one"}
    words = words[: next((at for at, word in enumerate(words) if at and word in closing), len(words))]
    if not words or words[0] in lex.FUNCTION:
        return None
    phrase = object_phrase(words, " ".join(said))
    colour = lex.COLOURS.get(phrase.noun or "") if phrase.colour is None else phrase.colour
    return replace(phrase, colour=colour)


def match_given(phrase: lex.ObjectPhrase, names: Sequence[str]) -> str | None:
    """The one given name that a phrase means: the same words, all words of one in the other, its noun or its colour."""
    said = set(plain(phrase.text).split()) - {"one"}
    named = [(name, set(plain(name).split()), parse_noun_phrase(name)) for name in names]
    others = [(name, other) for name, _, other in named if other is not None]
    tiers = (
        [name for name, words, _ in named if words == said],
        [name for name, words, _ in named if said and (said < words or words < said)],
        [name for name, other in others if len(said) == 1 and other.head == phrase.head],
        [name for name, other in others if phrase.noun is None and other.colour == phrase.colour],
    )
    found = next((tier for tier in tiers if tier), [])
    return found[0] if len(found) == 1 else None


def prior_of(name: str) -> ObjectPrior:
    """What the noun of a name says of its shape.

    A box is a container: a question about a solid one would not ask what goes into it.
    """
    phrase = parse_noun_phrase(name)
    head, shapes = phrase and phrase.head, ("sphere", "box", "cone", "cylinder")
    is_vehicle = head in lex.SETS["vehicle"]  # longer along its heading than across
    shape = "box" if is_vehicle else next((each for each in shapes if head in lex.SETS[each]), None)
    opening = next((each for each in ("round", "square") if head in lex.SETS[each]), "none" if shape else None)
    says = {"shape": shape, "elongated": is_vehicle, "equal_sided": head in lex.SETS["cube"], "opening": opening}
    return ObjectPrior.model_validate(says)


@dataclass(frozen=True)
class Kind:
    """What one of the things is called, and how many there are, where that is said."""

    phrase: lex.ObjectPhrase
    count: int | None


def kind_of(name: str) -> Kind | None:
    """The kind that a name such as "both mugs" or "mugs" is of; None for the name of one thing."""
    said, numbers = name.lower().split(), dict.fromkeys(("both", "either", "neither"), 2) | lex.NUMBER_WORDS
    counts = [int(numbers.get(word, word)) for word in said if word.isdecimal() or word in numbers]
    quantifiers = lex.words("any every each all no none some many a an other the") | numbers.keys()
    rest = [word for word in said if word not in quantifiers and not word.isdecimal()]
    head = lex.singular(rest[-1]) if rest else ""
    if not rest or (said[0] not in quantifiers - {"the", "other"} and head == rest[-1]):
        return None
    phrase = parse_noun_phrase(" ".join([*rest[:-1], head]))
    return None if phrase is None else Kind(phrase, counts[0] if counts else None)


def may_name(phrase: lex.ObjectPhrase, name: str) -> bool:
    """Whether a phrase may mean the object of that name: they share a colour or a noun, and differ in none."""
    other = parse_noun_phrase(name)
    if other is None or plain(phrase.text) == plain(name):
        return other is not None
    nouns = [each.head if each.head not in lex.GENERIC else None for each in (phrase, other)]
    said = [(one, two) for one, two in ((phrase.colour, other.colour), tuple(nouns)) if one and two]
    return bool(said) and all(one == two for one, two in said)


def likeness(words: str, name: str) -> Likeness:
    """Whether a phrase means the thing of a name; see `WordReader.likeness`."""
    phrase, other = parse_noun_phrase(words), parse_noun_phrase(name)
    if phrase is None or other is None:
        return "same" if plain(words) == plain(name) else "unknown"
    shapes = (prior_of(words).shape, prior_of(name).shape)
    if any(one is not None and two is not None and one != two for one, two in ((phrase.colour, other.colour), shapes)):
        return "other"
    return "same" if may_name(phrase, name) else "unknown"
