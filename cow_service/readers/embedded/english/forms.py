"""The sentence forms that are read, over the tokens of `noun_phrases`; docs/questions.md shows each with an example.

A form is a regular expression. Its groups name what the things in it do: `s` acts, `o` is acted on, `r` is removed,
`x` is put at `y` and `z`, `m` moves, `l` and `k` are the things or the kind that are asked about, `q` and `a` say of
how many things.
"""

import re
from itertools import count
from typing import NamedTuple

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.records import AskedForm, AskedRelation, PlaceRelation, Vector

_AGENT = r"(?:AG|i|we|you|someone|somebody|one|they|he|she)"
_THING = r"X\d+|OBJ"
_LIST = r"X\d+(?: ,(?: or| and)? X\d+| (?:or|and) X\d+)+"
_S = rf"(?:PARTLY )?(?P<s>{_THING}|it|they|that|this)"
_O = rf"(?:PARTLY )?(?:(?P<o>{_THING}|it|them|that|this|itself|ANY|EVERYTHING)|(?P<q>ALLOF|SOMEOF|NOOF) (?P<a>S\d+))"
_ADVERBS = r"(?: (?:then|still|first|now|already|SOMETIME|PARTLY))*"
_NOT = r"(?P<n> (?:not|never))?"
_LEADS = r"(?: (?:manage to|start to|start|begin to|go on to|come to|get to|have|be able to))?"
_WILL = rf"(?:(?:will|be|have) {_S}|ASK {_S}(?: (?:will|be))?){_ADVERBS}{_NOT}{_ADVERBS}{_LEADS}"
_ON = r"(?:on|onto|upon|on top of|right on|on to|directly on)"
_HIT = (
    rf"(?:(?:land|come down|fall|drop|settle|come to rest)(?: down)?(?: right)? {_ON}"
    r"|(?:run|bump|crash|smash|knock|bang|slam|roll|slide|drive|fly|go|move|push)(?: right| FORWARD)? (?:into|against|up against)"
    r"|(?:bump|collide|crash|smash|meet) with|get as far as|get to|roll to"
    r"|hit|touch|strike|graze|ram|reach|meet|contact|whack|smack|bump)"
)
_COVER = r"(?:hide|occlude|obscure|conceal|obstruct|cover|overlap|eclipse)"
_IN = r"(?:in|into|inside|inside of|within)"
_FIT = rf"(?:fit|go|land|fall|drop|get|fly|end up|end|be|stay|roll|slide|move)(?: (?:right|completely|fully|entirely|first))? {_IN}"
_TAIL = r"(?: (?:first|then|now|again|inside|SOMETIME|PARTLY|on FLOOR|in IMAGE|completely|fully|entirely|upright|with that))*"
_REMOVE = r"(?:remove|delete|erase|eliminate|take (?:AWAY|away|out|off)|clear (?:AWAY|away)|move out of the way)"
_FROM = r"(?: (?:from|out of|off) (?:IMAGE|FLOOR|there))?(?: (?:first|beforehand|AWAY|away|out|instead))?"
_CRASH = rf"CRASH(?: (?:of {_S} (?:with|and) {_O}|with {_O}|between {_S} and {_O}|between (?P<both>they|them)))?"
_BE_DONE = rf"(?:be {_O}{_ADVERBS}{_NOT}{_ADVERBS}(?: (?:be|get|become))*|(?:will|ASK) {_O}(?: will)?{_ADVERBS}{_NOT}{_ADVERBS} (?:be|get|become|have be))(?: (?:completely|fully|entirely|already))?{_ADVERBS}"
_WHICH = rf"(?:WHICH|what|which(?= (?:will|be|get))|which (?P<k>K\d+)(?: of (?:P\d+|them))?|which of (?:(?P<l>{_LIST})|(?P<k>[PS]\d+)|SOMEOF (?P<k>S\d+)))"
_LISTED = rf"(?: ?(?:,|\?) (?P<l>{_LIST}))?"
_OVER = r"(?:over|down)"
_HEADS = r"(?:land|end up|end|stop|go|finish up|finish|come down|come to rest|come to a stop|fall|roll)"


