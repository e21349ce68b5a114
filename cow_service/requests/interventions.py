"""What is taken away or put in before the motion."""

from __future__ import annotations

from pydantic import Field, model_validator

from cow_service.records import InterventionKind, PlaceRelation, Record
from cow_service.requests.places import ObjectWords


class InterventionRequest(Record):
    """A change of the scene before anything moves. Its objects are named as in `objects`, or in words to look for."""

    kind: InterventionKind
    object: ObjectWords
    relation: PlaceRelation | None = Field(default=None, description="Of `place`: how it is put to the `targets`.")
    targets: tuple[ObjectWords, ...] = Field(
        default=(), max_length=2, description="Of `place`: what it is put into, onto or beside; two for `between`."
    )

    @model_validator(mode="after")
    def _is_whole(self) -> InterventionRequest:
        if self.kind == "remove" and (self.relation is not None or self.targets):
            raise ValueError("`remove` takes an `object` alone; `relation` and `targets` belong to `place`")
        if self.kind == "place":
            wanted = 2 if self.relation == "between" else 1
            if self.relation is None or len(self.targets) != wanted:
                raise ValueError(f"`place` needs a `relation` and {wanted} of `targets`")
            if len({" ".join(name.lower().split()) for name in (self.object, *self.targets)}) <= wanted:
                raise ValueError("`object` and `targets` must be different things")
        return self
