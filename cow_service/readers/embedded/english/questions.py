"""Reads a question by its sentence forms: what moves and how, what is changed, what is asked, and what was not read."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

from cow_service.readers.embedded.english import forms
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, QuantityWords
from cow_service.readers.embedded.english.noun_phrases import Tokens, parse_noun_phrase, tokens_of
from cow_service.readers.options import plain, says_not_sure, split_options, without_reply_form
from cow_service.records import Asked, InterventionKind, MotionKind, PlaceRelation, Vector

MAX_WORDS = 240  # of a question that is read


@dataclass(frozen=True)
class TrailWords:
    """Which end of a trail is the present position; where neither field says so, the image must."""

    near: ObjectPhrase | None = None
    side: Vector | None = None  # unit vector in the image


@dataclass(frozen=True)
class StepWords:
    """A leg of a motion: unit vector in the image, sine of the angle out of it, and how far or long."""

    direction: Vector | None
    depth: float
    quantities: tuple[QuantityWords, ...] = ()


@dataclass(frozen=True)
class MotionWords:
    """How the question says that something moves; None and 0 where it does not say.

    `direction` is a unit vector in image pixels, x right, y down. `depth` is the sine of the angle out of the image
    plane: -1 towards the camera, 1 away from it. `along_arrow`: else against it. `is_contradictory`: two of its words
    are opposites. `topples`: it falls over where it stands. `in_air`: it is let go, or falls freely. `steps` are the
    legs behind the first, `others` what moves at the same time.
    """

    kind: MotionKind | None = None
    along_arrow: bool | None = None
    direction: Vector | None = None
    depth: float = 0.0
    forward: bool | None = None
    verb: str = ""
    towards: ObjectPhrase | None = None
    trail: TrailWords | None = None
    quantities: tuple[QuantityWords, ...] = ()
    steps: tuple[StepWords, ...] = ()
    others: "tuple[tuple[ObjectPhrase, MotionWords], ...]" = ()
    is_contradictory: bool = False
    topples: bool = False
    in_air: bool = False


@dataclass(frozen=True)
class ChangeWords:
    """A change of the scene in the words of the question. `relation` and `targets` are those of `place`."""

    kind: InterventionKind
    object: ObjectPhrase
    relation: PlaceRelation | None = None
    targets: tuple[ObjectPhrase, ...] = ()


@dataclass(frozen=True)
class Question:
    """A what-if question taken apart. `others` are the further things that it names; `alternatives`, those among which
    it asks for the first. `unread` are the words of no form, those that tell the motion in `unread_motion`."""

    mover: ObjectPhrase | None = None
    motion: MotionWords = MotionWords()
    says_motion: bool = False
    changes: tuple[ChangeWords, ...] = ()
    asked: Asked | None = None
    others: tuple[ObjectPhrase, ...] = ()
    alternatives: tuple[ObjectPhrase, ...] = ()
    names_table: bool = False  # something is asked to come down on it, or to stay there
    names_arrow: bool = False
    names_direction: bool = False  # some word says which way, whether or not it was understood
    unread: tuple[str, ...] = ()
    unread_motion: tuple[str, ...] = ()


@lru_cache(maxsize=64)  # every stage of a request asks for it
def parse(question: str, names: tuple[str, ...] = ()) -> Question:
    """Takes a question apart; `names` are those of the given things. Never raises: what is not said is None or empty."""
    listed = split_options(question)
    text = without_reply_form(listed.rest)
    if len(text.split()) > MAX_WORDS:
        return Question(unread=(" ".join(text.split()[MAX_WORDS : MAX_WORDS + 7]),))
    options = [text for _, text in listed.options if not says_not_sure(text)]
    return _Parser(tokens_of(text, names), options).question()


_PIECES = {"asked": "asked", "moved": "motion", "changes": "change", "stated": "stated"}
_ORDER = ("asked", "motion", "change", "stated", "listed", "nothing")
_TELLING = ("sense", "ahead", "depth", "way", "goal", "quantity")
_THING = re.compile(r"X\d+")


@dataclass
class _Piece:
    """A run of tokens that one form covers."""

    what: str
    start: int
    end: int
    roles: dict[str, str] = field(default_factory=dict[str, str])
    form: forms.Form | None = None
    motion: MotionWords = MotionWords()

    @property
    def is_passive(self) -> bool:
        """Whether what is acted on stands in front of what acts."""
        return self.what == "asked" and [role for role in self.roles if role in {"s", "o"}][:1] == ["o"]

    def said(self, role: str) -> str:
        """What stands in a role."""
        return self.roles.get(role, "")

    def thing(self, role: str) -> str:
        """The thing in a role; nothing for a pronoun."""
        return self.said(role) if _THING.fullmatch(self.said(role)) else ""


class _Parser:
    """Covers a question with forms, the longest that fits at each place, and puts together what they say."""

    def __init__(self, tokens: Tokens, options: Sequence[str]) -> None:
        self.tokens, self.options, self.plain, self.said = tokens, options, tokens.plain, tokens.said
        self.mover, self.names_table = "", False
        self._put_behind()
        self.text, self.starts = " ".join(self.plain), [0]
        for token in self.plain:
            self.starts.append(self.starts[-1] + len(token) + 1)
        self.place_of = {start: at for at, start in enumerate(self.starts)}
        at, self.pieces = 0, list[_Piece]()
        while at < len(self.plain):
            found = self._from(at)
            self.pieces += found
            at = found[0].end if found else at + 1

    def _put_behind(self) -> None:
        """Puts "the ball, rolling left," in front of the question that it interrupts."""
        asks, way = (
            rf"(?:^| )(?P<asks>(?:will|be|ASK) (?P<thing>X\d+|it))",
            rf"(?P<way>(?:{forms.VERBS})(?: [^,.?]*?)?)",
        )
        text = " ".join(self.plain)
        found = re.search(rf"{asks} ,? ?(?:when |if )?{way}(?P<comma> ,) (?=[a-zA-Z])", text) or re.search(
            rf"{asks} {way}(?P<comma>) (?=(?:still |then )*(?!X|FLOOR|IMAGE)[a-z]+ (?:X|into|with|ANY))", text
        )
        if found is None:
            return
        start, at = (text[: found.start(name)].count(" ") for name in ("asks", "way"))
        length = len(found["way"].split())
        if not found["comma"] and not (self.said[at].endswith("ing") or self.said[at] == "thrown"):
            return
        for words in (self.plain, self.said):
            asking, moving = words[start : start + 2], words[at : at + length]
            words[start : at + length + bool(found["comma"])] = [asking[1], *moving, ",", *asking]

    def _from(self, at: int) -> list[_Piece]:
        """The longest piece that begins at a token, if any does."""
        found, start = [self._adverbials(_Piece("motion", at, at), "")], self.starts[at]
        for section in ("asked", "stated", "changes", "rest", "moved"):
            for form in forms.forms()[section]:
                if (match := form.pattern.match(self.text, start)) is not None:
                    piece = _Piece(_PIECES.get(section, form.says), at, self._end(match), forms.roles(match), form)
                    moves = section == "moved"
                    found.append(self._adverbials(piece, piece.roles.get("verb", form.says)) if moves else piece)
        told = [each for each in found if each.end > at and (each.what != "motion" or each.motion != MotionWords())]
        return sorted(told, key=lambda each: (-each.end, _ORDER.index(each.what)))[:1]

    def _end(self, match: re.Match[str]) -> int:
        """The place of the first token behind a match."""
        return self.place_of.get(match.end() + 1, len(self.plain))

    def _adverbials(self, piece: _Piece, verb: str) -> _Piece:
        """The piece with the words for the way that follow its verb."""
        legs, at, ways = [_Leg(verb)], piece.end, dict(forms.forms()["ways"])
        verbs = re.compile(rf"(?P<verb>{forms.VERBS})(?! X)(?= |$)")
        while at < len(self.plain):
            matches = ((name, way.match(self.text, self.starts[at])) for name, way in ways.items())
            name, match = next(((name, match) for name, match in matches if match is not None), ("", None))
            if match is None or not legs[-1].take(name, forms.roles(match), self.tokens):
                break
            end = self._end(match)
            if name == "then":
                again = verbs.match(self.text, self.starts[end])
                if again is None and not any(ways[each].match(self.text, self.starts[end]) for each in _TELLING):
                    break
                legs.append(_Leg(again["verb"] if again else ""))
                end = self._end(again) if again else end
            at = end
        kind = "static" if "n" in piece.roles else lex.KINDS.get(verb, "fall" if verb == "let go" else None)
        piece.end, piece.motion = at, _in_words(legs, kind)
        return piece

    def question(self) -> Question:
        """What all pieces together say."""
        asks, stated = ([each for each in self.pieces if each.what == what] for what in ("asked", "stated"))
        last = max((at for at, token in enumerate(self.plain[:-1]) if token in {".", "?"}), default=0)
        is_terse = not asks and stated and stated[-1].start >= last and self.plain[-1] not in {".", "!"}
        asking = asks[0] if asks else stated[-1] if is_terse or (stated and "CLAIM" in self.plain) else None
        told = [each for each in stated if each is not asking]
        changes = self._changes(asking)
        put = next((each.object for each in changes if each.kind == "place"), None)
        moving = self._moving(asking, told, put)
        acts = "" if asking is None else asking.thing("s")
        self.mover = next(iter(moving), self._token(put) if put else acts)
        first = next(iter(moving.values()), MotionWords())
        if put is not None and (not moving or first.kind == "static"):
            self.mover, first = self._token(put), MotionWords("place", verb="put")
        unread = self._unread(asking, asks, told, moving)
        asked, alternatives = (None, ()) if asking is None else self._asked(asking, told, changes)
        if asking is not None and asked is None:
            unread.append(("asked", " ".join(word for word in self.said[asking.start : asking.end] if word)))
        if asking is None and moving:
            asked = Asked(form="what-happens", relation="touches")  # "Push the red ball to the right."
        if not moving and asked is not None and asked.relation == "lands" and changes and put is None:
            first = MotionWords("fall", verb="fall")  # without its support
        gone = {self._token(each.object) for each in changes if each.kind == "remove"}
        named = next((each for each in self._named(len(self.plain)) if each not in gone and asking is None), "")
        mover = self._thing(self.mover or named) if self.mover or named else None
        further = tuple((self._thing(each), motion) for each, motion in moving.items() if each != self.mover)
        return Question(
            mover=mover,
            motion=replace(first, others=further),
            says_motion=bool(moving) or first != MotionWords(),
            changes=changes,
            asked=None if unread else asked,
            others=self._others(mover, changes, asked),
            alternatives=alternatives,
            names_table=self.names_table,
            names_arrow=any(word in {"ALONG", "AGAINST"} or "arrow" in word for word in (*self.plain, *self.said)),
            names_direction=not _DIRECTIONS.isdisjoint(self.plain),
            unread=tuple(dict.fromkeys(said for _, said in unread)),
            unread_motion=tuple(dict.fromkeys(said for what, said in unread if what == "motion")),
        )

    def _thing(self, token: str) -> ObjectPhrase:
        return self.tokens.things[int(token[1:])]

    def _token(self, thing: ObjectPhrase) -> str:
        return f"X{self.tokens.things.index(thing)}"

    def _named(self, at: int) -> list[str]:
        """The things named in front of a place, the first one first."""
        return list(dict.fromkeys(token for token in self.plain[:at] if _THING.fullmatch(token)))

    def _phrases(self, text: str) -> list[ObjectPhrase]:
        """The things and kinds of a list such as "X1 and X2"."""
        return [self._thing(token) for token in re.findall(r"[XPSK]\d+", text)]

    def _changes(self, asking: _Piece | None) -> tuple[ChangeWords, ...]:
        """What is taken away or put somewhere."""
        found = list[ChangeWords]()
        for piece in self.pieces:
            found += [ChangeWords("remove", phrase) for phrase in self._phrases(piece.said("r"))]
            if (relation := forms.relation_of(piece.roles)) is not None:
                target = self._resolved(piece.said("y"), piece.start, piece.said("x")) or ""
                targets = [each for each in self._phrases(f"{target} {piece.said('z')}") if each.head != "container"]
                found.append(ChangeWords("place", self._thing(piece.said("x")), relation, tuple(targets)))
        moves = found or any(each.what == "motion" for each in self.pieces)
        if asking is not None and asking.form is not None and asking.form.asks[1] == "inside" and not moves:
            targets = self._phrases(asking.thing("o"))  # "Does the apple fit into the bowl?": it is put there
            fits = asking.thing("s") and (targets or asking.said("l"))
            found += [ChangeWords("place", self._thing(asking.said("s")), "into", tuple(targets))] if fits else []
        return tuple(dict.fromkeys(found))

    def _moving(
        self, asking: _Piece | None, told: Sequence[_Piece], put: ObjectPhrase | None
    ) -> dict[str, MotionWords]:
        """What moves and how, that of the question first."""
        found = dict[str, MotionWords]()
        for piece in self.pieces:
            if piece in told and piece.thing("s") and not found:
                struck = self._thing(piece.said("o")) if piece.thing("o") else None
                found[piece.said("s")] = MotionWords("linear", towards=struck)  # "if the cue ball strikes the red ball"
            if piece.what != "motion":
                continue
            said, before, token = piece.said("m"), self._named(piece.start), piece.thing("m") or piece.said("m")
            if asking is not None and token in {"", "it"}:
                # "Will the bottle be hidden behind the book if it moves": what the question is about.
                acts = asking.thing(
                    "o" if asking.is_passive and "behind" in self.plain[asking.start : asking.end] else "s"
                )
                early = said == "it" or not before or asking.start < piece.start
                token = acts if acts and early else ""
            token = token if token != "it" else ""
            token = token or (next(reversed(found), "") if said != "it" else "")
            free = [each for each in before if put is None or self._thing(each) != put]
            token = token or next(iter([*(free if said else before), *before]), "")
            token = token or next((each for each in self.plain[piece.end :] if _THING.fullmatch(each)), "")
            token = token.split()[-1].replace("P", "X").replace("S", "X") if token else ""
            if token:
                found[token] = _joined(found[token], piece.motion) if token in found else piece.motion
        return found

    def _resolved(self, token: str, at: int, subject: str) -> str | None:
        """The thing that a word stands for. "It" and "that" are the last thing named in front of a place that is not
        the subject; "the other one" is the one that is left of two."""
        if _THING.fullmatch(token) and self._thing(token).is_other:
            return self._other(subject, token)
        if re.fullmatch(r"[XPS]\d+", token):
            return token
        if token == "itself" or (token == "it" and self.mover not in {"", subject}):
            return subject if token == "itself" else self.mover
        named = [each for each in self.plain[:at] if _THING.fullmatch(each) and each != subject]
        return named[-1] if named and token in {"it", "that", "this"} else None

    def _other(self, subject: str, token: str) -> str | None:
        """The one thing, of those that are given or else named, that is not the subject; the word itself where the
        picture must tell."""
        own = plain(self._thing(subject).text) if subject else ""
        if left := [name for name in self.tokens.names if plain(name) != own]:
            phrase = replace(parse_noun_phrase(left[0]) or self._thing(token), text=left[0], is_given=True)
            return f"X{self.tokens.number(phrase)}" if len(left) == 1 else None
        things = [each for each in self._named(len(self.plain)) if each not in {subject, token}]
        return token if not things else things[0] if len(things) == 1 else None

    def _asked(
        self, asking: _Piece, told: Sequence[_Piece], changes: Sequence[ChangeWords]
    ) -> tuple[Asked | None, tuple[ObjectPhrase, ...]]:
        """What is asked, and among which things; None where that is not clear."""
        if asking.form is None:
            return None, ()
        form, relation, is_negated = asking.form.asks
        words, said, passive = self.plain[asking.start : asking.end], asking.said("o"), asking.is_passive
        doubly = is_negated and ("n" in asking.roles or asking.said("q") == "NOOF")
        open_it = told and asking.said("s") in {"it", "that"} and form != "which-to-remove" and not asking.said("r")
        if doubly or open_it or (said == "EVERYTHING" and not is_negated) or said == "OBJ":
            return None, ()
        subject, target = asking.thing("s") or self.mover, ""
        if "both" in asking.roles:
            moved = [each.thing("m") for each in self.pieces if each.what == "motion" and each.thing("m")]
            pairs = ([each for each in dict.fromkeys(names) if each != subject] for names in (moved, self._named(999)))
            pair = next((each for each in pairs if each), [])
            if len(pair) != 1:
                return None, ()
            target = pair[0]
        elif said not in {"", "ANY", "EVERYTHING"}:
            target = (self.mover if passive and said == "it" else self._resolved(said, asking.start, subject)) or ""
            if not target:
                return None, ()
        doer = subject if subject != self.mover else ""
        if relation == "covers" and target:
            if doer and target == self.mover:  # "the vase hides it"
                relation, target, doer = "covered", doer, ""
            elif passive and asking.thing("s") and target == self.mover:
                relation, target = "covered", subject
            elif passive and doer:  # one thing by another, neither the mover
                relation, target, doer = "covered", doer, target
            elif passive and target == self.mover:
                relation, target = "covered", ""
        elif target == self.mover and doer and relation == "touches":
            target, doer = doer, ""
        elif passive and target == self.mover and relation == "touches":
            target = ""
        thing = self._thing(target) if target else None
        if relation == "lands" and thing is not None:  # "off the table"
            self.names_table, thing = thing.head in lex.TABLES, None
            if not self.names_table:
                return None, ()
        if relation == "inside" and form == "whether":
            puts = [each.targets[0] for each in changes if each.targets]
            thing = thing or next(iter(puts), None)
            along = not {"roll", "slide", "move", "drive", "push"}.isdisjoint(words)
            holds = thing is not None and thing.head in (lex.SETS["hollow"] if along else lex.CONTAINERS)
            relation = "inside" if holds or "fit" in words or changes else "touches"
            if thing is None:
                return None, ()
        if relation == "touches" and thing is not None and thing.head in lex.TABLES and not thing.colour:
            on = not {"on", "onto"}.isdisjoint(words)
            self.names_table, relation, thing = (True, "lands", None) if on else (False, relation, thing)
        crash = [each.thing("o") for each in told if each.thing("o")]
        if (form == "which-to-remove" or asking.said("r")) and thing is None and crash:
            thing = self._thing(crash[-1])  # "It will collide with the lamp. Which object should be removed ..."
        lists = [each.said("l") for each in (asking, *self.pieces) if each.said("l")]
        listed, kinds = self._phrases(lists[0]) if lists else [], self._phrases(asking.said("k"))
        among = self._phrases(asking.said("a")) if form == "whether" else kinds if form == "how-many" else []
        if form in {"which", "which-to-remove"}:
            options = [parse_noun_phrase(text) for text in self.options] if form == "which-to-remove" else []
            among = listed or ([each for each in options if each is not None] if all(options) else [])
        names_one = form in {"whether", "when", "what-happens", "which-to-remove"}
        asked = Asked(
            form=form,
            relation=relation,
            subject=self._thing(doer).text if doer and form != "which-to-remove" else None,
            target=thing.text if thing is not None and names_one else None,
            negated=is_negated != ("n" in asking.roles or asking.said("q") == "NOOF"),
            among=tuple(each.text for each in among),
            every=asking.said("q") == "ALLOF" and not is_negated,
            partly=relation in {"covers", "covered"} and not {"PARTLY", "SOMETIME"}.isdisjoint(self.plain),
            within=min((each.within for each in self.tokens.quantities if each.within is not None), default=None),
        )
        return asked, tuple(listed or kinds) if form == "which-first" else ()

    def _others(
        self, mover: ObjectPhrase | None, changes: Sequence[ChangeWords], asked: Asked | None
    ) -> tuple[ObjectPhrase, ...]:
        """The further things that are named, each once."""
        removed = [each.object for each in changes if each.kind == "remove"]
        phrases = [self._thing(token) for token in self._named(len(self.plain))]
        if asked is not None and asked.form == "which-to-remove":
            phrases += [each for each in map(parse_noun_phrase, asked.among) if each is not None]
        named = {plain(each.text): each for each in reversed(phrases) if each.head != "container"}
        return tuple(each for each in reversed(named.values()) if each not in (mover, *removed))

    def _unread(
        self, asking: _Piece | None, asks: Sequence[_Piece], told: Sequence[_Piece], moving: dict[str, MotionWords]
    ) -> list[tuple[str, str]]:
        """The words that no form covers, each run with the part of the question to which it belongs."""
        form = "" if asking is None or asking.form is None else asking.form.asks[0]
        names_crash = asking is not None and (form == "which-to-remove" or asking.said("r"))
        struck = "" if asking is None else asking.thing("s")
        lost = [each for each in asks if each is not asking]
        lost += [each for each in self.pieces if each.what == "listed" and form != "which-first"]
        # What is told to be hit, and is not what the question then goes on about.
        lost += [each for each in told if not names_crash and (each.said("o") != struck or not struck)]
        read = {at for each in self.pieces if each not in lost for at in range(each.start, each.end)}
        runs: list[list[int]] = [[]]
        for at, token in enumerate(self.plain):
            if at in read or token in {".", "?", "!", ";", ","}:
                runs.append([])
            else:
                runs[-1].append(at)
        found = list[tuple[str, str]]()
        for run in runs:
            words = [self.plain[at] for at in run]
            limits = [word for word in words if word[0] == "Q" and self.tokens.quantities[int(word[1:])].within]
            if all(word in forms.CONNECTORS or word in limits for word in words):
                continue
            ends = [
                each
                for each in self.pieces
                if each.end <= run[0] and not {".", "?"} & set(self.plain[each.end : run[0]])
            ]
            what = "motion" if ends and ends[-1].what == "motion" else "asked"
            found.append((what, " ".join(self.said[at] for at in run if self.said[at]) or " ".join(words)))
        return found


_DIRECTIONS = {*forms.WAYS, *map(str.upper, forms.WAYS), "FORWARD", "BACKWARD", "NEAR", "AWAY", "opposite"}


def _joined(first: MotionWords, second: MotionWords) -> MotionWords:
    """A motion that is told in two places."""
    empty = vars(MotionWords())
    told = {name: value for name, value in vars(second).items() if value != empty[name]}
    single = ("kind", "direction", "depth", "along_arrow", "forward")
    clash = any(name in told and getattr(first, name) not in (empty[name], told[name]) for name in single)
    kept = {name: value for name, value in told.items() if getattr(first, name) == empty[name]}
    quantities = (*first.quantities, *second.quantities)
    return replace(first, **kept | {"quantities": quantities, "is_contradictory": clash or first.is_contradictory})


_RISING, _SINKING = lex.words("lift raise rise climb ascend"), lex.words("descend lower")


@dataclass
class _Leg:
    """What the words of one leg say."""

    verb: str
    ways: list[Vector] = field(default_factory=list[Vector])
    depths: set[float] = field(default_factory=set[float])
    senses: set[bool] = field(default_factory=set[bool])
    ahead: set[bool] = field(default_factory=set[bool])
    towards: ObjectPhrase | None = None
    trail: TrailWords | None = None
    marks: set[str] = field(default_factory=set[str])
    quantities: list[QuantityWords] = field(default_factory=list[QuantityWords])

    def take(self, name: str, roles: dict[str, str], tokens: Tokens) -> bool:
        """Takes words for the way; false where they say nothing here."""
        text = next(iter(roles.values()), "")
        if name == "trail":
            near = tokens.things[int(roles["near"][1:])] if "near" in roles else None
            self.trail = TrailWords(near, forms.SIDES.get(roles.get("side", "")))
        elif name == "way":
            self.ways.append(forms.WAYS[text.lower()])
        elif name == "depth":
            self.depths.add(-1.0 if text == "NEAR" else 1.0)
        elif name == "sense":
            self.senses.add(text == "ALONG")
        elif name == "ahead":
            self.ahead.add(text == "FORWARD")
        elif name == "goal" and self.towards is None:
            self.towards = tokens.things[int(text[1:])]
        elif name == "quantity" and not tokens.quantities[int(text[1:])].within:
            self.quantities.append(tokens.quantities[int(text[1:])])
        elif name in {"goal", "quantity"} or (name == "halt" and not self.quantities):
            return False
        self.marks.add(name)
        return True

    def way(self, kind: MotionKind | None) -> tuple[Vector | None, float]:
        """A unit vector in the image, and the depth."""
        x, y = (sum(way[axis] for way in self.ways) for axis in (0, 1))
        if kind == "fall":
            y = 0.0  # down is what a fall does; only what leads away from it is a direction
        elif not self.ways:
            y = -1.0 if self.verb in _RISING else 1.0 if self.verb in _SINKING else 0.0
        length, depth = math.hypot(x, y), float(sum(self.depths))
        return ((x / length, y / length), depth * math.sqrt(0.5)) if length > 1e-9 else (None, depth)

    @property
    def contradicts(self) -> bool:
        """Whether two of its words are opposites."""
        up, falls = [way[1] for way in self.ways], self.verb in lex.SETS["fall"]
        turned = (falls and min(up, default=0) < 0) or (self.verb in _RISING and max(up, default=0) > 0)
        opposed = any(a[0] * b[0] < 0 or a[1] * b[1] < 0 for a in self.ways for b in self.ways)
        stays = "still" in self.marks and bool(self.ways or self.depths or self.senses)
        return turned or opposed or stays or any(len(each) > 1 for each in (self.depths, self.senses, self.ahead))


def _in_words(legs: Sequence[_Leg], kind: MotionKind | None) -> MotionWords:
    """The motion that some legs make."""
    first, *rest = legs
    over = "over" in first.marks and first.verb in lex.words("knock push tip fall turn blow topple")
    direction, depth = first.way(kind)
    return MotionWords(
        kind=kind,
        along_arrow=next(iter(first.senses), None),
        direction=direction,
        depth=depth,
        forward=False if first.verb == "reverse" else None if first.senses else next(iter(first.ahead), None),
        verb=first.verb,
        towards=first.towards,
        trail=first.trail,
        quantities=tuple(first.quantities),
        steps=tuple(StepWords(*leg.way(None), tuple(leg.quantities)) for leg in rest),
        is_contradictory=any(leg.contradicts for leg in legs),
        topples=over or first.verb in {"tip", "topple"},
        in_air=first.verb in {"drop", "release", "detach", "let go"} or "freely" in first.marks,
    )


_TOPICS = (
    (r"fit|put|contain|inside", ("Does the {m} fit into the {o}?",)),
    (r"hid|occlu|cover|behind|block|view|visible", ("If the {m} moves {way}, will it hide the {o}?", "If the {m} moves {way}, will the {o} be occluded?")),
    (r"remov|taken? |avoid|prevent|without", ("If the {m} moves {way}, can the collision be avoided by removing the {o}?", "If the {m} moves {way}, which object should be removed to avoid the collision?")),
    (r"first|order|which", ("If the {m} moves {way}, which object will it hit first?",)),
    (r"", ("If the {m} moves {way}, will it hit the {o}?", "If the {m} moves {way}, what happens?")),
)  # fmt: skip


def rewordings(question: Question) -> tuple[str, ...]:
    """Up to three questions in forms that are read, with the names of this one and about what it asks."""
    names = [each.text for each in (question.mover, *question.others) if each is not None and " of " not in each.text]
    motion, said = question.motion, " ".join(question.unread).lower()
    ways = {(-1.0, 0.0): "to the left", (1.0, 0.0): "to the right"}
    way = "opposite to the direction of the arrow" if motion.along_arrow is False else "in the direction of the arrow"
    way = ways.get(motion.direction or (0.0, 0.0), way if motion.forward is None else "forward")
    found = list[str]()
    for topic, patterns in _TOPICS:
        if re.search(topic, said) and names:
            found += [
                each.format(m=names[0], o=names[1] if len(names) > 1 else "", way=way)
                for each in patterns
                if len(names) > 1 or "{o}" not in each
            ]
    read = [each for each in found if parse(each).asked is not None]
    return tuple(dict.fromkeys(read))[:3]