def _compiled(pattern: str) -> re.Pattern[str]:
    """The pattern, which may name a group several times: the later ones get a number behind the name."""
    numbers = count()
    return re.compile(re.sub(r"\(\?P<([a-z]+)>", lambda found: f"(?P<{found[1]}{next(numbers)}>", pattern) + r"(?= |$)")


def roles(found: re.Match[str]) -> dict[str, str]:
    """The groups of a match by their names."""
    return {name.rstrip("0123456789"): text for name, text in found.groupdict().items() if text is not None}


class Form(NamedTuple):
    """What a sentence of this form asks."""

    pattern: re.Pattern[str]
    form: AskedForm
    relation: AskedRelation
    negated: bool = False


def _f(pattern: str, form: AskedForm, relation: AskedRelation, negated: bool = False) -> Form:
    return Form(_compiled(rf"(?:{pattern}){_TAIL}"), form, relation, negated)


_AVOID = r"(?:avoid|prevent|stop)"
_PURPOSE = (
    rf"(?:(?:in order |so as )?to {_AVOID} (?:{_CRASH}|it|this)(?: from happen)?"
    rf"|(?:in order |so as )?to (?:keep|prevent|stop) (?P<s>X\d+|it) from {_HIT} (?P<o>X\d+)"
    rf"|(?:so|such|in order) that (?:(?P<s>X\d+|it) (?:will )?(?:not|no longer) {_HIT} (?P<o>X\d+|ANY)|(?:there (?:will )?be )?no CRASH(?: (?:will )?(?:happen|occur))?|CRASH (?:will )?(?:be {_AVOID}|not (?:happen|occur)|(?:do|will) not happen))"
    rf"|for {_S} (?:to miss (?P<o>X\d+)|not to {_HIT} (?P<o>X\d+)))"
)
ASKED: tuple[Form, ...] = (
    # Which to remove, and whether removing one helps.
    _f(rf"{_WHICH} (?:will|must|need to|have to|do)(?: {_AGENT})?(?: need to| have to| be)* {_REMOVE}{_FROM} {_PURPOSE}", "which-to-remove", "touches"),
    _f(rf"{_PURPOSE} ,? ?{_WHICH} (?:will|must|need to|have to|do)(?: {_AGENT})?(?: need to| have to| be)* {_REMOVE}{_FROM}", "which-to-remove", "touches"),
    _f(rf"(?:will|be|ASK) {_CRASH}(?: (?:will|be))*(?: still)?(?P<n> not)? {_AVOID}(?: (?:by|with|if|when) (?:{_AGENT} )?{_REMOVE} (?P<r>X\d+){_FROM})?", "whether", "touches", True),
    _f(rf"(?:(?:will|ASK) {_AGENT}|be it possible to|ASK it be possible to|will it be possible to) {_AVOID} {_CRASH} (?:by|if {_AGENT}) {_REMOVE} (?P<r>X\d+){_FROM}", "whether", "touches", True),
    _f(rf"(?:will|ASK) (?:{_REMOVE}|the removal of) (?P<r>X\d+){_FROM}(?: will)? (?:help )?(?:to )?{_AVOID} (?:{_CRASH}|it|this)", "whether", "touches", True),
    _f(rf"(?:will|ASK) (?:{_REMOVE}|the removal of) (?P<r>X\d+){_FROM}(?: will)? (?:keep|prevent|stop) {_S} from {_HIT} {_O}", "whether", "touches", True),
    # Which, which first, how many, when, where.
    _f(rf"(?:which of (?P<l>{_LIST}) will {_S} {_FIT}|{_IN} which of (?P<l>{_LIST}) will (?P<s>X\d+|it) (?:fit|go))", "which", "inside"),
    _f(rf"which of (?P<l>X\d+ and X\d+) will {_S} {_COVER}", "which", "covers"),
    _f(rf"which of (?P<l>X\d+ and X\d+) will (?:be|get) {_COVER}(?: by {_S})?", "which", "covers"),
    _f(rf"which of (?P<l>X\d+ and X\d+) will {_S} {_HIT}(?! first)", "which", "touches"),
    _f(rf"where (?:will|be) {_S}(?: first)? {_HEADS}(?: first)?|(?:what|where) will (?P<s>X\d+|it) (?:land|come down|come to rest) on(?! FLOOR)", "where", "touches"),
    _f(rf"(?:{_LIST} , )?{_WHICH} (?:will|be) {_S}(?: first)? {_HIT}(?: first)?{_LISTED}", "which-first", "touches"),
    _f(rf"(?P<l>{_LIST}) ,? ?WHICH (?:will|be) {_S}(?: first)? {_HIT}(?: first)?", "which-first", "touches"),
    _f(rf"{_WHICH}(?: (?:will|be|get|first))+ {_HIT}(?: first)?(?: by {_S})?(?: first)?{_LISTED}", "which-first", "touches"),
    _f(rf"(?:will|be) (?P<l>X\d+(?: , X\d+)*(?: ,)? or X\d+)(?: be)? {_HIT} first(?: by {_S})?", "which-first", "touches"),
    _f(rf"{_WHICH} (?:will|be) {_S}(?: first)? {_COVER}(?: first)?{_LISTED}", "which-first", "covers"),
    _f(rf"{_WHICH}(?: (?:will|be|get|PARTLY|first))+ {_COVER}(?: first)?(?: by {_S})?(?: first)?{_LISTED}", "which-first", "covers"),
    _f(rf"what (?:will )?be FIRST(?: that)? {_S}(?: will)? {_HIT}|what FIRST (?:that )?(?P<s>X\d+|it)(?: will)? {_HIT}|{_WHICH} (?:will )?be (?:FIRST|the first)(?: to)? (?:be |get )?{_HIT}(?: by (?P<s>X\d+|it))?", "which-first", "touches"),
    _f(rf"{_WHICH} (?:will )?be (?:FIRST|the first)(?: to)? (?:be |get )(?:PARTLY )?{_COVER}(?: by {_S})?", "which-first", "covers"),
    _f(rf"(?:will|ASK) {_S}(?: will)?(?: first)? {_HIT} (?P<l>X\d+(?: , X\d+)*(?: ,)? or X\d+)(?: first)?", "which-first", "touches"),
    _f(rf"(?:HOWMANY|how many (?P<k>[KPS]\d+)|how many of (?P<k>[PS]\d+)) (?:(?:will )?{_S}(?: will)? {_HIT}|(?:will )?(?:be|get) {_HIT}(?: by (?P<s>X\d+|it))?)", "how-many", "touches"),
    *(
        _f(rf"(?:when|at what time|after how (?:long|many seconds)|how (?:soon|long|many seconds)(?: (?:will|be) it (?:take|need)| go by| pass)?(?: until| before| for)?)(?: (?:will|be))? {who}", "when", relation)
        for relation, who in (
            ("lands", rf"{_S}(?: (?:will|be|to))*(?: first)? (?:(?:hit|reach|touch)|(?:land|be|come down|end up) on|(?:fall|drop) (?:on|to|onto)) FLOOR"),
            ("touches", rf"{_S}(?: (?:will|be|to|need to))*(?: first)? {_HIT} {_O}|to {_HIT} {_O}"),
            ("touches", rf"{_O}(?: (?:will|be|get))+ {_HIT}(?: by {_S})?"),
            ("touches", r"(?P<both>they|them) (?:will )?(?:meet|collide|hit|touch|crash)(?: EACH)?"),
            ("covers", rf"{_S}(?: (?:will|be|to|start to|begin to))*(?: first)? {_COVER} {_O}"),
            ("covers", rf"{_O}(?: (?:will|be|get))+ {_COVER}(?: by {_S})?"),
        )
    ),
    _f(rf"what (?:will )?happen(?: to {_O})?(?: then)?|what be the (?:outcome|result)", "what-happens", "touches"),
    _f(rf"(?:how )?will (?:the |its )?(?:outcome|result|answer|path|motion|trajectory) (?:change|differ|be different)|(?:what|will (?:it|that|this)) ?(?:will it)? ?make (?:any |a )?difference(?: to what {_S}(?: will)? hit)?|what difference will it make", "changes", "touches"),
    # Whether it hits, misses, hides, fits, tips, moves, leaves, lands.
    _f(rf"{_WILL} (?:land|fall|drop|roll|slide|come down|end up|finish up|end|hit|reach|touch)(?: down)?(?: right)?(?: {_ON}| to| all the way to)? FLOOR", "whether", "lands"),
    _f(rf"{_WILL} (?:(?:fall|drop|roll|slide|go|come|be push) (?:off|over)(?: the edge of)?|leave) {_O}", "whether", "lands"),
    _f(rf"{_WILL} (?:stay|remain|keep|be) (?:on|on top of) {_O}", "whether", "lands", True),
    _f(rf"{_WILL} {_FIT} {_O}", "whether", "inside"),
    _f(rf"{_WILL} fit(?: {_IN}| there| through)?", "whether", "inside"),
    _f(rf"{_WILL} {_HIT} {_O}", "whether", "touches"),
    _f(rf"{_WILL} {_HIT} NONE", "whether", "touches", True),
    _f(rf"{_WILL} (?:avoid {_HIT}|(?:miss|avoid|clear|(?:stay|keep|remain|steer)(?: well)? clear of|pass by|stay away from)) {_O}(?: without {_HIT} it)?", "whether", "touches", True),
    _f(rf"{_WILL} (?:pass|get past|go past|roll past) {_O} without {_HIT} it|{_WILL} (?:pass|get|go|roll)[^?.]* without {_HIT} (?P<o>X\d+|ANY)", "whether", "touches", True),
    _f(rf"{_BE_DONE} {_HIT}(?: by {_S})?", "whether", "touches"),
    _f(rf"(?:be|will) {_S}{_ADVERBS}(?: (?:be|get|end up|being))* (?:push|knock|shove|shunt|drive) (?:into|against) {_O}(?: by (?:this|that))?", "whether", "touches"),
    _f(rf"(?:be {_O}|will (?P<o>X\d+) be) safe(?: from be {_HIT}(?: by {_S})?)?|will (?P<o>X\d+) (?:stay|remain) untouched", "whether", "touches", True),
    _f(rf"(?:will|ASK|be) (?:(?P<both>they)|(?P<s>X\d+|it) and (?P<o>X\d+))(?: will)?{_ADVERBS}{_NOT}{_ADVERBS} (?:(?:bump|run|crash|smash|knock) into|collide|meet|touch|hit|crash)(?: with)?(?: EACH)?", "whether", "touches"),
    _f(rf"(?:will (?:there be )?|be there |ASK (?:there (?:will )?be )?){_CRASH}(?: (?:will )?(?:happen|occur|take place))?", "whether", "touches"),
    _f(rf"{_WILL} {_COVER}(?: PARTLY)? {_O}", "whether", "covers"),
    _f(rf"{_BE_DONE} {_COVER}(?: (?:by|behind) {_S})?", "whether", "covers"),
    _f(rf"{_WILL} (?:pass|go|move|slide|roll|drive|travel|disappear|vanish|be|get|come|end up|take it)(?: , | )?(?:PARTLY )?(?:, )?behind {_O}", "whether", "covered"),
    _f(rf"(?:will|be) {_O}{_NOT}(?: (?:stay|remain|be|still|completely|fully|entirely))+ (?:visible|unobstructed|unoccluded|uncovered|in view)|(?:will|be) (?:i|we|you) still see (?P<o>X\d+|it)", "whether", "covers", True),
    _f(rf"{_WILL} (?:(?:knock|tip|push) {_O} {_OVER}|(?:topple|overturn|tip|knock over|tip over|knock down) (?P<o>X\d+|it|that|ANY))", "whether", "tips"),
    _f(rf"(?:be|will|ASK) {_O}{_ADVERBS}{_NOT}(?: (?:be|get))*(?: (?:tip|topple|knock|push|fall) {_OVER}| tip| topple| overturn)(?: by {_S})?", "whether", "tips"),
    _f(rf"(?:be|will) {_O}(?: (?:stay|remain|be|still))+ (?:upright|stand|up)", "whether", "tips", True),
    _f(rf"{_WILL} (?:push|shift|displace|nudge|drag|move) {_O}(?: AWAY| away)?", "whether", "moves"),
    _f(rf"{_BE_DONE} (?:push|shift|displace|nudge|drag|move)(?: AWAY| away)?(?: by {_S})?", "whether", "moves"),
    _f(rf"will {_O}{_ADVERBS}{_NOT} (?:move|budge)", "whether", "moves"),
    _f(rf"will {_O} (?:stay|remain)(?: (?:where it be|still|there|in place|put))?", "whether", "moves", True),
    _f(rf"{_WILL} (?:leave IMAGE|(?:go|roll|slide|move|fly|travel|drive|pass|get) out of IMAGE(?: by then)?)", "whether", "leaves"),
    _f(rf"(?:be|will) {_S}(?: (?:still|stay|remain|be))+ (?:in|inside|within) IMAGE", "whether", "leaves", True),
)  # fmt: skip
# "... and strikes the yellow ball": told, or asked where nothing else asks.
STATED = tuple(
    _f(pattern, "whether", relation, negated)
    for pattern, relation, negated in (
        (rf"(?:{_S} )?(?:will |have )?{_HIT} {_O}", "touches", False),
        (rf"(?:{_S} )?(?:will |have )?{_HIT} NONE", "touches", True),
        (rf"(?:{_S} )?(?:will )?(?:miss|avoid|clear) {_O}", "touches", True),
        (rf"(?:{_S} )?(?:will )?{_COVER} {_O}", "covers", False),
        (rf"(?:{_S} )?(?:will )?fit(?: {_IN} {_O})?", "inside", False),
    )
)

