"""The design of an evaluation: what is shown in each arm, and which arms are compared.

An arm is a point of a few factors: the content shown beside the question's image, which frames of it, how many votes,
and whether the answers from the image alone decide if anything is shown. Arms that differ in their content alone tell
what that content is worth.
"""

from collections.abc import Sequence
from typing import Any, Literal, Self, get_args

from pydantic import Field, ValidationError, model_validator

from cow_service.errors import InvalidRequest
from cow_service.evals.items import Ask, Item
from cow_service.readers.mllm.contents import PLACEBOS, Content
from cow_service.records import Record
from cow_service.records.results import FramePolicy

GATE_VOTES = 3  # replies from the image alone
MOMENTS: tuple[FramePolicy, ...] = get_args(FramePolicy)
OF_FRAMES = ("frames", "count", "size")
Order = Literal["shuffled", "data"]


class Arm(Record):
    """What is shown with the image, and how often the question is asked."""

    content: Content = "none"
    frames: FramePolicy = Field(default="events", description="Which frames.")
    count: int = Field(default=3, ge=1, le=64, description="How many.")
    size: int = Field(default=512, ge=16, le=8192, description="Their longest side, px.")
    votes: int = Field(default=1, ge=1, le=16, description="Replies, each with a simulation of its own seed.")
    gate: bool = Field(default=False, description="Shown only where answers from the image alone do not agree.")
    image: bool = Field(default=True, description="The image is shown beside the frames.")

    @model_validator(mode="after")
    def _shows_what_it_chooses(self) -> Self:
        chosen = [name for name in OF_FRAMES if getattr(self, name) != type(self).model_fields[name].default]
        if chosen and not self.shows_frames:
            raise ValueError(f"{self.content} shows no frames: leave {' and '.join(chosen)} out")
        if not self.image and not self.shows_frames:
            raise ValueError(f"{self.content} shows no frames, so it needs the image")
        return self

    @property
    def name(self) -> str:
        """The shortest name that `arm_of` reads as this arm."""
        same = {name: arm for name, arm in NAMED.items() if arm.content == self.content and self.image <= arm.image}
        same = {name: arm for name, arm in same.items() if arm.image == self.image} or same
        base = next((name for name, arm in same.items() if arm.gate == self.gate), next(iter(same)))
        own, parts = same[base], [base]
        parts += [self.frames] if self.frames != own.frames else []
        parts += [f"count-{self.count}"] if self.count != own.count else []
        parts += [f"size-{self.size}"] if self.size != own.size else []
        parts += [f"vote-{self.votes}"] if self.votes != own.votes else []
        parts += ["gate"] if self.gate != own.gate else []
        parts += ["no-image"] if self.image != own.image else []
        return ":".join(parts)

    @property
    def shows_frames(self) -> bool:
        """Whether there are frames to choose."""
        return self.content not in ("none", "text")

    @property
    def asks(self) -> tuple[Ask, ...]:
        """The ways to ask in which there is such an arm."""
        by_service = self.content in ("none", "simulated") and self.image and not (self.gate and self.content == "none")
        return ("prompt", "answer") if by_service else ("prompt",)

    @property
    def frames_request(self) -> dict[str, Any]:
        """The field `frames` of a request."""
        return {"policy": self.frames, "count": self.count, "max_side": self.size}

    def with_content(self, content: Content) -> "Arm":
        """The arm that differs from this one in the content alone."""
        kept = {} if content == "none" else {name: getattr(self, name) for name in OF_FRAMES}
        return Arm(content=content, votes=self.votes, gate=self.gate, image=content == "none" or self.image, **kept)


# An arm takes the first name that says its content.
NAMED: dict[str, Arm] = {
    "never": Arm(),
    "gate": Arm(gate=True),
    "always": Arm(content="simulated"),
    "auto": Arm(content="simulated", gate=True),
    "placebo-still": Arm(content="still"),
    "placebo-direction": Arm(content="wrong-direction"),
    "placebo-item": Arm(content="other-item"),
    "encounters": Arm(content="text"),
    "frames-only": Arm(content="simulated", image=False),
    "oracle": Arm(content="true"),
}
BASELINE = "never"
# What a suffix sets: a factor and its value, or a factor whose value follows behind a hyphen.
_WORDS: dict[str, tuple[str, Any]] = {
    **{moment: ("frames", moment) for moment in MOMENTS}, "gate": ("gate", True), "no-image": ("image", False),
}  # fmt: skip
_NUMBERS = {"count": "count", "size": "size", "vote": "votes"}


