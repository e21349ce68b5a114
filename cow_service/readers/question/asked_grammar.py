"""The grammar of what can be asked of the world: patterns over the tokens of `asked_words`, each of a whole clause.

A clause that no pattern covers from its first word to its last is not read: so no word of it is passed over. The groups
of a pattern are the things that it names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

from cow_service.records.asked import AskedForm, AskedRelation


@dataclass(frozen=True)
class Pattern:
    """A clause in one form, about one relation; `regex`, of `text`, is matched against all of it."""

    form: AskedForm
    relation: AskedRelation
    negated: bool
    text: str

    @cached_property
    def regex(self) -> re.Pattern[str]:
        """Compiled when it is first tried: all of them take 0.4 s, and most questions need few."""
        return re.compile(self.text)


_AUX = "(?:will|would|do|does|did|can|could|shall|might|may)"
_SELF = "(?:M|it|they|he|she)"
_AGAIN = "(?:M|it|them|itself)"
_THING = r"(T\d+)"
_ANY = (
    "(?:anything(?: else)?|something(?: else)?|(?:any|some|a|an|another) OBJ|any OBJS|OBJS"
    "|at least one OBJ|(?:any|one|some|at least one) of the OBJS)"
)
_ALL = "(?:everything(?: else)?|(?:every|each) OBJ|all (?:of )?(?:the )?OBJS)"  # of what is avoided
_NONE = "(?:nothing(?: else)?|no OBJ|no OBJS|none of the OBJS|not anything|no other OBJ|no other OBJS)"
_OBJECT = f"(?:{_THING}|{_ANY})"
_VIEW = "(?:the |our |my |your |the camera 's |the viewer 's |camera )?(?:view|sight)"
_FROM = f"(?: from (?:{_VIEW}|the camera|the viewer|us))?"
_CONTACT = "(?:any |a |some |direct |physical )*(?:contact|collision)"
# Words before a verb that change nothing.
_ADVERBS = "(?:(?:then|ever|eventually|actually|also) )*"
_MOTION = "(?:motion|movement|course|trajectory|way|path|flight|travel|journey|roll|slide|run|fall|ride|drive)"
_TAIL = (
    "(?: ,)?(?: (?:"
    "(?:at|in) (?:any|some|one) (?:given )?(?:moment|moments|point|points|time|times|stage|instant)(?: in time)?"
    f"|(?:on|along|in|during|over) (?:its|the|his|their) (?:entire |whole )?{_MOTION}"
    "|in the (?:end|future|process|clip|video|scene|image|picture)|ever|eventually|then|at all|as a result|in doing so"
    "|by doing so|along the way|or not|yes or no"
    "|(?:while|as|when) (?:it be |it |M )?(?:move|move-ing|roll|roll-ing|slide|slide-ing)"
    "))*"
)
_FIRST = "(?: first| for the first time)?"
# Of what stays visible: always, or it is not said when.
_ALWAYS = (
    "(?:throughout(?: (?:its|the|his) (?:entire |whole )?" + _MOTION + ")?|the (?:whole|entire) time|all the time|"
    "at all times|all along|always|during (?:the|its) (?:whole|entire) " + _MOTION + ")"
)
_VISIBLE = f"(?:visible|unobstructed|unoccluded|uncovered|unhidden|unblocked|in (?:plain )?{_VIEW})"

# What the mover does: heads of the verb phrase, then what stands behind them, `%s` for the object.
_ACTIVE: dict[AskedRelation, tuple[tuple[str, str], ...]] = {
    "touches": (
        ("hit|touch|strike|graze|scrape|impact|ram|reach|meet|contact|bump|knock", "%s"),
        ("collide|crash|connect", "with %s"),
        ("bump|crash|smash|knock|ram|run|roll|slide|drive|skid", "(?:into|against) %s"),
        ("make|have", f"{_CONTACT} with %s"),
        ("come|get|be", f"(?:in|into) {_CONTACT} with %s"),
        ("land|fall|drop|tumble|come down", "(?:down )?(?:on|onto|upon|on top of|on to) %s"),
    ),
    "covers": (
        ("hide|occlude|obscure|conceal|eclipse|obstruct", f"%s{_FROM}"),
        ("block|cover", f"%s from (?:{_VIEW}|the camera|the viewer)"),
        ("block|hide|obscure|obstruct|occlude", f"{_VIEW} of %s"),
        ("pass|go|move|roll|slide|drive|travel|run|come", "in front of %s"),
    ),
    "covered": (("pass|go|move|roll|slide|drive|travel|run|disappear|vanish|hide", f"(?:from {_VIEW} )?behind %s"),),
}
_PASSIVE: dict[AskedRelation, str] = {
    "touches": "(?:hit|touch|strike|graze|scrape|ram|bump|knock|reach|contact|impact|collide with|land on"
    "|(?:bump|crash|run|knock|smash|roll) into|make contact with)",
    "covers": f"(?:(?:hide|occlude|obscure|conceal|eclipse|obstruct){_FROM}|(?:block|cover) from {_VIEW})",
}
_BY_MOVER: dict[AskedRelation, str] = {
    "touches": f"(?: by {_AGAIN})?",
    "covers": f"(?: (?:by|behind) {_AGAIN})?",
}
_PASSED_BY = f"(?:miss|avoid|spare) by {_AGAIN}|miss|avoid|leave untouched|left untouched"


def _doing(relation: AskedRelation, target: str, suffix: str = "") -> str:
    """The mover's verb phrases of a relation, with `-ing` or without."""
    phrases = [f"(?:{_suffixed(heads, suffix)}) {rest % target}" for heads, rest in _ACTIVE[relation]]
    return f"(?:{'|'.join(phrases)})"