LISTED = _compiled(rf"(?P<l>X\d+(?: ,(?: or)? X\d+)*(?: ,)? or X\d+)")  # "..., the red one or the blue one?"

# What is taken away or put somewhere before anything moves.
_TAKEN = r"(?P<r>(?:ALLOF S\d+|X\d+|P\d+)(?:(?: ,| and| , and) X\d+)*)"
REMOVED = tuple(_compiled(pattern) for pattern in (
    rf"(?:{_AGENT} (?:will |have )*)?(?:by )?(?:{_REMOVE}|clear) {_TAKEN}{_FROM}",
    rf"(?:{_AGENT} (?:will |have )*)?take {_TAKEN} (?:AWAY|away|out|off)(?: of)?{_FROM}(?: (?:IMAGE|FLOOR))?",
    rf"{_TAKEN} (?:will |have |be |get )*(?:first |already |completely )*(?:{_REMOVE}|take (?:out|away|AWAY)){_FROM}",
    rf"{_TAKEN} (?:have )?VANISHED{_FROM}|be {_TAKEN} to (?:vanish|disappear)|(?<=if ){_TAKEN} (?:vanish|disappear)",
    rf"there be no {_TAKEN}|without {_TAKEN}|with {_TAKEN} (?:{_REMOVE}|go|VANISHED|out of the way)",
))  # fmt: skip
_RELATIONS: dict[PlaceRelation, str] = {
    "into": rf"(?:right |back )?{_IN}", "onto": rf"(?:{_ON}|on the (?:tip|top) of)", "in-front-of": r"(?:right )?in front of",
    "behind": "behind", "next-to": r"(?:right )?(?:next to|beside|near)", "left-of": r"(?:to|on)? ?(?:the )?left of",
    "right-of": r"(?:to|on)? ?(?:the )?right of",
}  # fmt: skip
_PUT = r"(?:put|place|set|insert|position|stand|lower|drop)(?: down)?"
PLACED = tuple(
    (relation, _compiled(pattern))
    for relation, where in (
        *((relation, rf"{words} (?P<y>X\d+|it)") for relation, words in _RELATIONS.items()),
        ("between", r"(?:right |halfway |midway |in )*between (?P<y>[XP]\d+|ALLOF S\d+)(?: and (?P<z>X\d+))?"),
    )
    for pattern in (
        rf"(?:(?:{_AGENT} )?(?:want to |will |have )*)?{_PUT} (?P<x>X\d+)(?: down)? {where}",
        rf"(?P<x>X\d+) (?:will |be |get |have )+{_PUT} {where}",
    )
)
FITTING = _compiled(r"(?P<x>X\d+) (?:into|in|inside) (?P<y>X\d+)(?= , fit| \?)")  # "ball into bowl - fits?"

