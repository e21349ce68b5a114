"""The closed word lists. Nouns are an open set and have none: a noun is what no list claims."""

from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal, NamedTuple

from cow_service.readers.base import Quantity, SpeedWord
from cow_service.records import MotionKind, Until


def words(*lists: str) -> frozenset[str]:
    """The words of some space-separated lists."""
    return frozenset(word for text in lists for word in text.split())


COLOURS = {
    word: text.split()[0]
    for text in (
        "red crimson scarlet maroon burgundy reddish", "orange amber", "yellow gold golden yellowish",
        "green emerald greenish", "cyan teal turquoise aqua aquamarine", "blue navy azure cobalt bluish",
        "purple violet lavender lilac indigo", "pink magenta fuchsia", "brown tan beige khaki bronze", "black",
        "white ivory", "grey gray silver greyish",
    )
    for word in text.split()
}  # fmt: skip
NEARLY = 0.8  # difflib's ratio from which a word is nearly a colour's name
ADJECTIVES = words("""
big large huge giant small little tiny mini tall short long wide narrow thick thin high low deep heavy light round
square flat hollow empty full open closed shiny glossy dark pale bright transparent clear wooden metal metallic plastic
glass rubber paper ceramic stone leather steel cardboard soft hard smooth rough old new other same different nearest
closest farthest furthest nearby leftmost rightmost topmost second third last single main larger smaller bigger taller
shorter largest smallest biggest tallest shortest far slow fast central front rear back middle center centre left right
top bottom upper lower toy model billiard pool snooker tennis striped two three four five pointy fuzzy latest oldest""")
PLACES = words("left right top bottom upper lower front back middle center centre")
DETERMINERS = words("""
the a an this that these those its his her their my your our another each every any some which what both either neither all
no""")
PRONOUNS = words("it they them itself he she that this these those one ones itself others")
FLOORS = "floor|ground|surface|carpet|grass|pavement|street|road|tabletop|counter|sky"
IMAGES = "image|picture|photo|photograph|scene|frame|view"
TABLES = words("table desk tabletop")
AGENTS = words("""
person man woman boy girl child kid player human user people robot arm hand wind gust finger foot driver toddler
friend somebody someone anyone anybody nobody i you we he she cat dog""")
GENERIC = words("object objects thing things item items one ones body bodies obstacle obstacles")
FUNCTION = words("""
will be get have let make cause allow to of in inside within on onto upon into at toward towards from off over under
below above beneath beside near by with along against across through around past behind before between among via per
about as like than during until till for out outside and or but then so because whether since though how where why if
when while once suppose supposing imagine assume assuming given after unless not never there here who whom whose that
which what safe still first next together away up down close closer also ever just already always only even perhaps
maybe else opposite due parallel backward too much more most than yes ok now freely able free true false same twice
halfway alone throughout again later soon long instead except rather anywhere nowhere everywhere somewhere without
straight directly well possible visible unobstructed unoccluded uncovered untouched upright motionless stationary
nothing anything something everything i you we us me him them they it its itself itself's due such upside""")
MOTIONS: dict[MotionKind, frozenset[str]] = {
    "linear": words("""
move roll slide go drive travel push pull drag blow shove kick nudge flick tap glide skid drift advance proceed head
run speed dash sail crawl shift steer reverse accelerate cruise float carry transport lift raise rise climb ascend
descend lower continue scoot creep coast retreat send march trundle shunt aim translate start set keep come"""),
    "projectile": words("throw toss launch hurl shoot fly fire chuck bounce"),
    "fall": words("fall drop release tumble topple plummet plunge collapse tip detach"),
    "static": words("stay remain rest stand"),
}
_OTHER = words("""
hit touch collide bump strike reach knock crash contact smash meet impact ram graze whack smack bang slam occlude hide
block cover obscure conceal overlap eclipse obstruct disappear vanish land settle happen occur end stop halt fit miss avoid prevent
remove delete erase eliminate exclude take put place insert position pass leave overturn displace budge change
differ clear pick want finish change mean go smash eclipse""")
CAUSES = words("""
move roll slide push pull drag blow shove kick nudge flick tap shift carry lift raise lower throw toss launch hurl
shoot fire chuck bounce drop release topple tip drive steer send shunt aim""")  # "push the ball to the left"
_DOUBLED = words("travel drag skid drop tap hop run tip ram hit fit stop get let put set")
_IRREGULAR = {
    "go": "went gone", "drive": "drove driven", "run": "ran", "rise": "rose risen", "keep": "kept", "creep": "crept",
    "come": "came", "send": "sent", "speed": "sped", "throw": "threw thrown", "blow": "blew blown", "shoot": "shot",
    "fly": "flew flown", "fall": "fell fallen", "stand": "stood", "hit": "", "strike": "struck", "meet": "met",
    "hide": "hid hidden", "slide": "slid", "take": "took taken", "put": "", "set": "", "leave": "",
    "get": "got gotten", "make": "made", "let": "", "mean": "meant", "begin": "began begun",
}  # fmt: skip


