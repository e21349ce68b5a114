"""Reads a question by its sentence forms: what moves and how, what is changed, what is asked, and what was not read."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import accumulate, groupby
from typing import cast

from cow_service import records
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.noun_phrases import Tokens, parse_noun_phrase, tokens_of
from cow_service.readers.options import plain, says_not_sure, split_options, without_reply_form
from cow_service.records import Asked, AskedRelation, MotionKind, PlaceRelation, Vector

MAX_WORDS = 240  # of a question that is read
_THING = re.compile(r"X\d+")
_DIRECTIONS = {*lex.WAYS, *map(str.upper, lex.WAYS), "FORWARD", "BACKWARD", "NEAR", "AWAY", "opposite"}
_RISING, _SINKING = lex.words("lift raise rise climb ascend"), lex.words("descend lower")
_TOPPLING = lex.words("knock push tip fall turn blow topple")


@dataclass(frozen=True)
class MotionWords:
    """How the question says that something moves; None and 0 where it does not say."""

    kind: MotionKind | None = None
    along_arrow: bool | None = None  # else against it
    direction: Vector | None = None  # a unit vector in image pixels, x right, y down
    depth: float = 0.0  # sine of the angle out of the image plane: -1 towards the camera, 1 away from it
    forward: bool | None = None
    verb: str = ""
    towards: lex.ObjectPhrase | None = None
    trail: bool = False  # on along it
    trail_end: lex.ObjectPhrase | Vector | None = None  # the thing, or the side, to which it is nearest now
    quantities: tuple[lex.QuantityWords, ...] = ()
    steps: "tuple[MotionWords, ...]" = ()  # the legs behind the first
    others: "tuple[tuple[lex.ObjectPhrase, MotionWords], ...]" = ()  # what moves at the same time
    is_contradictory: bool = False  # two of its words are opposites
    topples: bool = False  # it falls over where it stands
    in_air: bool = False  # it is let go, or falls freely


NOT_SAID = MotionWords()
_NO_FORM = lex.Form("", re.compile(""))


@dataclass(frozen=True)
class ChangeWords:
    """A change of the scene in the words of the question. `relation` and `targets` are those of `place`."""

    kind: records.InterventionKind
    object: lex.ObjectPhrase
    relation: PlaceRelation | None = None
    targets: tuple[lex.ObjectPhrase, ...] = ()

    @property
    def is_whole(self) -> bool:
        """Whether it tells what is put where, each of them another thing."""
        count = 2 if self.relation == "between" else 1
        return self.kind == "remove" or len(self.targets) + 1 == len({self.object, *self.targets}) == count + 1


@dataclass(frozen=True)
class Question:
    """A what-if question taken apart. `others` are the further things that it names; `alternatives`, those among which
    it asks for the first. `unread` are the words of no form, those that tell the motion in `unread_motion`."""

    mover: lex.ObjectPhrase | None = None
    motion: MotionWords = NOT_SAID
    says_motion: bool = False
    changes: tuple[ChangeWords, ...] = ()
    asked: Asked | None = None
    others: tuple[lex.ObjectPhrase, ...] = ()
    alternatives: tuple[lex.ObjectPhrase, ...] = ()
    names_arrow: bool = False
    names_direction: bool = False  # some word says which way, whether or not it was understood
    unread: tuple[str, ...] = ()
    unread_motion: tuple[str, ...] = ()


@lru_cache(maxsize=64)  # every stage of a request asks for it
def parse(question: str, names: tuple[str, ...] = ()) -> Question:
    """Takes a question apart; `names` are those of the given things. What is not said is None or empty."""
    listed = split_options(question)
    text = without_reply_form(listed.rest)
    if len(text.split()) > MAX_WORDS:
        return Question(unread=(" ".join(text.split()[MAX_WORDS : MAX_WORDS + 7]),))
    options = [text for _, text in listed.options if not says_not_sure(text)]
    tokens = tokens_of(text, names)
    if too_long := tuple(each.text for each in tokens.things if len(each.text) > records.MAX_OBJECT_WORDS):
        return Question(unread=too_long)
    return _Parser(tokens, options).question()


MOST_OF_A_NAME = 5  # words: what is longer is no name, but words that were not understood


def rewordings(question: Question) -> tuple[str, ...]:
    """Up to three questions in forms that are read, with the names of this one and about what it asks."""
    names = [each.text for each in (question.mover, *question.others) if each is not None]
    motion, said = question.motion, " ".join(question.unread).lower()
    # Words that were not read are no name without a determiner: in "will it frobnicate the mug" only "mug" is one.
    texts = [each.lower() for each in names]
    clear = (n for n in texts if n not in said or re.search(rf"\b(the|an?|this|that) {re.escape(n)}\b", said))
    names = [name for name in clear if name.isascii() and len(name.split()) <= MOST_OF_A_NAME]
    if question.mover is None or question.mover.text.lower() not in names:
        return ()
    way = "opposite to the direction of the arrow" if motion.along_arrow is False else "in the direction of the arrow"
    way = next((f"to the {name}" for name in ("left", "right") if motion.direction == lex.WAYS[name]), way)
    way, (mover, other) = "forward" if motion.forward else way, (*names, "", "")[:2]
    like = [
        form.replace("<m>", mover).replace("<o>", other).replace("<way>", way)
        for topic, form in lex.sections()["rewordings"]
        if re.search(topic, said) and mover and (other or "<o>" not in form)
    ]
    return tuple(dict.fromkeys(each for each in like if parse(each).asked is not None))[:3]


@dataclass
class _Piece:
    """A run of tokens that one form covers."""

    what: str
    start: int
    end: int
    roles: dict[str, str] = field(default_factory=dict[str, str])
    form: lex.Form = _NO_FORM
    motion: MotionWords = NOT_SAID

    @property
    def is_passive(self) -> bool:
        """Whether what is acted on stands in front of what acts."""
        return self.what == "asked" and next((role for role in self.roles if role in {"s", "o", "a"}), "s") != "s"

    def said(self, role: str) -> str:
        """What stands in a role."""
        return self.roles.get(role, "")

    def thing(self, role: str) -> str:
        """The thing in a role; nothing for a pronoun."""
        return self.said(role) if _THING.fullmatch(self.said(role)) else ""


_KINDS = {"asked": "asked", "moved": "motion", "changes": "change", "stated": "stated"}  # of pieces, by section
_ORDER = ("asked", "motion", "change", "stated", "listed", "nothing")
_TELLING = ("sense", "ahead", "depth", "way", "goal", "quantity")


class _Parser:
    """Covers a question with forms, the longest that fits at each place, and puts together what they say."""

    def __init__(self, tokens: Tokens, options: Sequence[str]) -> None:
        self.tokens, self.options, self.plain, self.said = tokens, options, tokens.plain, tokens.said
        self.text, self.starts = " ".join(self.plain), [0, *accumulate(len(token) + 1 for token in self.plain)]
        self.mover = ""
        self.told, self.changes = list[_Piece](), tuple[ChangeWords, ...]()
        self.place_of = {start: at for at, start in enumerate(self.starts)}
        at, self.pieces = 0, list[_Piece]()
        while at < len(self.plain):
            found = self._from(at)
            self.pieces += found
            at = found[0].end if found else at + 1

    def _from(self, at: int) -> list[_Piece]:
        """The longest piece that begins at a token, if any does."""
        found, start = [self._adverbials(_Piece("motion", at, at), "")], self.starts[at]
        for section in ("asked", "stated", "changes", "rest", "moved"):
            for form in lex.forms()[section]:
                if (match := form.pattern.match(self.text, start)) is not None:
                    piece = _Piece(_KINDS.get(section, form.says), at, self._end(match), lex.roles(match), form)
                    verb = piece.roles.get("verb", form.says)
                    found.append(self._adverbials(piece, verb) if section == "moved" else piece)
        told = [each for each in found if each.end > at and (each.what != "motion" or each.motion != NOT_SAID)]
        return sorted(told, key=lambda each: (-each.end, _ORDER.index(each.what)))[:1]

    def _end(self, match: re.Match[str]) -> int:
        """The place of the first token behind a match."""
        return self.place_of.get(match.end() + 1, len(self.plain))

    def _adverbials(self, piece: _Piece, verb: str) -> _Piece:
        """The piece with the words for the way that follow its verb."""
        legs, at, ways = [(verb, list[tuple[str, str]]())], piece.end, dict(lex.forms()["ways"])
        verbs = re.compile(rf"({lex.VERB})(?! X)(?= |$)")
        while at < len(self.plain):
            matches = ((name, way.match(self.text, self.starts[at])) for name, way in ways.items())
            name, match = next(((name, match) for name, match in matches if match is not None), ("", None))
            names = {each for each, _ in legs[-1][1]}
            again = (name == "goal" and "goal" in names) or (name == "halt" and "quantity" not in names)
            if match is None or again:
                break
            end = self._end(match)
            if name == "then":
                verb_of_leg = verbs.match(self.text, self.starts[end])
                if verb_of_leg is None and not any(ways[each].match(self.text, self.starts[end]) for each in _TELLING):
                    break
                legs.append((verb_of_leg[1] if verb_of_leg else "", []))
                end = self._end(verb_of_leg) if verb_of_leg else end
            legs[-1][1].extend(lex.roles(match).items() or [(name, "")])
            legs[-1][1].append((name, "")) if name == "trail" else None
            at = end
        kind = "static" if "n" in piece.roles else lex.KINDS.get(verb)
        motions = [motion_of(*leg, self.tokens, None if at else kind) for at, leg in enumerate(legs)]
        clashes = any(each.is_contradictory for each in motions)
        piece.end, piece.motion = at, replace(motions[0], steps=tuple(motions[1:]), is_contradictory=clashes)
        return piece

    def question(self) -> Question:
        """What all pieces together say."""
        asks = [each for each in self.pieces if each.what == "asked"]
        asking = asks[0] if asks else self._claim()
        self.told = [each for each in self.pieces if each.what == "stated" and each is not asking]
        self.changes = self._changes(asking)
        moving = self._moving(asking)
        put = next((each.object for each in self.changes if each.kind == "place"), None)
        self.mover, motion = next(iter(moving.items()), ("" if asking is None else asking.thing("s"), NOT_SAID))
        if put is not None and (not moving or motion.kind == "static"):
            self.mover, motion = self._token(put), MotionWords("place", verb="put")
        unread = self._unread(asking, asks[1:])
        if asking is None:  # "Push the red ball to the right."
            asked = Asked(form="what-happens", relation="touches") if moving else None
        elif (asked := self._asked(asking)) is None:
            unread.append(("asked", " ".join(filter(None, self.said[asking.start : asking.end]))))
        gone = [each.object for each in self.changes if each.kind == "remove"]
        phrases = [*map(self._thing, self._named())]
        left = (each for each in phrases if each not in gone and asking is None)
        mover = self._thing(self.mover) if self.mover else next(left, None)
        if asked is not None and asked.form == "which-to-remove":
            phrases += filter(None, map(parse_noun_phrase, asked.among))
        named = {plain(each.text): each for each in reversed(phrases) if each.head != "container"}
        further = tuple((self._thing(each), way) for each, way in moving.items() if each != self.mover)
        return Question(
            mover=mover,
            motion=replace(motion, others=further),
            says_motion=bool(moving) or motion != NOT_SAID,
            changes=self.changes,
            asked=None if unread else asked,
            others=tuple(each for each in reversed(named.values()) if each not in (mover, *gone)),
            alternatives=tuple(self._among(asking)) if asking and asked and asked.form == "which-first" else (),
            names_arrow=any(word in {"ALONG", "AGAINST"} or "arrow" in word for word in (*self.plain, *self.said)),
            names_direction=not _DIRECTIONS.isdisjoint(self.plain),
            unread=tuple(dict.fromkeys(said for _, said in unread)),
            unread_motion=tuple(dict.fromkeys(said for what, said in unread if what == "motion")),
        )

    def _claim(self) -> _Piece | None:
        """The statement that stands for a question, as in "True or false: the ball hits the mug"."""
        stated = [each for each in self.pieces if each.what == "stated"]
        last = max((at for at, token in enumerate(self.plain[:-1]) if token in {".", "?"}), default=0)
        is_terse = stated and stated[-1].start >= last and self.plain[-1] not in {".", "!"}
        return stated[-1] if is_terse or (stated and "CLAIM" in self.plain) else None

    def _thing(self, token: str) -> lex.ObjectPhrase:
        return self.tokens.things[int(token[1:])]

    def _token(self, thing: lex.ObjectPhrase) -> str:
        return f"X{self.tokens.things.index(thing)}"

    def _named(self, at: int | None = None) -> list[str]:
        """The things named in front of a place, or at all, the first one first."""
        return list(dict.fromkeys(token for token in self.plain[:at] if _THING.fullmatch(token)))

    def _phrases(self, text: str) -> list[lex.ObjectPhrase]:
        """The things and kinds of a list such as "X1 and X2"."""
        return [self._thing(token) for token in re.findall(r"[XPSK]\d+", text)]

    def _changes(self, asking: _Piece | None) -> tuple[ChangeWords, ...]:
        """What is taken away or put somewhere."""
        found = list[ChangeWords]()
        for piece in self.pieces:
            found += [ChangeWords("remove", phrase) for phrase in self._phrases(piece.said("r"))]
            relations = [name for name, _ in lex.sections()["where"] if name.replace("-", "") in piece.roles]
            if relations:
                target = self._resolved(piece.said("y"), piece.start, piece.said("x")) or ""
                targets = [each for each in self._phrases(f"{target} {piece.said('z')}") if each.head != "container"]
                put, relation = self._thing(piece.said("x")), cast(PlaceRelation, relations[0])
                found.append(ChangeWords("place", put, relation, tuple(targets)))
        moves = found or any(each.what == "motion" and each.motion.kind != "static" for each in self.pieces)
        if asking is not None and asking.form.asks[1] == "inside" and not moves:
            targets = self._phrases(asking.thing("o"))  # "Does the apple fit into the bowl?": it is put there
            fits = asking.thing("s") and (targets or asking.said("l"))
            found += [ChangeWords("place", self._thing(asking.said("s")), "into", tuple(targets))] if fits else []
        return tuple(dict.fromkeys(found))

    def _moving(self, asking: _Piece | None) -> dict[str, MotionWords]:
        """What moves and how, that of the question first."""
        found = dict[str, MotionWords]()
        for piece in self.pieces:
            if piece in self.told and piece.thing("s") and not found:
                struck = self._thing(piece.said("o")) if piece.thing("o") else None
                found[piece.said("s")] = MotionWords("linear", towards=struck)  # "if the cue ball strikes the red ball"
            if piece.what != "motion" or piece.said("m") == "OBJ":
                continue
            said, before, token = piece.said("m"), self._named(piece.start), piece.thing("m") or piece.said("m")
            if asking is not None and token in {"", "it"}:
                # "Will the bottle be hidden behind the book if it moves": what the question is about.
                is_hidden = asking.is_passive and "behind" in self.plain[asking.start : asking.end]
                acts = asking.thing("o" if is_hidden else "s")
                early = said == "it" or not before or asking.start < piece.start
                token = acts if acts and early else ""
            token = token if token not in {"", "it"} else next(reversed(found), "") if said != "it" else ""
            listed = any(each.what == "nothing" and each.end < piece.start for each in self.pieces)
            if said == "it" and not token and listed and len(before) > 1:
                continue  # "There is a ball and a mug. If it rolls ...": which one?
            token = (token or next(iter(before), "")).split(" ")[-1].replace("P", "X").replace("S", "X")
            if token:
                found[token] = joined(found[token], piece.motion) if token in found else piece.motion
        return found

    def _resolved(self, token: str, at: int, subject: str) -> str | None:
        """The thing that a word stands for. "It" and "that" are the last thing named in front of a place that is not
        the subject; "the other one" is the one that is left of two."""
        if _THING.fullmatch(token) and self._thing(token).is_other:
            # The one thing, of those that are given or else named, that is not the subject; else the picture tells.
            own = plain(self._thing(subject).text) if subject else ""
            left = [name for name in self.tokens.names if plain(name) != own]
            if len(left) == 1:
                phrase = parse_noun_phrase(left[0]) or self._thing(token)
                return f"X{self.tokens.number(replace(phrase, text=left[0], is_given=True))}"
            things = [] if left else [each for each in self._named() if each not in {subject, token}]
            return None if left else token if not things else things[0] if len(things) == 1 else None
        if re.fullmatch(r"[XPS]\d+", token):
            return token
        if token == "itself" or (token == "it" and self.mover not in {"", subject}):
            return subject if token == "itself" else self.mover
        named = [each for each in self.plain[:at] if _THING.fullmatch(each) and each != subject]
        return named[-1] if named and token in {"it", "that", "this"} else None

    def _asked(self, asking: _Piece) -> Asked | None:
        """What is asked; None where that is not clear."""
        form, relation, is_negated = asking.form.asks
        is_turned, counts = "n" in asking.roles or asking.said("q") == "NOOF", asking.said("q")
        target, among = self._target(asking), [] if form == "which-first" else self._among(asking)
        unclear = is_turned and (is_negated or counts == "ALLOF")
        if target is None or unclear or (asking.said("o") == "EVERYTHING" and not is_negated):
            return None
        relation, doer, target = self._turned(asking, relation, target)
        meant = self._meant(asking, relation, self._thing(target) if target else None)
        within = min((each.value for each in self.tokens.quantities if each.what == "within"), default=None)
        is_endless = within is not None and not 0 < within <= records.MAX_WITHIN
        if meant is None or is_endless or len(among) > records.MAX_OBJECTS:
            return None
        relation, thing = meant
        names_one = form in {"whether", "when", "what-happens", "which-to-remove"}
        return Asked(
            form=form,
            relation=relation,
            subject=self._thing(doer).text if doer and form != "which-to-remove" else None,
            target=thing.text if thing is not None and names_one else None,
            negated=is_negated != is_turned,
            among=tuple(each.text for each in among),
            every=counts == "SOMEOF" if is_negated and asking.is_passive else counts == "ALLOF" and not is_negated,
            partly=relation in {"covers", "covered"} and not {"PARTLY", "SOMETIME"}.isdisjoint(self.plain),
            within=within,
        )

    def _meant(
        self, asking: _Piece, relation: AskedRelation, thing: lex.ObjectPhrase | None
    ) -> tuple[AskedRelation, lex.ObjectPhrase | None] | None:
        """The relation and the thing as they are meant; None where that is not clear."""
        form, words = asking.form.asks[0], self.plain[asking.start : asking.end]
        if relation == "lands" and thing is not None:  # "off the table"
            if thing.head not in lex.TABLES and {"off", "on"}.isdisjoint(words):
                return None
            thing = None if thing.head in lex.TABLES else thing
        if relation == "inside" and form == "whether":
            thing = thing or next((each.targets[0] for each in self.changes if each.targets), None)
            if thing is None:
                return None
            along = not {"roll", "slide", "move", "drive", "push"}.isdisjoint(words)
            holds = thing.head in (lex.SETS["hollow"] if along else lex.CONTAINERS)
            relation = "inside" if holds or "fit" in words or self.changes else "touches"
        crash = [each.thing("o") for each in self.told if each.thing("o")]
        if (form == "which-to-remove" or asking.said("r")) and thing is None and crash:
            thing = self._thing(crash[-1])  # "It will collide with the lamp. Which object should be removed ..."
        return relation, thing

    def _among(self, asking: _Piece) -> list[lex.ObjectPhrase]:
        """The things among which the question asks for some: those that it lists, or that its options name."""
        kinds, options = self._phrases(asking.said("k")), [*filter(None, map(parse_noun_phrase, self.options))]
        listed = self._phrases(next(filter(None, (each.said("l") for each in (asking, *self.pieces))), ""))
        named = listed or (options if len(options) == len(self.options) else [])
        by_form = {"whether": self._phrases(asking.said("a")), "how-many": kinds, "which": listed}
        by_form |= {"which-first": listed or kinds, "which-to-remove": named}
        return by_form.get(asking.form.asks[0], [])

    def _target(self, asking: _Piece) -> str | None:
        """The thing that is acted on; empty for any, None where it is not clear which."""
        said, subject = asking.said("o"), asking.thing("s") or self.mover
        moved = [each.thing("m") for each in self.pieces if each.what == "motion" and each.thing("m")]
        form = asking.form.asks[0]
        is_open = (self.told or len(moved) > 1) and asking.said("s") == "it" and form != "which-to-remove"
        elsewhere = form == "where" and subject != self.mover
        if (is_open and not asking.said("r")) or said == "OBJ" or elsewhere:
            return None  # the mover, or what it strikes
        if "both" in asking.roles:
            pairs = ([each for each in dict.fromkeys(names) if each != subject] for names in (moved, self._named()))
            pair = next((each for each in pairs if each), [])
            return pair[0] if len(pair) == 1 else None
        if said in {"", "ANY", "EVERYTHING"}:
            return ""
        return self.mover if asking.is_passive and said == "it" else self._resolved(said, asking.start, subject)

    def _turned(self, asking: _Piece, relation: AskedRelation, target: str) -> tuple[AskedRelation, str, str]:
        """Relation, what acts (empty for the mover) and what it acts on, as the record words them: of the mover."""
        doer = "" if asking.thing("s") == self.mover else asking.thing("s")
        passive, own = asking.is_passive, target == self.mover
        if relation == "covers" and target:
            if own and (doer or passive):  # "the vase hides it", "is it hidden by the vase?"
                return "covered", "", asking.thing("s") if doer else ""
            return ("covered", target, doer) if passive and doer else (relation, doer, target)
        if relation == "touches" and own and target and (doer or passive):
            return relation, "", doer  # "the vase hits it", "is it hit?"
        return relation, doer, target

    def _unread(self, asking: _Piece | None, lost: list[_Piece]) -> list[tuple[str, str]]:
        """The words that no form covers, or one of the lost pieces does, each run with the part it belongs to."""
        form = "" if asking is None else asking.form.asks[0]
        names_crash = asking is not None and (form == "which-to-remove" or asking.said("r"))
        struck = "" if asking is None else asking.thing("s")
        lost += [each for each in self.pieces if each.said("m") == "OBJ"]
        lost += [each for each in self.pieces if each.what == "listed" and form != "which-first"]
        # What is told to be hit, and is not what the question then goes on about.
        lost += [each for each in self.told if not names_crash and (each.said("o") != struck or not struck)]
        closed = {at for each in self.pieces if each not in lost for at in range(each.start, each.end)}
        closed |= {at for at, token in enumerate(self.plain) if token in {".", "?", "!", ";", ","}}
        found, ends = list[tuple[str, str]](), {each.end: each.what for each in self.pieces}
        for is_closed, run in groupby(range(len(self.plain)), key=lambda at: at in closed):
            at = list(run)
            words = [self.plain[each] for each in at]
            if is_closed or all(word in lex.CONNECTORS or re.fullmatch(r"W\d+", word) for word in words):
                continue
            sentence = max((end for end in range(at[0]) if self.plain[end] in {".", "?"}), default=-1)
            before = [ends[end] for end in range(sentence + 1, at[0] + 1) if end in ends]
            what = "motion" if before[-1:] == ["motion"] else "asked"
            found.append((what, " ".join(self.said[each] for each in at if self.said[each]) or " ".join(words)))
        return found


def motion_of(verb: str, said: Sequence[tuple[str, str]], tokens: Tokens, kind: MotionKind | None) -> MotionWords:
    """The motion by a verb and words for the way, each by what it says and the word that says it."""
    found = {name: [text for each, text in said if each == name] for name, _ in said}
    ways = [lex.WAYS[text.lower()] for text in found.get("way", ())]
    senses, ahead, depths = (set(found.get(name, ())) for name in ("sense", "ahead", "depth"))
    x, y, up = sum(way[0] for way in ways), sum(way[1] for way in ways), [way[1] for way in ways]
    turned = min(up, default=0) < 0 if verb in lex.SETS["fall"] else verb in _RISING and max(up, default=0) > 0
    opposed = any(a[0] * b[0] < 0 or a[1] * b[1] < 0 for a in ways for b in ways)
    stays = "still" in found and bool(ways or depths or senses)
    if kind == "fall":
        y = 0.0  # down is what a fall does; only what leads away from it is a direction
    elif not ways:
        y = -1.0 if verb in _RISING else 1.0 if verb in _SINKING else 0.0
    depth, length = -1.0 if "NEAR" in depths else 1.0 if depths else 0.0, math.hypot(x, y)
    goal, near = (next(iter(found.get(name, ())), "") for name in ("goal", "near"))
    return MotionWords(
        kind=kind,
        along_arrow="ALONG" in senses if senses else None,
        direction=(x / length, y / length) if length else None,
        depth=depth * math.sqrt(0.5) if length else depth,
        forward=False if verb == "reverse" else "FORWARD" in ahead if ahead and not senses else None,
        verb=verb,
        towards=tokens.things[int(goal[1:])] if goal else None,
        trail="trail" in found,
        trail_end=tokens.things[int(near[1:])] if near else lex.SIDES.get(next(iter(found.get("side", ())), "")),
        quantities=tuple(tokens.quantities[int(text[1:])] for text in found.get("quantity", ())),
        is_contradictory=turned or opposed or stays or any(len(each) > 1 for each in (senses, ahead, depths)),
        topples=("over" in found and verb in _TOPPLING) or verb in {"tip", "topple"},
        in_air=verb in {"drop", "release", "detach", "let go"} or "freely" in found,
    )


def joined(first: MotionWords, second: MotionWords) -> MotionWords:
    """A motion that is told in two places."""
    empty = vars(NOT_SAID)
    told = {name: value for name, value in vars(second).items() if value != empty[name]}
    kept = {name: value for name, value in told.items() if getattr(first, name) == empty[name]}
    single = {"kind", "direction", "depth", "along_arrow", "forward"} & (told.keys() - kept.keys())
    clash = any(getattr(first, name) != told[name] for name in single)
    quantities = (*first.quantities, *second.quantities)
    return replace(first, **kept | {"quantities": quantities, "is_contradictory": clash or first.is_contradictory})
