"""Reads a question by its sentence forms: what moves and how, what is changed, what is asked, and what was not read."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

from cow_service.readers.embedded.english import forms
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, PlaceWords, QuantityWords
from cow_service.readers.embedded.english.noun_phrases import Tokens, parse_noun_phrase, tokens_of
from cow_service.readers.options import plain, says_not_sure, split_options
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
    table: ObjectPhrase | None = None  # on which something is asked to come down
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
    return _Parser(tokens_of(text, names), tuple(names), options).question()


# Sentences of a prompt that say how to reply and nothing else, and its heading.
_ABOUT_REPLY = re.compile(
    r"\byour (?:\w+ ){0,2}(?:response|answer|reply|output)s?\b|\bjson\b|answer\s*:\s*\$|\$\s?letter\b", re.IGNORECASE
)
_CONDITION = re.compile(r"\b(?:if|when|once|suppose|assum\w+|imagine)\b", re.IGNORECASE)
_INSTRUCTION = re.compile(
    r"(?:please )?(?:think|reason|answer|choose|select|pick|options?|choices?|explain|respond|reply|provide|return|output"
    r"|note)\b(?! that the ball)", re.IGNORECASE,
)  # fmt: skip
_YES_NO = re.compile(r"[\s,]*[(\[]\s*yes\s*(?:/|\bor\b|,)\s*no\s*[)\]]?\.?\s*$", re.IGNORECASE)
_HEADING = re.compile(r"^[ \t]*question[ \t]*(?:\d+[ \t]*)?:[ \t]*", re.IGNORECASE | re.MULTILINE)


def without_reply_form(prompt: str) -> str:
    """The prompt without the heading of its question, and without sentences that say how to reply and nothing else."""
    sentences = re.split(r"((?<=[.?!])\s+|\n+)", _YES_NO.sub("", _HEADING.sub("", prompt)))
    kept = "".join(each for each in sentences if not _ABOUT_REPLY.search(each) or _CONDITION.search(each))
    parts = re.split(r"((?<=[.?!;:])\s+)", kept)
    return "".join(part for part in parts if not _INSTRUCTION.match(part.strip()))


_PLACES = {
    "behind": "behind", "in front of": "front_of", "next to": "near", "beside": "near", "near": "near",
    "near to": "near", "close to": "near", "nearest to": "near", "closest to": "near", "nearest": "near",
    "farthest from": "far", "furthest from": "far", "to the left of": "left_of", "left of": "left_of",
    "to the right of": "right_of", "right of": "right_of", "above": "above", "over": "above", "under": "below",
    "below": "below", "on": "on", "on top of": "on",
}  # fmt: skip
_STAND = r"(?:,? ?(?:that|which) be )?(?:stand |lie |sit |rest )?"
_PLACE = re.compile(
    rf"(?P<before>(?:[\w,.?]+ )?)(?P<x>X\d+) {_STAND}(?:(?P<where>{'|'.join(sorted(_PLACES, key=len, reverse=True))}) (?P<y>X\d+)"
    r"|(?:that|which) be (?P<near>NEAR|(?:farthest|further|farther) AWAY))(?: ,(?= that))?(?= |$)"
)
_MOVES_OBJECT = lex.CAUSES | lex.words("put place set insert position stand let go be")
_PIECES = {"asked": "asked", "moved": "motion", "changes": "change", "stated": "stated"}
_ORDER = ("asked", "motion", "change", "stated", "listed", "nothing")
_VERBS = "|".join(sorted(lex.KINDS, key=len, reverse=True))
_TELLING = ("sense", "ahead", "depth", "way", "goal", "quantity")


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
        order = [role for role in self.roles if role in {"s", "o"}]
        return self.what == "asked" and order[:1] == ["o"]


class _Parser:
    """Covers a question with forms, the longest that fits at each place, and puts together what they say."""

    def __init__(self, tokens: Tokens, names: tuple[str, ...], options: Sequence[str]) -> None:
        self.tokens, self.names, self.options = tokens, names, options
        self.things = list(tokens.things)
        self.plain, self.said = list(tokens.plain), list(tokens.said)
        self._join_places()
        self._put_behind()
        self.text = " ".join(self.plain)
        self.starts = [0]
        for token in self.plain:
            self.starts.append(self.starts[-1] + len(token) + 1)
        self.place_of = {start: at for at, start in enumerate(self.starts)}
        self.pieces = self._cover()
        self.mover: str | None = None
        self.table: ObjectPhrase | None = None

    def _join_places(self) -> None:
        """Joins "the mug behind the vase" to one thing, but for what is put or pushed there."""
        at = 0
        while at < len(self.plain):
            found = _PLACE.match(" ".join(self.plain[at : at + 9])) if self.plain[at][0] == "X" else None
            before = self.plain[at - 1] if at else ""
            if found is None or before in _MOVES_OBJECT or (before in {"will", "be"} and found["where"] and at < 3):
                at += 1
                continue
            end = at + len(found[0].split())
            phrase = self.things[int(found["x"][1:])]
            near = found["near"]
            place = (
                PlaceWords("near" if near == "NEAR" else "far", None)
                if near
                else PlaceWords(_PLACES[found["where"]], self.things[int(found["y"][1:])])
            )
            said = " ".join(self.said[at:end])
            twice = self.plain.count(self.plain[at]) > 1
            if twice and not phrase.is_given:
                phrase = replace(phrase, text=" ".join([phrase.text, *said.split()[len(phrase.text.split()) + 1 :]]))
            if phrase.is_given:
                self.plain[at:end], self.said[at:end] = [self.plain[at]], [said]
            else:
                self.things.append(replace(phrase, place=place))
                self.plain[at:end], self.said[at:end] = [f"X{len(self.things) - 1}"], [said]
            at += 1

    def _put_behind(self) -> None:
        """Puts "the ball, rolling left," in front of the question that it interrupts."""
        text = " ".join(self.plain)
        found = re.search(rf"(?:^| )((?:will|be|ASK) (X\d+|it)) ,? ?(?:when |if )?((?:{_VERBS})(?: [^,.?]*?)?) , (?=[a-zA-Z])", text)
        found = found or re.search(rf"(?:^| )((?:will|be|ASK) (X\d+|it)) ((?:{_VERBS}) (?:ALONG|AGAINST|LEFT|RIGHT|FORWARD|NEAR))() (?=(?:still |then )*\w)", text)
        if found is None or ("," not in found[0] and not self.said[text[: found.start(3)].count(" ")].endswith(("ing", "n"))):
            return
        a, b, c = (text[: found.start(at)].count(" ") for at in (1, 3, 1))
        length = len(found[3].split())
        rest = b + length + (1 if "," in found[0][found.end(3) - found.start() :] else 0)
        for words in (self.plain, self.said):
            asks, way = words[a : a + 2], words[b : b + length]
            words[a:rest] = [asks[1], *way, ",", *asks]

    # --- covering

    def _cover(self) -> list[_Piece]:
        at, pieces = 0, list[_Piece]()
        while at < len(self.plain):
            piece = max(self._from(at), key=lambda each: (each.end, -_ORDER.index(each.what)), default=None)
            pieces += [] if piece is None else [piece]
            at = at + 1 if piece is None else piece.end
        return pieces

    def _from(self, at: int) -> list[_Piece]:
        """What may begin at a token."""
        found, start = list[_Piece](), self.starts[at]
        for section in ("asked", "stated", "changes", "rest", "moved"):
            for form in forms.forms()[section]:
                if (match := form.pattern.match(self.text, start)) is not None:
                    what = form.says if section == "rest" else _PIECES[section]
                    piece = _Piece(what, at, self._end(match), forms.roles(match), form)
                    found.append(self._adverbials(piece, piece.roles.get("verb", form.says)) if section == "moved" else piece)
        way = self._adverbials(_Piece("motion", at, at), "")
        return [each for each in (*found, way) if each.end > at and (each.what != "motion" or each.motion != MotionWords())]

    def _end(self, match: re.Match[str]) -> int:
        """The place of the first token behind a match."""
        return self.place_of[match.end() + 1] if match.end() + 1 in self.place_of else len(self.plain)

    def _adverbials(self, piece: _Piece, verb: str) -> _Piece:
        """The piece with the words for the way that follow its verb."""
        legs, at, ways = [_Leg(verb)], piece.end, {form.says: form.pattern for form in forms.forms()["ways"]}
        verbs = re.compile(rf"(?P<verb>{_VERBS})(?! X)(?= |$)")
        while at < len(self.plain):
            said = next(((name, match) for name, way in ways.items() if (match := way.match(self.text, self.starts[at]))), None)
            if said is None or not legs[-1].take(said[0], forms.roles(said[1]), self):
                break
            end = self._end(said[1])
            if said[0] == "then":
                again = verbs.match(self.text, self.starts[end])
                if again is None and not any(ways[name].match(self.text, self.starts[end]) for name in _TELLING):
                    break
                legs.append(_Leg(again["verb"] if again else ""))
                end = self._end(again) if again else end
            at = end
        kind = "static" if "n" in piece.roles else lex.KINDS.get(verb, "fall" if verb == "let go" else None)
        piece.end, piece.motion = at, _in_words(legs, kind)
        return piece

    # --- what the pieces say

    def question(self) -> Question:
        """What all pieces together say."""
        asks = [each for each in self.pieces if each.what == "asked"]
        stated = [each for each in self.pieces if each.what == "stated"]
        last = max((at for at, token in enumerate(self.plain[:-1]) if token in {".", "?"}), default=0)
        terse = not asks and bool(stated) and stated[-1].start >= last and ("?" in self.plain[stated[-1].end :] or "CLAIM" in self.plain or self.plain[-1] not in {".", "!"})
        asking = asks[0] if asks else stated[-1] if terse else None
        changes = self._changes(asking)
        put = next((each for each in changes if each.kind == "place"), None)
        moving, subjects = self._moving(asking, stated, changes)
        acts = "" if asking is None else asking.roles.get("s", "")
        self.mover = subjects[0] if subjects else self._token(put.object) if put else acts if acts[:1] == "X" else None
        first = moving[0] if moving else None
        motion = MotionWords() if first is None else first.motion
        mover = None if self.mover is None else self._thing(self.mover)
        others = list[tuple[ObjectPhrase, MotionWords]]()
        for piece, subject in zip(moving[1:], subjects[1:], strict=True):
            if subject != self.mover:
                others.append((self.things[int(subject[1:])], piece.motion))
        read = {at for each in self.pieces for at in range(each.start, each.end)}
        unread = self._unread(read, asking, asks, stated, moving)
        asked, alternatives = self._asked(asking, stated, changes)
        if asking is not None and asked is None:
            words = " ".join(word for word in self.said[asking.start : asking.end] if word)
            unread.append(("asked", words))
        if asked is None and asking is None and moving and not unread:
            asked = Asked(form="what-happens", relation="touches")  # "Push the red ball to the right."
        if put is not None and (first is None or first.motion.kind == "static" or mover is None):
            mover, motion = put.object, MotionWords("place", verb="put")
        elif mover is None and self.things and not moving:
            named = [token for token in self.plain if token[0] == "X" and token[1:].isdigit()]
            mover = self._thing(named[0]) if named else None
        if not moving and asked is not None and asked.relation == "lands" and changes and put is None:
            motion = MotionWords("fall", verb="fall")  # without its support
        words = self.plain
        return Question(
            mover=mover,
            motion=replace(motion, others=tuple(others)),
            says_motion=motion != MotionWords() or bool(moving) or put is not None,
            changes=changes,
            asked=None if unread else asked,
            others=self._others(mover, changes, asked),
            alternatives=alternatives,
            table=self.table,
            names_arrow="ALONG" in words or "AGAINST" in words or any("arrow" in word for word in self.said),
            names_direction=any(word.upper() in forms.WAYS or word in {"FORWARD", "BACKWARD", "NEAR", "AWAY", "opposite"} for word in words),
            unread=tuple(dict.fromkeys(said for _, said in unread)),
            unread_motion=tuple(dict.fromkeys(said for what, said in unread if what == "motion")),
        )

    def _thing(self, token: str) -> ObjectPhrase:
        return self.things[int(token[1:])]

    def _token(self, thing: ObjectPhrase) -> str:
        return f"X{self.things.index(thing)}"

    def _references(self, text: str) -> list[str]:
        """The things of a list, "X1 and X2"; those of both kinds of plurals."""
        return re.findall(r"[XPS]\d+", text)

    def _changes(self, asking: _Piece | None) -> tuple[ChangeWords, ...]:
        """What is taken away or put somewhere."""
        found = list[ChangeWords]()
        for piece in self.pieces:
            roles = piece.roles
            if "r" in roles:
                found += [ChangeWords("remove", self._thing(token)) for token in self._references(roles["r"])]
            relation = forms.relation_of(roles)
            if relation is None or "x" not in roles:
                continue
            y = self._resolved(roles["y"], piece.start, roles["x"])
            if y is None or self._thing(y).head == "container":
                if y is not None:
                    found.append(ChangeWords("place", self._thing(roles["x"]), "into"))
                continue
            targets = [self._thing(y), *([self._thing(roles["z"])] if "z" in roles else [])]
            found.append(ChangeWords("place", self._thing(roles["x"]), relation, tuple(targets)))
        fits = asking is not None and asking.form is not None and asking.form.asks[1] == "inside" and not found
        if fits and asking is not None and not any(each.what == "motion" for each in self.pieces):
            subject, container = asking.roles.get("s", ""), asking.roles.get("o", "")
            if subject.startswith("X") and (container.startswith("X") or "l" in asking.roles):
                targets = (self._thing(container),) if container else ()
                found.append(ChangeWords("place", self._thing(subject), "into", targets))
        return tuple(dict.fromkeys(found))

    def _moving(
        self, asking: _Piece | None, stated: Sequence[_Piece], changes: Sequence[ChangeWords]
    ) -> tuple[list[_Piece], list[str]]:
        """The pieces that tell a motion, and what moves by each; that of the question first."""
        moving, subjects = list[_Piece](), list[str]()
        for piece in self.pieces:
            if piece.what == "stated" and piece.roles.get("s", "").startswith("X") and piece is not asking and not moving:
                moving.append(piece)
                subjects.append(piece.roles["s"])
            if piece.what != "motion":
                continue
            said, told = piece.roles.get("m", ""), {} if asking is None else asking.roles
            if said == "it" and asking is not None and asking.is_passive and told.get("o", "")[:1] + told.get("s", "")[:1] == "XX":
                subjects.append(told["o"] if "behind" in self.plain[asking.start : asking.end] else told["s"])
                moving.append(piece)
                continue
            token = said if said.startswith(("X", "P")) else ""
            before = self._named_before(piece.start)
            if not token and asking is not None and asking.roles.get("s", "").startswith("X") and (said or not before or asking.start < piece.start):
                token = asking.roles["s"]
            if not token and subjects and said != "it":
                token = subjects[-1]
            placed = [each.object for each in changes if each.kind == "place"]
            token = token or next((each for each in before if self._thing(each) not in placed or not said), "") or next(iter(before), "")
            if not token:  # "Will it hit the mug if ...": a thing that is named later
                token = next((each for each in self.plain[piece.end :] if re.fullmatch(r"X\d+", each)), "")
            if moving and subjects[-1] == token and moving[-1].what == "motion" and not said.startswith("X"):
                moving[-1].motion = _joined(moving[-1].motion, piece.motion)
            elif token and moving and subjects[-1] == token and not moving[-1].motion.verb:
                moving[-1] = piece
            elif token:
                moving.append(piece)
                subjects.append(token.replace("P", "X"))
        return moving, subjects

    def _named_before(self, at: int) -> list[str]:
        """The things named in front of a place, the first one first."""
        return list(dict.fromkeys(token for token in self.plain[:at] if re.fullmatch(r"X\d+", token)))

    def _resolved(self, token: str, at: int, subject: str) -> str | None:
        """The thing that a word stands for: "it", "that", "them" and "the other one" are the last thing named in front
        of a place that is not the subject, where that is clear."""
        if re.fullmatch(r"[XS]\d+", token):
            phrase = self._thing(token)
            return self._other(subject, phrase) if phrase.is_other else token
        if token == "itself":
            return subject
        if subject != self.mover and self.mover is not None and token == "it":
            return self.mover
        named = [each for each in self.plain[:at] if re.fullmatch(r"X\d+", each) and each != subject]
        return named[-1] if named and token in {"it", "that", "this"} else None

    def _other(self, subject: str, phrase: ObjectPhrase) -> str | None:
        """The one thing, of those that are given or else named, that is not the subject."""
        known = [each for each in self.things if not each.is_other and each != self._thing(subject) and " " .join(each.words)]
        things = [f"X{at}" for at, each in enumerate(self.things) if each in known and f"X{at}" in self.plain]
        if self.names:
            left = [name for name in self.names if plain(name) != plain(self._thing(subject).text)]
            if len(left) != 1:
                return None
            self.things.append(replace(parse_noun_phrase(left[0]) or phrase, text=left[0], is_given=True))
            return f"X{len(self.things) - 1}"
        if len(things) == 1:
            return things[0]
        return None if things else f"X{self.things.index(phrase)}"

    def _asked(
        self, asking: _Piece | None, stated: Sequence[_Piece], changes: Sequence[ChangeWords]
    ) -> tuple[Asked | None, tuple[ObjectPhrase, ...]]:
        """What is asked, and among which things; None where that is not clear."""
        if asking is None or asking.form is None:
            return None, ()
        roles, (form, relation, is_negated) = asking.roles, asking.form.asks
        negated = is_negated != ("n" in roles)
        if is_negated and "n" in roles:
            return None, ()  # "will it not miss"
        said_subject, said_target = roles.get("s", ""), roles.get("o", "")
        subject = said_subject if said_subject.startswith("X") else self.mover or ""
        acted = next((each for each in stated if each is not asking), None)
        if acted is not None and said_subject in {"it", "that"}:
            return None, ()
        target, passive = None, asking.is_passive
        if "both" in roles or said_target == "they":
            moved = list(dict.fromkeys(each.roles.get("m", "") for each in self.pieces if each.what == "motion"))
            pair = [each for each in moved if each.startswith("X") and each != subject]
            pair = pair or [each for each in self._named_before(len(self.plain)) if each != subject]
            if len(pair) != 1:
                return None, ()
            target = pair[0]
        elif passive and said_target == "it":
            target = self.mover
        elif said_target == "EVERYTHING" and not negated:
            return None, ()
        elif said_target not in {"", "ANY", "EVERYTHING"}:
            target = self._resolved(said_target, asking.start, subject)
            if target is None:
                return None, ()
        doer = self._thing(subject) if subject and subject != self.mover else None
        if relation == "covers" and target is not None and said_subject not in {"", "it"} and target == self.mover:
            relation, target, doer = "covered", subject, None  # "the vase hides it"
            subject = self.mover or ""
        elif relation == "covers" and doer is not None and "be" in self.plain[asking.start : asking.start + 9] and "by" in self.plain[asking.start : asking.end]:
            relation, target, doer = "covered", subject, self._thing(target) if target and target != self.mover else None
        elif relation == "covers" and passive and target == self.mover:
            relation, target = "covered", None
        if relation in {"touches"} and passive and target == self.mover and form in {"whether", "when"}:
            target = None
        if relation == "touches" and target is not None and target == self.mover and doer is not None:
            target, doer = subject, None
        thing = None if target is None else self._thing(target)
        if relation == "lands" and thing is not None:
            thing, is_table = None, thing.head in lex.TABLES
            if not is_table:
                return None, ()
        if relation == "inside" and thing is None:
            puts = [each for each in changes if each.kind == "place" and each.targets]
            thing = puts[0].targets[0] if puts else None
            if form == "whether" and thing is None:
                return None, ()
        words = self.plain[asking.start : asking.end]
        if relation == "inside" and thing is not None and "fit" not in words:
            along = {"roll", "slide", "move", "drive", "push"} & set(words)
            relation = "inside" if thing.head in (lex.HOLLOW if along else lex.CONTAINERS) else "touches"
        if relation == "touches" and thing is not None and thing.head in lex.TABLES and not thing.colour and {"on", "onto"} & set(words):
            self.table, relation, thing = thing, "lands", None
        lists = [each for each in self.pieces if each.what == "listed"]
        listed = [self._thing(each) for each in self._references(roles.get("l", "") or (lists[-1].roles["l"] if lists else ""))]
        among = [self._thing(each).text for each in self._references(roles.get("a", ""))]
        crash = [each.roles["o"] for each in stated if each is not asking and each.roles.get("o", "")[:1] == "X"]
        if (form == "which-to-remove" or "r" in roles) and thing is None and crash:
            thing = self._thing(crash[-1])  # "it will collide with the lamp. Which object ..."
        if form in {"which", "which-to-remove"}:
            among = [each.text for each in listed]
            if form == "which-to-remove" and not among:
                phrases = [parse_noun_phrase(text) for text in self.options]
                among = [each.text for each in phrases if each is not None] if all(phrases) else []
        kind = [self._thing(each) for each in self._references(roles.get("k", "").replace("K", "X"))]
        if form == "how-many" and kind:
            among = [each.text for each in kind]
        is_partly = relation in {"covers", "covered"} and bool({"PARTLY", "SOMETIME"} & set(self.plain))
        limits = [each.within for each in self.tokens.quantities if each.within is not None]
        if relation in {"tips", "moves"} and thing is None and passive is False and said_target == "":
            thing = None if self.mover is None else self._thing(self.mover)
        target_text = None if thing is None or form in {"which", "how-many"} else thing.text
        if form in {"which", "which-first", "which-to-remove", "how-many"} and form != "which-to-remove":
            target_text = None
        asked = Asked(
            form=form, relation=relation, subject=None if doer is None else doer.text, target=target_text,
            negated=negated, among=tuple(among), every=roles.get("q") == "ALLOF" and not negated,
            partly=is_partly, within=min(limits, default=None),
        )  # fmt: skip
        if roles.get("q") == "NOOF":
            asked = asked.model_copy(update={"negated": not negated})
        return asked, tuple(listed or kind) if form == "which-first" else ()

    def _others(
        self, mover: ObjectPhrase | None, changes: Sequence[ChangeWords], asked: Asked | None
    ) -> tuple[ObjectPhrase, ...]:
        """The further things that are named, each once."""
        removed = [each.object for each in changes if each.kind == "remove"]
        named = [self._thing(token) for token in self._named_before(len(self.plain))]
        places = [each.place.of for each in named if each.place is not None and each.place.of is not None]
        phrases = [each for each in (*named, *places) if each not in (mover, *removed) and each.head != "container"]
        if asked is not None and asked.form == "which-to-remove":
            phrases += [each for each in map(parse_noun_phrase, asked.among) if each is not None]
        texts = dict[str, ObjectPhrase]()
        for each in phrases:
            texts.setdefault(plain(each.text), each)
        return tuple(texts.values())

    def _unread(
        self, read: set[int], asking: _Piece | None, asks: Sequence[_Piece], stated: Sequence[_Piece], moving: Sequence[_Piece]
    ) -> list[tuple[str, str]]:
        """The words that no form covers, each run with the part of the question to which it belongs."""
        subject = "" if asking is None else asking.roles.get("s", "")
        lists = [] if asking is not None and asking.form is not None and asking.form.asks[0] == "which-first" else [each for each in self.pieces if each.what == "listed"]
        if asking is not None and asking.form is not None and (asking.form.asks[0] == "which-to-remove" or "r" in asking.roles):
            stated = [each for each in stated if each.roles.get("s", "it") not in {"it", self.mover} or each.form is None]
        for each in (*lists, *asks[1:], *(one for one in stated if one is not asking and one not in moving)):
            if each.roles.get("o", "") != subject or not subject.startswith("X") or each.what != "stated":
                read = read - set(range(each.start, each.end))
        runs, run = list[list[int]](), list[int]()
        for at, token in enumerate(self.plain):
            ends = token in {".", "?", "!", ";", ","}
            if at in read or ends:
                runs, run = ([*runs, run] if run else runs), []
            else:
                run.append(at)
        runs += [run] if run else []
        found = list[tuple[str, str]]()
        for run in runs:
            words = [self.plain[at] for at in run]
            limits = [self.tokens.quantities[int(word[1:])].within for word in words if re.fullmatch(r"Q\d+", word)]
            if all(word in forms.CONNECTORS or re.fullmatch(r"Q\d+", word) for word in words) and None not in limits:
                continue
            before = [each for each in self.pieces if each.end <= run[0] and not {".", "?"} & set(self.plain[each.end : run[0]])]
            what = "motion" if before and before[-1].what == "motion" else "asked"
            found.append((what, " ".join(self.said[at] for at in run if self.said[at]) or " ".join(words).lower()))
        return found


def _joined(first: MotionWords, second: MotionWords) -> MotionWords:
    """A motion that is told in two places."""
    told = {name: value for name, value in vars(second).items() if value not in (None, 0.0, "", (), False)}
    clash = second.kind not in (None, first.kind) or any(getattr(first, name) not in (None, 0.0, value) for name, value in told.items() if name in {"direction", "depth", "along_arrow", "forward"})
    kept = {name: value for name, value in told.items() if getattr(first, name) in (None, 0.0, "", (), False)}
    kept["quantities"] = (*first.quantities, *second.quantities)
    return replace(first, **kept, is_contradictory=clash or first.is_contradictory)


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

    @property
    def says_way(self) -> bool:
        """Whether it says more than that something moves."""
        return bool(self.ways or self.depths or self.senses or self.ahead or self.quantities or self.towards or self.trail) or self.verb in lex.MOTIONS["fall"]

    def take(self, name: str, roles: dict[str, str], parser: _Parser) -> bool:
        """Takes words for the way; false where they say nothing here."""
        text = next(iter(roles.values()), "")
        match name:
            case "trail":
                near = parser.things[int(roles["near"][1:])] if "near" in roles else None
                self.trail = TrailWords(near, forms.SIDES.get(roles.get("side", "")))
            case "way":
                self.ways.append(forms.WAYS[text.upper()])
            case "depth":
                self.depths.add(-1.0 if text == "NEAR" else 1.0)
            case "sense":
                self.senses.add(text == "ALONG")
            case "ahead":
                self.ahead.add(text == "FORWARD")
            case "goal":
                if self.towards is not None:
                    return False
                self.towards = parser.things[int(text[1:])]
            case "quantity":
                said = parser.tokens.quantities[int(text[1:])]
                if said.within is not None:
                    return False
                self.quantities.append(said)
            case "halt" if not self.quantities:
                return False
            case _:
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
        up = [way[1] for way in self.ways]
        turned = (self.verb in lex.MOTIONS["fall"] and min(up, default=0) < 0) or (self.verb in _RISING and max(up, default=0) > 0)
        opposed = any(a[0] * b[0] < 0 or a[1] * b[1] < 0 for a in self.ways for b in self.ways)
        return turned or opposed or any(len(each) > 1 for each in (self.depths, self.senses, self.ahead)) or (self.says_way and "still" in self.marks)


_RISING, _SINKING = lex.words("lift raise rise climb ascend"), lex.words("descend lower")


def _in_words(legs: Sequence[_Leg], kind: MotionKind | None) -> MotionWords:
    first, *rest = legs
    over = "over" in first.marks and first.verb in lex.words("knock push tip fall turn blow topple")
    ways = [leg.way(None) for leg in rest]
    return MotionWords(
        kind,
        next(iter(first.senses), None),
        *first.way(kind),
        False if first.verb == "reverse" else None if first.senses else next(iter(first.ahead), None),
        first.verb,
        first.towards,
        first.trail,
        tuple(first.quantities),
        tuple(StepWords(*way, tuple(leg.quantities)) for way, leg in zip(ways, rest, strict=True)),
        is_contradictory=any(leg.contradicts for leg in legs),
        topples=(over or first.verb in {"tip", "topple"}),
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
            found += [each.format(m=names[0], o=names[1] if len(names) > 1 else "", way=way) for each in patterns if len(names) > 1 or "{o}" not in each]
    read = [each for each in found if parse(each).asked is not None]
    return tuple(dict.fromkeys(read))[:3]
