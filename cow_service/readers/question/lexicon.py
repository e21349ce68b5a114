"""The closed word lists that the question parser stands on: colours, verbs with their inflections, function words.

Nouns are an open set and have no list here: a noun is what none of these lists claims.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cow_service.records import MotionKind, Vector

Form = Literal["base", "s", "past", "ing"]


def words(*lists: str) -> frozenset[str]:
    """The words of some space-separated lists."""
    return frozenset(word for text in lists for word in text.split())


@dataclass(frozen=True)
class Verb:
    """One inflected form of a verb. `kind` is None for a verb that is not a way to move."""

    lemma: str
    form: Form
    kind: MotionKind | None


_COLOUR_WORDS = {
    "red": "red crimson scarlet maroon burgundy reddish",
    "orange": "orange amber",
    "yellow": "yellow gold golden yellowish",
    "green": "green emerald greenish",
    "cyan": "cyan teal turquoise aqua aquamarine",
    "blue": "blue navy azure cobalt bluish",
    "purple": "purple violet lavender lilac indigo",
    "pink": "pink magenta fuchsia",
    "brown": "brown tan beige khaki bronze",
    "black": "black",
    "white": "white ivory",
    "grey": "grey gray silver greyish",
}
COLOURS: dict[str, str] = {word: name for name, text in _COLOUR_WORDS.items() for word in text.split()}

ADJECTIVES = words(
    "big large huge giant small little tiny mini tall short long wide narrow thick thin high low deep heavy round",
    "circular spherical square rectangular cubic cylindrical flat hollow empty full open closed shiny glossy",
    "matte bright light dark pale vivid transparent clear opaque solid plain wooden wood metal metallic plastic",
    "glass rubber paper ceramic stone leather steel cardboard soft hard smooth rough old new other same different",
    "nearest closest farthest furthest nearby leftmost rightmost topmost first second third last single main",
    "whole entire own current original constant lone fuzzy larger smaller bigger taller shorter largest smallest",
    "biggest tallest shortest far latest newest oldest earliest fast slow central front rear distant",
)
# Nouns that stand before a noun: they stay in a compound, but do not yet make it whole ("toy racing car").
NOUN_MODIFIERS = words("toy model billiard pool snooker tennis")
# Nouns with the ending of an adjective.
_NOT_ADJECTIVES = words(
    "bed sled seed weed shed reed feed steed ring king string wing swing thing sling earring building painting",
    "ceiling dumpling clothing housing railing bearing pudding morning evening",
)
_NOT_ADVERBS = words("butterfly family jelly belly bully trolly")
MARKED = words("highlighted marked circled boxed outlined encircled")

_IRREGULAR_PLURALS = {"knives": "knife", "shelves": "shelf", "men": "man", "women": "woman", "children": "child"}
UNCHANGED_PLURALS = words(
    "glasses scissors pants dice bus lens chess series shoes trousers jeans cookies movies ties pies"
)

_NUMERALS = "one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen"
NUMBER_WORDS: dict[str, int] = {word: value for value, word in enumerate(_NUMERALS.split(), 1)}

_DIRECTION_WORDS: dict[Vector, str] = {
    (-1.0, 0.0): "left leftward leftwards",
    (1.0, 0.0): "right rightward rightwards",
    (0.0, -1.0): "up upward upwards upper top skyward skywards",
    (0.0, 1.0): "down downward downwards lower bottom",
}
DIRECTIONS: dict[str, Vector] = {word: vector for vector, text in _DIRECTION_WORDS.items() for word in text.split()}
PLACES = frozenset(DIRECTIONS) | words("front back middle center centre")

DETERMINERS = words(
    "the a an this these those that its his her their my your our another each every any some which what whose many"
)
VAGUE_DETERMINERS = words("any some which what each every many")
CONDITIONALS = words(
    "if when whenever suppose supposing imagine imagining assuming assume given provided once after while unless say",
    "consider considering upon",
)
AUXILIARIES = words(
    "will would does do did can could should shall may might must wo ca won't wouldn't doesn't don't didn't can't"
)
BE = words("be is are was were been being am 's isn't aren't wasn't get gets got getting")
NEGATIONS = words("not never n't won't wouldn't doesn't don't didn't can't isn't aren't wasn't without cannot")
CAUSATIVES = words("let lets letting make makes making made cause causes causing caused allow allows force forces see")
MOVER_PRONOUNS = words("it they itself he she them")
FUNCTION_WORDS = (
    AUXILIARIES
    | BE
    | NEGATIONS
    | CONDITIONALS
    | CAUSATIVES
    | MOVER_PRONOUNS
    | words(
        "except rather neither nor versus whereas apart",
        "i you we us me him someone somebody anyone anybody anything something nothing everything there here who",
        "whom in inside within on onto upon into at to toward towards from of off over under below above beneath",
        "beside near by with along across through around past behind before between among against via per about",
        "as like than during until till for out outside and or but then so because whether since though how where",
        "why ~ true false rid",
        "next close now still think believe predict expect tell know suppose also ever just straight already",
        "always instead soon again away closer nearer farther further far together too very much only even",
        "perhaps maybe else finally opposite according due parallel perpendicular ahead forward forwards backward",
        "backwards onward onwards sideways yes no please pls ok has have had having following contrary",
    )
)
AGENTS = words(
    "person man woman boy girl child kid player human user people robot arm hand wind gust force finger foot cue",
    "stick fan breeze bat club racket golfer",
)
GENERIC = words("object objects thing things item items one ones")
SCENERY = words(
    "floor ground table tabletop wall walls surface room ceiling carpet grass pavement street road sky desktop",
    "track rail rails",
)
VIEWERS = words("camera viewer observer lens photographer spectator")
ABSTRACT = (
    PLACES
    | VIEWERS
    | words(
        "arrow arrows arrowhead image picture photo photograph frame video screen scene moment moments time",
        "position location place spot direction directions way path trajectory course route motion movement side",
        "sides edge corner end line distance speed velocity acceleration gravity rate meter meters metre metres",
        "centimeter centimeters cm m feet inch inches pixel pixels degree degrees answer question option options",
        "letter result case point points second seconds view viewpoint perspective sight background foreground",
        "horizon collision contact impact turn push kick shove nudge throw chance possibility order bit state",
        "part area region space height angle air air's depth reverse motionless stationary number label influence",
        "choice choices yes no forth freefall place front manner fashion pace future scenario situation half",
        "absence trail trails positions ghosts copies outcome",
        "border tip upright force fall toss possible likely true sure going visible untouched rest unison parabola arc",
    )
)
NO_THINGS = ABSTRACT | SCENERY
MEASURES = words(
    "cm mm m km meter meters metre metres centimeter centimeters centimetre centimetres inch inches feet",
    " ft degrees pixels px units steps times seconds",
)
MARK_NOUNS = words("box rectangle circle bbox outline square frame")

_KINDS: dict[MotionKind, frozenset[str]] = {
    "linear": words(
        "move roll slide go drive travel push pull drag blow shove kick nudge flick tap glide skid drift advance",
        "proceed head run walk race speed zoom dash ride sail swim crawl shift steer reverse accelerate cruise",
        "turn spin swing float propel carry bring transport lift raise rise climb ascend descend sink lower step",
        "approach pass cross follow continue keep start begin slip scoot creep coast retreat return come send",
        "give displace relocate march slither",
    ),
    "projectile": words(
        "throw toss launch hurl fling shoot fly lob pitch cast catapult fire chuck sling eject bounce leap jump hop"
    ),
    "fall": words("fall drop release tumble topple plummet plunge collapse tip detach freefall"),
    "static": words("stay remain rest stand sit"),
}
TOUCH = words("hit touch collide bump strike reach knock crash contact smash meet impact ram graze intersect scrape")
OCCLUDE = words("occlude hide block cover obscure conceal overlap eclipse obstruct disappear vanish")
LAND = words("land settle")
_OTHER = words(
    "happen become end stop appear look fit affect break point show indicate lie hang face miss avoid fail",
    "remove delete erase eliminate exclude withdraw discard take put place insert set exist stick protrude overflow",
    "change differ matter leave count",
)
# Acting on something else with these makes that thing the mover ("someone pushes the cube").
TRANSITIVE = words(
    "move roll slide push pull drag blow shove kick nudge flick tap knock shift propel carry bring transport lift",
    "raise lower throw toss launch hurl fling shoot lob pitch cast catapult fire chuck sling eject bounce drop",
    "release tip topple drive steer turn spin swing give send hit strike displace relocate fly start",
)
# They only say that a motion goes on or begins: a stronger verb close behind them is the motion.
WEAK = words("keep continue start begin go come send give follow pass cross approach head return stay remain rest get")

_DOUBLED = words("drag skid drop slip tap hop run swim tip step ram lob spin sit hit fit stop get let put set")
_IRREGULAR = {
    "go": "went gone", "drive": "drove driven", "run": "ran", "ride": "rode ridden", "swim": "swam swum",
    "spin": "spun", "swing": "swung", "bring": "brought", "rise": "risen", "sink": "sank sunk", "begin": "began begun",
    "keep": "kept", "creep": "crept", "come": "came", "send": "sent", "give": "gave given", "speed": "sped",
    "throw": "threw thrown", "fling": "flung", "blow": "blew blown", "shoot": "shot", "fly": "flew flown",
    "cast": "cast", "sling": "slung",
    "leap": "leapt", "fall": "fell fallen", "stand": "stood", "sit": "sat", "hit": "hit", "strike": "struck stricken",
    "meet": "met", "hide": "hid hidden", "slide": "slid", "become": "became", "break": "broke broken", "show": "shown",
    "lie": "lay lain", "hang": "hung", "take": "took taken", "put": "put", "set": "set", "stick": "stuck", "leave": "",
}  # fmt: skip
_PARTICIPLES = words(
    "labeled labelled marked numbered highlighted circled boxed surrounded enclosed bounded outlined encircled drawn",
    "depicted located placed positioned called",
)


def _third_person(lemma: str) -> str:
    if lemma.endswith(("s", "x", "ch", "sh", "o")):
        return lemma + "es"
    return lemma[:-1] + "ies" if lemma.endswith("y") and lemma[-2] not in "aeo" else lemma + "s"


def _forms(lemma: str) -> dict[str, Form]:
    stem = lemma + lemma[-1] if lemma in _DOUBLED else lemma.removesuffix("e")
    past = lemma[:-1] + "ied" if lemma.endswith("y") and lemma[-2] not in "aeo" else stem + "ed"
    forms: dict[str, Form] = {_third_person(lemma): "s", stem + "ing": "ing"}
    forms |= dict.fromkeys(_IRREGULAR.get(lemma, past).split(), "past")
    forms[lemma] = "base"
    return forms


def _verbs() -> dict[str, Verb]:
    kinds: dict[str, MotionKind | None] = dict.fromkeys(TOUCH | OCCLUDE | LAND | _OTHER)
    for kind, lemmas in _KINDS.items():
        kinds |= dict.fromkeys(lemmas, kind)
    table = {word: Verb(word, "past", None) for word in _PARTICIPLES}
    for lemma, kind in kinds.items():
        table |= {word: Verb(lemma, form, kind) for word, form in _forms(lemma).items()}
    return table


VERBS: dict[str, Verb] = _verbs()


def lemma(word: str) -> str:
    """The base form of a lower case verb; empty for a word that is none."""
    return VERBS[word].lemma if word in VERBS else ""


def is_modifier(word: str) -> bool:
    """Whether a lower case word describes a noun and is none: a colour, an adjective, a participle, a place."""
    if word in _NOT_ADJECTIVES:
        return False
    participle = word in VERBS and VERBS[word].form in {"past", "ing"}
    known = any(word in listed for listed in (COLOURS, ADJECTIVES, PLACES, NUMBER_WORDS, MARKED))
    ending = len(word) > 4 and word.endswith(("ed", "ing", "ish", "ful", "less", "ous"))
    return participle or known or word.isdecimal() or ending


def is_adverb(word: str) -> bool:
    """Whether a lower case word is an adverb by its ending, such as "freely"."""
    return len(word) > 4 and word.endswith("ly") and word not in _NOT_ADVERBS


def singular(noun: str) -> str:
    """A plural noun made singular, by its ending."""
    if noun in _IRREGULAR_PLURALS:
        return _IRREGULAR_PLURALS[noun]
    if noun in UNCHANGED_PLURALS or len(noun) < 4 or not noun.endswith("s") or noun.endswith(("ss", "us", "is")):
        return noun
    if noun.endswith(("sses", "xes", "ches", "shes", "toes")):
        return noun[:-2]
    return noun[:-3] + "y" if noun.endswith("ies") else noun[:-1]
