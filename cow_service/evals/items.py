"""Items and replies. An item is one question about one image, with its options and its truth."""

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

from pydantic import Field

from cow_service.errors import ArtifactNotFound
from cow_service.media.artifacts import DiskArtifacts, media_type_of
from cow_service.media.images import decode
from cow_service.readers.options import split_options
from cow_service.records import AnswerOption, Record
from cow_service.records.grounding import BBox, Point, Sha256

Task = Literal["collision", "trajectory", "compatibility", "occlusion", "other"]
TASKS: tuple[Task, ...] = ("collision", "trajectory", "compatibility", "occlusion", "other")
REAL = "real"  # the level of photographs
UNKNOWN_LEVEL = "?"
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
Ask = Literal["prompt", "answer"]
Wording = tuple[tuple[str, ...], tuple[AnswerOption, ...]]


class Truth(Record):
    """What is known of what really happens."""

    pictures: tuple[tuple[float, Sha256], ...] = Field(default=(), description="Of moments, s, in their order.")
    fps: float = Field(default=30.0, gt=0, description="Points of `track` per second, pictures by their number, too.")
    track: tuple[Point, ...] = Field(default=(), description="Centre of the moving object, px; empty: not known.")
    scale: tuple[float, ...] = Field(default=(), description="Its apparent size at each, 1 at the first; or empty.")
    object: str | None = Field(default=None, description="What it is called.")
    boxes: dict[str, BBox] = Field(default_factory=dict, description="Of all known objects at the first moment, px.")

    @property
    def is_shown(self) -> bool:
        """Whether there are true frames, or can be drawn."""
        return len(self.track) > 1 or bool(self.pictures)


class Item(Record):
    """One question of a data set. It holds no pixels: pictures are files that are named by their digest."""

    id: str = Field(description="Unique in the data set, whatever the ids of its rows are.")
    row: str = Field(description="Where it stands in the data, for people: file and row.")
    source_id: str = Field(description="As the data names it; need not be unique.")
    image: Sha256
    question: tuple[str, ...] = Field(description="The text around the options, as `question_text` joins them.")
    options: tuple[AnswerOption, ...] = Field(description="In the data's order.")
    answer: str = Field(description="Letter of the right option, in the data's order.")
    abstain: str | None = Field(description="Letter of the option that says that it is not sure, found by its text.")
    task: Task
    level: str = Field(description="L1, L2, ..., `real` for photographs, `?` where the data does not say.")
    scene: str = Field(description="Items of one scene are not independent: statistics draw whole scenes.")
    truth: Truth | None = Field(default=None, description="Of scenes that were made, or filmed.")


def question_text(item: Item, order: tuple[int, ...] | None = None) -> str:
    """The question with its options. `order` says which option, counted from 0, stands at each place."""
    places = range(len(item.options)) if order is None else order
    between = [item.options[place].text for place in places]
    return item.question[0] + "".join(option + part for option, part in zip(between, item.question[1:], strict=True))


def listed_wording(question: str) -> Wording | None:
    """The parts of a question around the options that it lists, and these; None if it lists none.

    The letters and all words between the options stay where they are.
    """
    listed = split_options(question)
    if not listed.options or len(listed.places) != len(listed.options):
        return None
    edges = [0, *(edge for place in listed.places for edge in place), len(question)]
    parts = tuple(question[begin:end] for begin, end in zip(edges[::2], edges[1::2], strict=True))
    # As it stands there: a text may go over several lines.
    options = tuple(
        AnswerOption(letter=letter, text=question[begin:end])
        for (letter, _), (begin, end) in zip(listed.options, listed.places, strict=True)
    )
    return parts, options


def appended_wording(question: str, options: Sequence[str]) -> Wording:
    """The same for a question with separate options: they are put below it, a line each, with letters."""
    letters = LETTERS[: len(options)]
    heads = [f"\n({letter}) " for letter in letters]
    parts = (f"{question}\n{heads[0]}", *heads[1:], "")
    return parts, tuple(AnswerOption(letter=letter, text=text) for letter, text in zip(letters, options, strict=True))


class Pictures(DiskArtifacts):
    """A folder of pictures, by their digests. The same bytes are kept once."""

    def add(self, data: bytes) -> str:
        """Keeps a picture; returns its digest. Raises the errors of `decode`."""
        if not self.has(hashlib.sha256(data).hexdigest()):
            decode(data)
        return self.add_made(data)

    def has(self, digest: str) -> bool:
        """Whether a picture is kept."""
        with suppress(ArtifactNotFound):
            return bool(self.get(digest))
        return False

    def add_made(self, data: bytes) -> str:
        """The same for a picture that the service made."""
        return self.put(data, media_type_of(data) or "image/png").sha256

    def path(self, digest: str) -> Path:
        """The file of a picture. Raises `ArtifactNotFound`."""
        with self.local_file(digest) as path:
            return path


class Observation(Record):
    """One question, asked in one arm, in one repeat. Letters are those of the data's order, whatever was shown."""

    item: str
    task: Task
    level: str
    scene: str
    arm: str
    repeat: int = Field(ge=1)
    options: tuple[str, ...] = Field(description="Letters of the data's order in the order in which they were shown.")
    truth: str = Field(description="Letter of the right option.")
    abstain: str | None = Field(description="Letter of the option that says that it is not sure.")
    reply: str | None = Field(default=None, description="As it came; null where the question failed.")
    read: str | None = Field(default=None, description="The letter that the reply chooses; null: unreadable.")
    read_as_paper: str | None = Field(default=None, description="The letter that the paper's rules read in it.")
    calls: int = Field(default=0, description="Of the multimodal LLM, those of the imagination included.")
    input_tokens: int = 0
    output_tokens: int = 0
    seconds: float = Field(default=0.0, description="For simulations and replies; cached results take less.")
    imaginations: int = Field(default=0, description="Simulations that the reply rests on.")
    refusal: str | None = Field(default=None, description="Code of the problem for which nothing was imagined.")
    frames: tuple[Sha256, ...] = Field(default=(), description="Pictures shown beside the image, in their order.")
    overlay: Sha256 | None = None
    probability: float | None = Field(default=None, description="That it happens, by the simulation, if it tells.")
    happens: bool | None = Field(default=None, description="Whether it does, by the truth; null: not a yes or no.")
    event_shown: bool | None = Field(default=None, description="Whether a frame shows when it happens, if simulated.")
    path_error: float | None = Field(default=None, description="Mean error of the path shown, by the image's width.")
    model: str | None = Field(default=None, description="What replied, as its provider names it.")
    failure: str | None = Field(default=None, description="Why there is no reply; such a question counts nowhere.")

    @property
    def right(self) -> bool:
        """Whether the reply chooses the right option."""
        return self.read == self.truth

    @property
    def abstained(self) -> bool:
        """Whether the reply chooses the option that says that it is not sure."""
        return self.read is not None and self.read == self.abstain

    @property
    def unreadable(self) -> bool:
        """Whether there is a reply, and no option could be read in it."""
        return self.failure is None and self.read is None

    @property
    def simulation_right(self) -> bool | None:
        """Whether what the simulation finds likelier is what happens; None if one of the two is not known."""
        if self.probability is None or self.happens is None:
            return None
        return (self.probability >= 0.5) == self.happens
