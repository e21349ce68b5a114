"""Where an object is, and what is said of it: the mover, and the others."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator, model_validator

from cow_service.records import Asked, BBox, InterventionKind, ObjectRole, PlaceRelation, Record, Shape
from cow_service.requests.values import Finite, MaskRef, Words

MAX_OBJECTS = 64

ObjectWords = Annotated[Words, Field(min_length=1, max_length=200)]


class PlaceRequest(Record):
    """An object's place in the image, and what the caller knows of it beside. What is left out is read or assumed."""

    bbox: tuple[Finite, Finite, Finite, Finite] | None = Field(default=None, description="[x0, y0, x1, y1], px.")
    point: tuple[Finite, Finite] | None = Field(
        default=None, description="[x, y], px, on the object: its outline is cut from the image around it."
    )
    mask: MaskRef | None = Field(
        default=None, description="PNG of the upright image's size, white where the object is and black elsewhere."
    )
    shape: Shape | None = None
    size: Annotated[Finite, Field(ge=1e-4, le=1000)] | None = Field(default=None, description="Its longest side, m.")
    stands_on: ObjectWords | None = Field(default=None, description="`floor`, `air`, or an object in words.")

    @model_validator(mode="after")
    def _one_place(self) -> PlaceRequest:
        if (self.bbox is not None) + (self.point is not None) + (self.mask is not None) != 1:
            raise ValueError("give either `bbox` or `point`, or instead of both a `mask`")
        return self

    @field_validator("bbox")
    @classmethod
    def _has_area(cls, bbox: BBox | None) -> BBox | None:
        if bbox is not None and (bbox[2] - bbox[0] < 2 or bbox[3] - bbox[1] < 2):
            raise ValueError(f"[x0, y0, x1, y1] must span at least 2 px each way, got {list(bbox)}")
        return bbox


class GroundingRequest(PlaceRequest):
    """Skips stage 1: the object that moves, by its box, its mask, or a point on it."""

    object: ObjectWords | None = None


class ObjectRequest(PlaceRequest):
    """Another object of the image, by its box, its mask, or a point on it."""

    object: ObjectWords
    role: ObjectRole = Field(default="target", description="target: the question asks about it; obstacle: it is there.")


class AskedRequest(Asked):
    """What the question wants to know. Objects are named as in `objects`, or as the question names them."""

    subject: ObjectWords | None = Field(default=None, description="Who does it; null: the object that moves.")
    target: ObjectWords | None = Field(default=None, description="The thing asked about; null: any.")
    among: tuple[ObjectWords, ...] = Field(
        default=(), max_length=MAX_OBJECTS, description="The things that are meant where there are several; empty: any."
    )
    within: Annotated[Finite, Field(gt=0, le=3600)] | None = Field(
        default=None, description="How long it may take to happen, s; null: as long as the clip."
    )


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
