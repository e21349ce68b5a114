"""The Protocol of readers, which read an image for a question. Stages know this file, never an implementation."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Literal, Protocol

from cow_service import records
from cow_service.media.types import Image
from cow_service.narration.words import same_name
from cow_service.perception.base import Thing
from cow_service.perception.observation import Observation
from cow_service.records import Grounding, Language, ObjectPrior, ObjectRequest, Reading, Source

Likeness = Literal["same", "other", "unknown"]
# What a caller can do if a reader finds no place or no direction; used at the end of its error messages.
GIVE_DIRECTION = "Say it with `motion.direction` [dx, dy] in the request, in pixels, x right and y down."
GIVE_OBJECT = "Give its box under that name in `objects`."
GIVE_PLACE = "Say where it is with `grounding.point` [x, y] or `grounding.bbox` [x0, y0, x1, y1] in the request."


@dataclass
class CallLog:
    """What one stage sent to a multimodal LLM. Readers add to it, so that failed calls count, too."""

    usage: records.Usage = field(default_factory=records.Usage)
    prompts: dict[str, int] = field(default_factory=dict[str, int])  # version by name
    notes: dict[str, None] = field(default_factory=dict[str, None])  # warnings of what was sent in another form


NOTHING_SAID = Reading()


@dataclass(frozen=True)
class ReaderInput:
    """What every call of a reader is given. Readers keep nothing of it from one call to the next."""

    image: Image  # RGB [H, W, 3]
    question: str
    observation: Observation | None = None  # what the image shows; None where only an answer is wanted
    given: Reading = NOTHING_SAID  # what is known: not to be read again. Objects without a place are to be located
    motion_wanted: bool = True  # stage 2 is left to the reader, as far as `given` does not say it
    language: Language = "en"  # of what is said of the simulation
    seed: int | None = None  # None: an MLLM is sent none, and draws as it likes
    words: "WordsReading | None" = None  # what the words of the question say, where a reader may rely on it
    objections: tuple[str, ...] = ()  # what speaks against its last reading, in sentences: to be asked again with these
    until: float | None = None  # Unix time, s, after which an MLLM that refuses is not asked again; None: its own limit
    calls: CallLog = field(default_factory=CallLog)
    check_canceled: Callable[[], None] = lambda: None  # to be called while waiting; raises `Canceled`
    cpu: Callable[[], AbstractContextManager[None]] = nullcontext  # to be held around work on the CPU; not reentrant
    find: Callable[[Sequence[str]], tuple[Thing, ...]] | None = None  # by names, with `cpu` held; None: no detector

    @property
    def seen(self) -> Observation:
        """What the image shows, for a reader that is asked to read it."""
        assert self.observation is not None, "looked at before a reader is asked to read"
        return self.observation

    @property
    def known(self) -> tuple[ObjectRequest, ...]:
        """The objects whose places are known."""
        return tuple(each for each in self.given.objects if each.bbox is not None)

    @property
    def sought(self) -> tuple[str, ...]:
        """Names of further objects that the caller wants located, besides those of the question."""
        changed = (name for each in self.given.interventions or () for name in (each.object, *each.targets))
        named = dict.fromkeys((*changed, *(each.object for each in self.given.objects)))
        return tuple(name for name in named if not any(same_name(name, each.object) for each in self.known))


@dataclass(frozen=True)
class ReadResult:
    """What a reader says of an image and a question: nothing that was given, and nothing that was not wanted."""

    reading: Reading = NOTHING_SAID
    warnings: tuple[str, ...] = ()
    label: str = ""  # what it calls the thing in the box of the moving object, if not by that name
    place_doubts: tuple[str, ...] = ()  # why its boxes may be wrong, unless the image shows the moving object there


@dataclass(frozen=True)
class WordsReading:
    """What the words of a question say, without a look at the image and without a model.

    Its `objects` are the further things that the question names, and have no places.
    """

    reading: Reading = NOTHING_SAID
    is_whole: bool = False  # the words tell all of the motion but which way, and name all things
    trail_named: bool = False  # the question speaks of a trail
    nouns: tuple[str, ...] = ()  # of the things that it names, each once
    drawings_named: frozenset[str] = frozenset()  # "arrow" and "box", where the question speaks of one


@dataclass(frozen=True)
class Imagined:
    """What an answer may use besides the image: the simulation and its frames."""

    simulation: records.Simulation
    frames: tuple[Image, ...]  # RGB [h, w, 3] of `simulation.frames`, in their order
    factual_frames: tuple[Image, ...] = ()  # of `simulation.factual_frames`


@dataclass(frozen=True)
class AnswerReading:
    """One answer as a reader gives it: the letter of an option, or text where the question offers none."""

    answer: str | None  # null if it is not sure and no option says so
    not_sure: bool
    reasoning: str = ""  # empty if the reader does not reason in words
    notes: tuple[str, ...] = ()  # what the answer rests on or lacks, in whole sentences: warnings for the caller


class WordReader(Protocol):
    """Reads only words, without an image, weights or calls; used for every request, whatever its reader."""

    def read_question(self, question: str, names: Sequence[str] = ()) -> WordsReading:
        """What a question says in words that it understands. `names` are those of the things that the caller gave."""
        ...

    def read_name(self, name: str) -> ObjectPrior:
        """What the name of an object says of its shape."""
        ...

    def likeness(self, words: str, name: str) -> Likeness:
        """Whether a phrase means the thing of that name.

        It does where they share a colour, noun or number and differ in none; it means another one where they differ in
        a colour, a number or a form.
        """
        ...

    def names_meant(self, words: str, names: Sequence[str]) -> tuple[str, ...]:
        """Those of some names that a phrase for several things means, such as "both mugs"; else the phrase itself."""
        ...


class Reader(Protocol):
    """Reads images for questions. Holds connections or weights, never a request; safe to use from several threads."""

    source: Source
    info: records.ReaderInfo
    """Name, model and revision. The run adds prompts and stages."""
    fingerprint: str
    """Everything that determines its results besides its inputs: model, revision, prompts, options."""

    heeds_seed: bool
    """Whether the seed of a request changes anything."""

    heeds_objections: bool
    """Whether `ReaderInput.objections` may change what it reads."""

    def repeats_answers(self, votes: int) -> bool:
        """Whether `answer` gives the same votes every time for the same input.

        Where not, its answers are samples: none is handed to two requests.
        """
        ...

    def read(self, given: ReaderInput) -> ReadResult:
        """What moves and where it is, how it moves, what else matters, and what is changed and asked.

        Raises `CannotGround` if it cannot tell what moves or where, `CannotReadDirection` if it cannot tell how.
        """
        ...

    def answer(
        self,
        given: ReaderInput,
        options: Sequence[records.AnswerOption],
        grounding: Grounding | None,
        imagined: Imagined | None,
        votes: int,
    ) -> tuple[AnswerReading, ...]:
        """`votes` answers, fewer where some could not be read; without `imagined` from the image alone.

        `grounding` is what stage 1 came to, also where a later stage failed and nothing was imagined.
        """
        ...