class Verb(NamedTuple):
    """An inflected form of a verb."""

    lemma: str
    form: Literal["base", "s", "past", "ing"]


def _inflected(lemma: str) -> dict[str, Verb]:
    stem = lemma + lemma[-1] if lemma in _DOUBLED else lemma.removesuffix("e")
    third, past = f"{lemma}s", f"{stem}ed"
    if lemma.endswith("y") and lemma[-2] not in "aeo":
        third, past = f"{lemma[:-1]}ies", f"{lemma[:-1]}ied"
    elif lemma.endswith(("s", "x", "ch", "sh", "o")):
        third = f"{lemma}es"
    pasts = dict.fromkeys(_IRREGULAR.get(lemma, past).split(), Verb(lemma, "past"))
    return {third: Verb(lemma, "s"), f"{stem}ing": Verb(lemma, "ing"), **pasts, lemma: Verb(lemma, "base")}


VERBS = {
    word: verb
    for lemma in sorted(_OTHER.union(*MOTIONS.values(), words("get make let begin have")))
    for word, verb in _inflected(lemma).items()
}
VERBS |= dict.fromkeys(words("is are was were be been being am"), Verb("be", "base"))
VERBS |= dict.fromkeys(words("has had"), Verb("have", "base"))
VERBS |= dict.fromkeys(words("would does do did can could may might shall should must"), Verb("will", "base"))
KINDS = {lemma: kind for kind, lemmas in MOTIONS.items() for lemma in lemmas}

# What a noun says of a body's shape. A vehicle is longer along its heading than across, a cube as wide as high.
_SHAPES = {
    "sphere": "ball sphere egg orb marble basketball football baseball balloon globe orange apple pea bead pearl bubble",
    "box": "cube box block brick cuboid die dice book chair table desk carton parcel package crate drawer cabinet",
    "vehicle": "car truck bus train van lorry jeep taxi tram tractor wagon locomotive boat",
    "cube": "cube die dice",
    "cone": "cone pyramid",
    "cylinder": "cylinder bottle vase mug cup glass jar can candle tin tube pencil pen lamp pot bowl bucket barrel pawn "
    "person man woman tree plant post pole",
    "square": "box crate drawer carton case chest tray suitcase bag cart sink crib bathtub package parcel",
    "round": "bowl cup mug glass jar pot pan bucket barrel bin basket vase tin can dish goblet teacup pitcher jug tub "
    "flowerpot saucepan container pail beaker tumbler cauldron urn hat",
}
NOUNS = {shape: words(text) for shape, text in _SHAPES.items()}
HOLLOW = words("bowl basket hole pocket goal bin bucket pit hoop net drawer gap garage tunnel tray pan pot")  # to roll into
CONTAINERS = HOLLOW | (NOUNS["round"] | NOUNS["square"]) - {"vase", "can"}  # to fall into
SOLID_NOUNS = words("glass chair book lamp robot pencil pen")  # no balls; of their outlines nothing is known
NUMBER_WORDS = {
    word: value
    for value, word in enumerate(
        "one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen".split(), 1
    )
}
METRES = {
    word: size
    for size, text in (
        (1.0, "m meter meters metre metres"), (0.01, "cm centimeter centimeters centimetre centimetres"),
        (0.001, "mm millimeters millimetres"), (0.0254, "inch inches"), (0.3048, "ft foot feet"),
    )
    for word in text.split()
}  # fmt: skip
# Of options: words that carry no answer, and words of contact.
FILLERS = words("""
it they the a an will would does do is are be gets get with into on onto against makes make comes come there in by
remains stays stay remain still to from view sight of passes pass out""")
TOUCHING = words("""
hit hits hitting touch touches touching collide collides collision contact impact strike strikes bump bumps land lands
reach reaches touched struck""")


