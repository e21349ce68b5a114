"""What came of each question: one observation per item, arm and repeat, and what is known of the run they belong to."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from cow_service.evals.items import Task
from cow_service.records import Record
from cow_service.records.base import Sha256

Ask = Literal["prompt", "answer"]


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
    seconds: float = Field(
        default=0.0,
        description="For simulations and replies, as if each were asked alone; what is found again takes less.",
    )
    imagining_seconds: float = Field(default=0.0, description="Of those, for simulations.")
    imaginations: int = Field(default=0, description="Simulations that the reply rests on.")
    refusal: str | None = Field(
        default=None, description="Code of the problem for which nothing was imagined where it should have been."
    )
    frames: tuple[Sha256, ...] = Field(default=(), description="Pictures shown beside the image, in their order.")
    overlay: Sha256 | None = None
    probability: float | None = Field(
        default=None, description="That what is asked happens, by the simulation; null where it tells nothing."
    )
    happens: bool | None = Field(default=None, description="Whether it does, by the truth; null: not a yes or no.")
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


class RunInfo(Record):
    """What a folder of results was asked: as much as it takes to ask the same again."""

    format: int = 1
    data: str = Field(description="As it was given.")
    data_digest: Sha256 = Field(description="Of the items, their pictures included.")
    counts: dict[str, int] = Field(description="Items by task and level: `collision L1`.")
    faults: tuple[str, ...] = Field(default=(), description="Rows that were left out, and why.")
    notes: tuple[str, ...] = Field(default=(), description="What was found in the data and worked around, with counts.")
    mllm: str = Field(description="Who answered, as Inspect names it, or `cow/embedded`.")
    ask: Ask
    arms: tuple[str, ...]
    repeats: int = Field(ge=1)
    seed: int
    settings: dict[str, Any] = Field(description="Frames, reader, generator, generation settings.")
    versions: dict[str, str] = Field(description="Of the packages and prompts.")
    rounds: int = Field(default=0, description="How often what had failed was asked again.")
    token: str = Field(default="", description="Random: names the requests and replies of the run.")
    created_at: str = Field(description="RFC 3339, UTC.")

    @property
    def baseline_key(self) -> tuple[Any, ...]:
        """What two runs have in common whose replies may be compared."""
        generation: Any = self.settings.get("generation")
        return self.data_digest, self.mllm, self.ask, self.seed, generation