class Preset(Record):
    """Arms that belong together, and how they are asked."""

    arms: tuple[str, ...]
    repeats: int = 1
    order: Order = "shuffled"  # of the options


_MATCHED = ("never", "always", "placebo-still", "placebo-direction", "placebo-item")
_VOTED = ("never:vote-3", "always:vote-3", "gate", "auto")
_CONTROLS = (*_MATCHED, "always:initial", "placebo-still:initial", "encounters", *_VOTED)
PRESETS: dict[str, Preset] = {
    "default": Preset(arms=_MATCHED),
    # Frames 1, 3 and 5 of 512 px, options as the data has them, five repeats; of COW the paper made three.
    "paper": Preset(arms=("never", "always:initial"), repeats=5, order="data"),
    "controls": Preset(arms=_CONTROLS),
}


def arm_of(text: str) -> Arm:
    """The arm of a name such as `always:initial:vote-3`. Raises `InvalidRequest` for what is none."""
    base, *suffixes = text.strip().split(":")
    if base not in NAMED:
        raise InvalidRequest(
            f"There is no arm '{text}': arms are {', '.join(NAMED)}, each with suffixes such as :initial or :vote-3."
        )
    factors: dict[str, Any] = NAMED[base].model_dump(exclude_defaults=True)
    for suffix in suffixes:
        name, _, value = suffix.partition("-")
        factor, value = _WORDS.get(suffix, (_NUMBERS.get(name), value))
        if factor is None:
            known = ", ".join(f":{each}" for each in (*_WORDS, *(f"{number}-N" for number in _NUMBERS)))
            raise InvalidRequest(f"The arm '{text}' has an unknown suffix ':{suffix}': there are {known}.")
        if factor in factors:
            raise InvalidRequest(f"The arm '{text}' sets {factor} twice: keep one.")
        factors[factor] = value
    try:
        return Arm.model_validate(factors)
    except ValidationError as error:
        first = error.errors()[0]
        why = ": ".join((*map(str, first["loc"]), first["msg"].removeprefix("Value error, ")))
        raise InvalidRequest(f"The arm '{text}' cannot be asked: {why}.") from error


def check_arms(names: Sequence[str], ask: Ask, items: Sequence[Item]) -> tuple[Arm, ...]:
    """The arms of these names. Raises `InvalidRequest` for one that cannot be asked so, or of these items."""
    arms = tuple(dict.fromkeys(map(arm_of, names)))
    if not arms:
        raise InvalidRequest(f"Name at least one arm: {', '.join(NAMED)}.")
    for arm in arms:
        if ask not in arm.asks:
            raise InvalidRequest(
                f"The service's own /answer has no arm '{arm.name}', only never, always and auto, each also with "
                "votes: name a multimodal LLM with --mllm and leave --ask out."
            )
        without = [item for item in items if item.truth is None or not item.truth.is_shown]
        if arm.content == "true" and without:
            raise InvalidRequest(
                f"The arm '{arm.name}' needs the true path, or pictures of what really happens, and {len(without)} of "
                f"{len(items)} items have none, such as {without[0].row}."
            )
        if arm.content == "other-item" and len({item.scene for item in items}) < 2:
            raise InvalidRequest(f"The arm '{arm.name}' shows frames of another scene, and there is only one.")
    return arms


def references(arm: Arm, asked: Sequence[Arm]) -> tuple[Arm, ...]:
    """The arms that an arm is compared with, among those asked: all contrasts of a report.

    The image alone; the image alone with as many calls; and of frames that are meant to tell something, each placebo
    with the same frames and votes.
    """
    wanted = [NAMED[BASELINE], arm.with_content("none")]
    if arm.content in ("simulated", "true"):
        wanted += [arm.with_content(placebo) for placebo in PLACEBOS]
    return tuple(each for each in dict.fromkeys(wanted) if each in asked and each != arm)


def primary(asked: Sequence[Arm]) -> tuple[Arm, tuple[Arm, ...]] | None:
    """The primary question: the first arm of simulated frames that has placebos, and these; None without one."""
    shown = (arm for arm in asked if arm.content == "simulated" and not arm.gate)
    found = ((arm, tuple(each for each in references(arm, asked) if each.content in PLACEBOS)) for arm in shown)
    return next((question for question in found if question[1]), None)