def _doing_what(relation: AskedRelation) -> str:
    """The same without its object: what "which object will it ..." ends with."""
    phrases = [
        f"(?:{heads}){rest[2:]}" if rest.startswith("%s") else f"(?:{heads}) {rest.replace(' %s', '')}"
        for heads, rest in _ACTIVE[relation]
    ]
    return f"(?:{'|'.join(phrases)})"


def _suffixed(heads: str, suffix: str) -> str:
    return "|".join(" ".join([first + suffix, *more]) for first, *more in (head.split() for head in heads.split("|")))


def _asking(subject: str, negation: str = "") -> str:
    """Everything of a clause up to its verb in the base form."""
    negated = f"{negation} " if negation else ""
    return (
        f"(?:{_AUX} {subject} {negated}|be {subject} {negated}go-ing to |do you (?:think|believe|expect)(?: that)? "
        f"{subject} {_AUX} {negated}|(?:(?:can|could|would) you )?(?:tell|say|predict|know)(?: me| us)? (?:whether|if) "
        f"{subject} (?:{_AUX} )?{negated})"
    )


def _whether() -> Iterator[tuple[AskedRelation, bool, str]]:
    """(relation, negated, clause) of the questions that ask for yes or no."""
    yes, no = _asking(_SELF) + _ADVERBS, _asking(_SELF, "(?:not|never)") + _ADVERBS
    for relation in _ACTIVE:
        base, ing = _doing(relation, _OBJECT), _doing(relation, _OBJECT, "-ing")
        yield relation, False, f"{yes}{base}"
        yield relation, False, f"(?:be {_SELF} |{yes}(?:be|end up) ){ing}"
        yield relation, True, f"{no}{base}"
        yield relation, True, f"{yes}{_doing(relation, _NONE)}"
        yield relation, True, f"{yes}(?:avoid {ing}|fail to {base})"
        yield relation, True, f"{yes}{_passing()}without (?:ever )?{ing}"
        again = _doing(relation, _AGAIN, "-ing")
        yield relation, True, f"{yes}{_passing()}{_THING} without (?:ever )?{again}"
    yield "inside", False, f"{yes}fit(?: (?:in|into|inside|within))?(?: {_THING})?"
    yield "touches", False, f"{_asking('(?:M|it)')}{_ADVERBS}(?:collide|crash)"
    yield "touches", True, f"{yes}(?:miss|avoid) (?:{_THING}|{_ALL})|{yes}avoid {_ANY}"
    yield "touches", True, f"{yes}(?:avoid|{_passing()}without) (?:{_CONTACT}|collide-ing)(?: with {_OBJECT})?"
    yield "touches", True, f"{yes}(?:stay|keep|steer|remain) clear of (?:{_THING}|{_ALL})"
    yield from _whether_passive()
    yield from _whether_together()