def lemma(word: str) -> str:
    """The base form of a lower case verb; any other word as it is."""
    return VERBS[word].lemma if word in VERBS else word


def is_modifier(word: str) -> bool:
    """Whether a lower case word describes a noun and is none: a colour, an adjective, a participle, a place."""
    ing = word in VERBS and VERBS[word].form in {"past", "ing"}
    return ing or word in COLOURS or word in ADJECTIVES or word in PLACES or word in {"marked", "highlighted", "circled"}


def singular(noun: str) -> str:
    """A plural noun made singular, by its ending."""
    if noun in words("glasses scissors pants dice bus lens chess series shoes trousers jeans") or len(noun) < 4:
        return noun
    if not noun.endswith("s") or noun.endswith(("ss", "us", "is")):
        return noun
    if noun.endswith(("sses", "xes", "ches", "shes", "toes")):
        return noun[:-2]
    return noun[:-3] + "y" if noun.endswith("ies") else noun[:-1]


@dataclass(frozen=True)
class PlaceWords:
    """Where a thing is in the image: behind, in front of or nearest to another one, or to the camera (`of` is None)."""

    relation: str
    of: "ObjectPhrase | None"


@dataclass(frozen=True)
class ObjectPhrase:
    """An object as the question words it: `text` has no determiner, `noun` is the head noun, or a compound, singular.

    `place` is where the image shows it, as far as the question says so. `is_given`: the text is the name under which
    the caller gave it.
    """

    text: str
    colour: str | None
    noun: str | None
    inside_box: bool = False  # drawn around it
    path_end: str | None = None  # it stands at the "start" or the "end" of a drawn path
    place: PlaceWords | None = None
    is_given: bool = False

    @property
    def head(self) -> str | None:
        """The last word of the noun: "car" of "toy car"."""
        return self.noun.rsplit(" ", 1)[-1] if self.noun else None

    @property
    def is_other(self) -> bool:
        """Whether it is "the other one": whatever else there is."""
        return self.text in {"other one", "other"}

    @property
    def words(self) -> set[str]:
        """The lower case words of the text."""
        return set(self.text.lower().split())


def like_a_colour(text: str) -> str | None:
    """A word of a noun phrase that is nearly a colour's name, and no other word that is known: "grean"; or None."""
    unknown = (word for word in text.lower().split()[:-1] if word not in ADJECTIVES and word not in PLACES)
    return next((word for word in unknown if get_close_matches(word, COLOURS, 1, NEARLY)), None)


@dataclass(frozen=True)
class QuantityWords:
    """How fast, how far or how long something moves, as some words say it; one field is set."""

    speed: SpeedWord | Quantity | None = None
    distance: Quantity | None = None
    share: float | None = None  # of the way to what it moves towards
    own_widths: float | None = None  # a distance, in widths of what moves
    duration: float | None = None  # s
    until: Until | None = None
    within: float | None = None  # s: a limit for the event, not for the motion
