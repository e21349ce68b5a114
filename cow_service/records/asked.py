"""What a question asks of the world, taken out of its words."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cow_service.records.base import Record

AskedRelation = Literal["touches", "covers", "covered"]
AskedForm = Literal["whether", "which-first", "when", "how-many"]


class Asked(Record):
    """The event that a question asks about, and what it wants to know of it."""

    form: AskedForm = "whether"
    relation: AskedRelation = Field(
        description="`touches`: the mover hits it or lands on it; `covers`: the mover hides it; `covered`: the mover "
        "is hidden by it."
    )
    target: str | None = Field(default=None, description="The thing asked about in the question's words; null: any.")
    negated: bool = Field(default=False, description="Asked is that it does not happen: to miss, to stay visible.")
