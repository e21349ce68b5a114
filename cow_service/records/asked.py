"""What a question asks of the world, taken out of its words."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cow_service.records.base import Record

AskedRelation = Literal["touches", "covers", "covered", "inside", "tips", "moves", "leaves", "lands"]
AskedForm = Literal["whether", "which-first", "when", "how-many", "where", "what-happens", "changes"]


class Asked(Record):
    """The event that a question asks about, and what it wants to know of it."""

    form: AskedForm = "whether"
    relation: AskedRelation = Field(
        description="`touches`: the subject hits it or lands on it; `covers`: the subject hides it; `covered`: the "
        "subject is hidden by it; `inside`: the subject fits or ends up in it; `tips`: the target is knocked over; "
        "`moves`: the target is set in motion; `leaves`: the subject leaves the image; `lands`: the subject "
        "comes down on the floor."
    )
    subject: str | None = Field(
        default=None, description="Who does it, in the question's words, where that is not the mover; null: the mover."
    )
    target: str | None = Field(default=None, description="The thing asked about in the question's words; null: any.")
    negated: bool = Field(default=False, description="Asked is that it does not happen: to miss, to stay visible.")
    among: tuple[str, ...] = Field(
        default=(),
        description="The things that are meant where the question names several, or things of a kind; empty: any.",
    )
    every: bool = Field(default=False, description="It counts only where it happens with each of `among`.")
    partly: bool = Field(default=False, description="Of `covers` and `covered`: it counts where any part is hidden.")
    within: float | None = Field(
        default=None, gt=0, description="How long it may take to happen, s; null: as long as the clip."
    )