# How something moves: a verb with its subject or object, then words for the way.
VERBS = "|".join(sorted(lex.KINDS, key=len, reverse=True))
_GOES = r"(?:will |be |get |have |to |then |now |first |start to |start |begin to |begin |keep on |keep |continue to |continue |go |only |come |let )*"
MOVED = tuple(_compiled(pattern) for pattern in (
    rf"(?:{_AGENT} )?{_GOES}let go(?: of)? (?P<m>X\d+|it)|(?P<m>X\d+|it) (?:be )?let (?P<verb>go)(?: of)?",
    rf"(?:{_AGENT} )?(?:will )?give (?P<m>X\d+|it) (?:an? )?(?:\w+ )?(?P<verb>push|shove|kick|nudge|flick)",
    rf"(?:{_AGENT} )?(?:will |then |to )*(?:let |make )(?P<m>X\d+|it) {_GOES}(?P<verb>{VERBS})",
    rf"(?:{_AGENT} )?(?:will |then |to |by |want to )*(?P<verb>{'|'.join(sorted(lex.CAUSES | {'start'}))}) (?P<m>X\d+|it)(?: (?:roll|slide|go|move|off|over|up))?",
    rf"(?:(?P<m>X\d+|it|P\d+|ALLOF S\d+)(?: ,)? (?:(?:which|that|who) )?)?(?P<n>(?:will |be |do )*not )?{_GOES}(?P<verb>{VERBS})",
))  # fmt: skip
LEFT, RIGHT, UP, DOWN = (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)
WAYS: dict[str, Vector] = {"LEFT": LEFT, "RIGHT": RIGHT, "UP": UP, "DOWN": DOWN, "left": LEFT, "right": RIGHT, "up": UP, "down": DOWN}
SIDES = {"leftmost": LEFT, "rightmost": RIGHT, "lowest": DOWN, "highest": UP, "left": LEFT, "right": RIGHT}
TRAIL = _compiled(
    r"(?:on |off )?TRAIL(?: ,? ?the (?:last|latest) of which be (?:(?:the )?(?:one )?(?:nearest|closest) to (?P<near>X\d+)"
    r"|(?:on )?(?:the )?(?P<side>\w+)))?(?: ,)?"
)
ADVERBIAL = _compiled(
    r"(?:(?P<sense>ALONG|AGAINST)|(?P<ahead>FORWARD|BACKWARD|back)|(?P<depth>NEAR|AWAY)|(?P<way>LEFT|RIGHT|UP|DOWN|left|right|up|down)"
    r"|(?:straight |directly )?(?:toward|towards|at|to|into|for)(?: FORWARD)? (?P<goal>X\d+)|(?P<quantity>Q\d+)|(?P<freely>FREELY)|(?P<over>over)(?! X)"
    r"|(?P<still>still|stationary|motionless|where it be|in place|at rest)|(?P<then>(?:and |, )*(?:and|,|after that) ?then(?: it)?(?: be| get)?|(?:and |, )*then(?: it)?(?: be| get)?|, after that it(?: be| get)?)"
    rf"|(?P<leg>and (?:it )?(?:be |get )?)(?={VERBS})|(?P<halt>(?:, )?(?:but |and )?(?:then )?(?:it )?(?:stop|halt)(?: there)?)|(?P<nothing>"
    r"(?:on|along|across|over|through|in|to|onto|above|from) (?:FLOOR|IMAGE)|(?:off|from|over|on|along|across)(?: the edge of)? (?:X\d+|FLOOR)"
    r"|by (?:AG|someone|somebody)|in a straight line|(?:while )?(?:stay |stand |and )*upright|straight|directly|off|on|together|again|now|horizontally|all the way|across|too|instead|(?:with|at) (?:some|a) (?:speed|push)|and(?= LEFT| RIGHT| UP| DOWN)))"
)
CONNECTORS = lex.words(
    ", . ? ! ; ( ) if when while once suppose supposing imagine assume assuming given and then so that as after consider say CLAIM upon "
    "it first SOMETIME THERE"
)