def _passing() -> str:
    return "(?:pass|go|get|move|roll|slide|fly|travel|drive|make it|run)(?: (?:by|past|over|along|through))? "


def _whether_passive() -> Iterator[tuple[AskedRelation, bool, str]]:
    """What happens to another thing, or to the mover where it is hidden."""
    subject = f"(?:{_THING}|{_ANY})"
    for relation, verbs in _PASSIVE.items():
        done = f"(?:{verbs}){_BY_MOVER[relation]}"
        yield (
            relation,
            False,
            f"(?:{_asking(subject)}{_ADVERBS}(?:be|get|become|end up) |be {subject} (?:be-ing )?){done}",
        )
        yield relation, True, f"{_asking(_THING, '(?:not|never)')}{_ADVERBS}(?:be|get|become) {done}"
        yield relation, True, f"{_asking(_THING)}(?:avoid|escape) be-ing {done}"
        yield relation, True, f"(?:{_asking(_NONE)}(?:be|get) |be {_NONE} (?:be-ing )?){done}"
    yield "touches", True, f"{_asking(_THING)}(?:be|get) (?:{_PASSED_BY})"
    yield "touches", True, f"{_asking(_THING)}(?:stay|remain|go|be) untouched"
    stays = (
        f"(?:stay|remain|keep) {_VISIBLE}(?: {_ALWAYS})?|be {_VISIBLE} {_ALWAYS}|always (?:be|stay|remain) {_VISIBLE}"
    )
    yield "covers", True, f"{_asking(_THING)}(?:{stays})"
    yield "covers", False, f"{_asking(_THING)}(?:be|go|get) out of {_VIEW}"
    hidden = f"(?:hide|occlude|obscure|conceal|eclipse|obstruct|(?:block|cover) from {_VIEW}){_FROM}"
    behind = f"{hidden}(?: (?:by|behind) {_OBJECT})?"
    yield "covered", False, f"(?:{_asking(_SELF)}{_ADVERBS}(?:be|get|become) |be {_SELF} (?:be-ing )?){behind}"
    yield "covered", True, f"{_asking(_SELF, '(?:not|never)')}(?:be|get|become) {behind}"
    hides = f"(?:hide|occlude|obscure|conceal|eclipse|obstruct) {_AGAIN}{_FROM}|block (?:{_VIEW} of {_AGAIN})"
    for negation in ("", "(?:not|never)"):
        yield "covered", negation != "", f"{_asking(subject, negation)}{_ADVERBS}(?:{hides})"


def _whether_together() -> Iterator[tuple[AskedRelation, bool, str]]:
    """The mover and the other thing as one subject, or contact as the subject."""
    pair = f"(?:{_SELF} and {_THING}|{_THING} and {_AGAIN})"
    meeting = (
        "(?:collide|crash|touch|meet|hit|bump|make contact|(?:come|get|be) (?:in|into) contact)"
        "(?: (?:with |into )?each other| with one another)?"
    )
    yield "touches", False, f"{_asking(pair)}{_ADVERBS}{meeting}"
    yield "touches", True, f"{_asking(pair, '(?:not|never)')}{meeting}"
    event = f"{_CONTACT}(?: with {_OBJECT}| between (?:{_AGAIN} and {_OBJECT}|{_THING} and {_AGAIN}))?"
    yield "touches", False, f"(?:{_AUX} there be|be there(?: go-ing to be)?) {event}"
    yield "touches", True, f"(?:{_AUX} there be|be there) no {event}"


def _when() -> Iterator[tuple[AskedRelation, bool, str]]:
    asks = (
        "(?:when(?: exactly| approximately| about)?|(?:at|in|after) (?:what|which) (?:time|moment|second|instant)"
        "|at what point in time|after how long|how soon"
        "|(?:in|after) how many seconds) "
    )
    lasts = "how (?:long|much time|many seconds) "
    takes = f"(?:(?:{_AUX} it take|be it|{_AUX} it be|pass|elapse|go by|{_AUX} pass|{_AUX} elapse) )?"
    until = "(?:until|till|before) "
    for relation in _ACTIVE:
        vp = f"(?:first )?{_doing(relation, _OBJECT)}{_FIRST}"
        yield relation, False, f"{asks}(?:{_asking(_SELF)}){_ADVERBS}{vp}"
        yield relation, False, f"{lasts}{takes}{until}{_SELF} (?:{_AUX} )?{vp}"
        yield relation, False, f"{lasts}{_AUX} {_SELF} take (?:{_SELF} )?(?:for {_SELF} )?to {vp}"
        yield relation, False, f"{lasts}{takes}for {_SELF} to {vp}"
    subject = f"(?:{_THING}|{_ANY})"
    for relation, verbs in _PASSIVE.items():
        done = f"(?:first )?(?:{verbs}){_BY_MOVER[relation]}{_FIRST}"
        yield relation, False, f"{asks}(?:{_asking(subject)}(?:be|get|become) |be {subject} (?:be-ing )?){done}"
        yield relation, False, f"{lasts}{takes}{until}{subject} (?:{_AUX} )?(?:be|get|become) {done}"
        yield relation, False, f"{lasts}{takes}for {subject} to (?:be|get|become) {done}"


def _how_many() -> Iterator[tuple[AskedRelation, bool, str]]:
    total = "(?: in total| in all| altogether| overall)?"
    number = "(?:how many|what(?: be| 's) the (?:total )?number of) (?:of the )?(?:different )?OBJS(?: that)?"
    for relation in _ACTIVE:
        yield relation, False, f"{number} (?:{_asking(_SELF)}|{_SELF} (?:{_AUX} )?){_doing_what(relation)}{total}"
    yield "touches", False, f"with how many (?:different )?OBJS {_asking(_SELF)}(?:collide|make contact){total}"
    for relation, verbs in _PASSIVE.items():
        yield relation, False, f"{number} (?:{_AUX} )?(?:be|get|become) (?:{verbs}){_BY_MOVER[relation]}{total}"


def _which_first() -> Iterator[tuple[AskedRelation, bool, str]]:
    of_several = "which (?:one )?of (?:(?:the |these |those )?OBJS|these|them|those)"
    which = rf"(?:what|which|(?:which|what) OBJ|{of_several}|which (K\d+))"
    things = rf"{_THING}(?: , {_THING})?(?: , {_THING})?(?: ,)? or {_THING}"
    listed = f"(?: ,(?: {things}))?"
    for relation in _ACTIVE:
        vp = _doing_what(relation)
        yield relation, False, f"{which} {_asking(_SELF)}{_ADVERBS}(?:first )?{vp}(?: first)?{listed}"
        yield (
            relation,
            False,
            f"(?:what|which)(?: be| will be| 's) the first OBJ(?: that| which)? {_SELF} (?:{_AUX} )?{vp}",
        )
        yield relation, False, f"{_asking(_SELF)}first {_doing(relation, f'(?:{things})')}"
        yield relation, False, f"{_asking(_SELF)}{_doing(relation, f'(?:{things})')}(?: ,)? first"
    yield (
        "touches",
        False,
        f"(?:with|into|on|onto) {which} {_asking(_SELF)}(?:first )?(?:collide|crash|bump|land|fall)(?: first)?",
    )
    for relation, verbs in _PASSIVE.items():
        done = f"(?:first )?(?:{verbs}){_BY_MOVER[relation]}"
        yield relation, False, f"{which} (?:{_AUX} )?(?:be|get|become) {done}(?: first)?{_BY_MOVER[relation]}{listed}"
        yield relation, False, f"{which} (?:will )?be the first(?: OBJ| one)? (?:to be|to get|that be) {done}"
        yield (
            relation,
            False,
            f"(?:{_asking(f'(?:{things})')}(?:be|get|become) |be {things} ){done} first{_BY_MOVER[relation]}",
        )


def _patterns() -> tuple[Pattern, ...]:
    table: tuple[tuple[AskedForm, Iterator[tuple[AskedRelation, bool, str]]], ...] = (
        ("whether", _whether()),
        ("which-first", _which_first()),
        ("when", _when()),
        ("how-many", _how_many()),
    )
    return tuple(
        Pattern(form, relation, negated, f"(?:{clause}){_TAIL}")
        for form, clauses in table
        for relation, negated, clause in clauses
    )


PATTERNS = _patterns()
