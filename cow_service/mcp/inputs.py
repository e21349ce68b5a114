"""What the tools take: flat, because models fill in flat arguments best. The server checks what it is given."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from cow_service.errors import FieldError, InvalidRequest, pointer_part
from cow_service.records import FramePolicy, Law, MotionKind, PlaceRelation, Until


def _list_from_json(value: Any) -> Any:
    """Some clients write a list as a string of JSON."""
    if isinstance(value, str) and value.lstrip().startswith("["):
        try:
            return json.loads(value)
        except ValueError:
            return value
    return value


FromJson = BeforeValidator(_list_from_json)
Number = Annotated[float, Field(allow_inf_nan=False)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Box = Annotated[list[Number], Field(min_length=4, max_length=4)]


class NamedBox(BaseModel):
    """A thing and where it is."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    object: str = Field(description="In words ('blue mug').")
    bbox: Box = Field(description="[x0, y0, x1, y1], pixels.")


class PlaceInput(BaseModel):
    """A thing that is put somewhere."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    object: str = Field(description="In words ('apple').")
    relation: PlaceRelation
    targets: list[str] = Field(description="What it is put to: one thing, or two for `between`.", max_length=2)


class ToolInput(BaseModel):
    """Arguments of either tool."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    image: str
    question: str = Field(
        description="What if? In English, naming the thing that moves and how it moves: 'If the red ball moves to the "
        "left, will it hit the vase?', 'If the cup falls, what does it land on?'"
    )
    object: str | None = Field(
        default=None, description="What moves, in words ('red ball'). Only together with `bbox` or `point`."
    )
    bbox: Annotated[Box | None, FromJson] = Field(
        default=None,
        description="Box of the thing that moves, [x0, y0, x1, y1] in pixels of the image (upright, x right, y down). "
        "Give it, or `point`, where the thing is hard to find by its name.",
    )
    point: Annotated[Pair | None, FromJson] = Field(
        default=None, description="Instead of `bbox`: a point on the thing, [x, y], pixels."
    )
    direction: Annotated[Pair | None, FromJson] = Field(
        default=None,
        description="Where it moves, [dx, dy] in the image, x right, y down, any length: [-1, 0] is to the left. "
        "By default it is read from the question and from arrows drawn in the image.",
    )
    motion_kind: MotionKind | None = Field(
        default=None,
        description="linear: straight on (with `direction`); projectile: thrown, with gravity (with `direction`); "
        "fall: dropped; static: stays. By default it is read from the question.",
    )
    speed: Number | None = Field(
        default=None, description="Pixels per second. By default 0.26 image widths per second."
    )
    distance: Number | None = Field(default=None, description="Pixels, after which it is stopped.")
    duration: Number | None = Field(default=None, description="Seconds, after which it is stopped.")
    until: Until | None = Field(default=None, description="contact: it is stopped where it first meets something.")
    remove: Annotated[list[str] | None, FromJson] = Field(
        default=None, description="Things that are taken away before anything moves, in words ('vase')."
    )
    place: Annotated[list[PlaceInput] | None, FromJson] = Field(
        default=None, description="Things that are put somewhere: before anything else moves, or as all that happens."
    )
    law: Law | None = Field(
        default=None,
        description="contact (the default): it bounces, pushes, rolls, comes to rest; ballistic: through everything.",
    )
    objects: Annotated[list[NamedBox] | None, FromJson] = Field(
        default=None,
        description="Other things that matter and where they are, as far as they are known: they are hard to find in a "
        "photograph.",
    )
    num_frames: int | None = Field(
        default=None, description="Frames of the clip, 16 a second. By default 81: five seconds."
    )
    seed: int | None = Field(default=None, description="For generators that draw random numbers.")
    frames_policy: FramePolicy | None = None
    frames_count: int | None = Field(default=None, description="How many pictures to return; by default 3.")
    generator: str | None = Field(
        default=None, description="Who makes the frames, by name; by default the server's choice."
    )
    reader: str | None = Field(
        default=None, description="Who looks at the image, by name; by default the server's choice."
    )

    def request_fields(self) -> dict[str, Any]:
        """The fields of the service's request beside image and question."""
        grounding = _given(object=self.object, bbox=self.bbox, point=self.point)
        names = ("direction", "speed", "distance", "duration", "until", "law")
        motion = _given(kind=self.motion_kind, **{name: getattr(self, name) for name in names})
        frames = _given(policy=self.frames_policy, count=self.frames_count)
        return _given(
            grounding=grounding or None,
            motion=motion or None,
            frames=frames or None,
            objects=None if self.objects is None else [thing.model_dump() for thing in self.objects],
            interventions=self._interventions() or None,
            num_frames=self.num_frames,
            seed=self.seed,
            generator=self.generator,
            reader=self.reader,
        )

    def _interventions(self) -> list[dict[str, Any]]:
        removed = [{"kind": "remove", "object": name} for name in self.remove or ()]
        return removed + [{"kind": "place", **placed.model_dump()} for placed in self.place or ()]


class SimulateInput(ToolInput):
    """Arguments of `simulate`: the pictures are for the caller to look at, and the video may be wanted."""

    frames_policy: FramePolicy | None = Field(
        default="events",
        description="events: where it meets something, and on the way; uniform: evenly over the clip; initial: the "
        "first moments.",
    )
    video: bool | None = Field(default=False, description="Make an mp4 of the whole clip, too.")

    def request_fields(self) -> dict[str, Any]:
        """The same, and whether a video is wanted."""
        return super().request_fields() | {"video": bool(self.video)}


class AnswerInput(ToolInput):
    """Arguments of `answer`."""

    options: Annotated[list[str] | None, FromJson] = Field(
        default=None,
        description="Answers to choose from, lettered A, B, C... By default those that the question lists, as in "
        "'(A) Yes (B) No (C) Not sure'; without any the answer is in words.",
    )
    votes: int | None = Field(
        default=None, description="Ask so often and take the most frequent answer; by default 1, at most 32."
    )
    imagine: Literal["always", "auto", "never"] | None = Field(
        default=None,
        description="always (the default); never: answer from the image alone; auto: imagine only where the first "
        "answers from the image alone disagree, or are not sure.",
    )
    imagine_votes: int | None = Field(
        default=None, description="With `imagine` auto: how often to ask first; by default 3."
    )
    imagine_threshold: Number | None = Field(
        default=None,
        description="With `imagine` auto: the share of those votes that must agree for nothing to be imagined; by "
        "default 1.",
    )
    baseline: bool | None = Field(default=None, description="Answer without imagined frames, too, for comparison.")
    frames_policy: FramePolicy | None = Field(
        default=None,
        description="Which frames the answer is reasoned on: initial (the default): the first moments; events: where "
        "it meets something; uniform: evenly over the clip.",
    )

    def request_fields(self) -> dict[str, Any]:
        """The same, and how to answer."""
        names = ("options", "votes", "imagine", "imagine_votes", "imagine_threshold", "baseline")
        return super().request_fields() | _given(**{name: getattr(self, name) for name in names})


Input = TypeVar("Input", bound=ToolInput)


def parsed(model: type[Input], arguments: dict[str, Any]) -> Input:
    """The arguments of a call. Raises `InvalidRequest` that points at each wrong one."""
    try:
        return model.model_validate(arguments)
    except ValidationError as error:
        wrong = tuple(
            FieldError("".join(f"/{pointer_part(part)}" for part in item["loc"]), _detail(item, model))
            for item in error.errors(include_url=False)
        )
        raise InvalidRequest("The arguments of the tool are not valid.", errors=wrong) from error


def input_schema(model: type[ToolInput], image: str) -> dict[str, Any]:
    """The JSON schema of a tool's arguments; `image` says how an image may be given."""
    schema = model.model_json_schema()
    del schema["description"]  # the tool has one
    schema["properties"]["image"]["description"] = image
    return lean({**schema, "properties": {name: _plain(value) for name, value in schema["properties"].items()}})


def _plain(schema: dict[str, Any]) -> dict[str, Any]:
    """Without null: it is taken, since some clients send it for what they leave out, but nobody has to know."""
    given = [one for one in schema.get("anyOf", ()) if one != {"type": "null"}]
    return {**{key: value for key, value in schema.items() if key != "anyOf"}, **given[0]} if given else schema


def lean(schema: Any) -> Any:
    """A JSON schema without what costs a model's attention and says nothing: titles, and defaults of null."""
    if isinstance(schema, list):
        return [lean(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    return {
        name: {key: lean(part) for key, part in value.items()} if name in ("properties", "$defs") else lean(value)
        for name, value in schema.items()
        if not (name == "title" and isinstance(value, str)) and not (name == "default" and value is None)
    }


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _detail(item: Any, model: type[ToolInput]) -> str:
    if item["type"] == "extra_forbidden":
        return f"there is no such argument; there are: {', '.join(model.model_fields)}"
    if item["type"] == "missing":
        return "is needed"
    return str(item["msg"])[:1].lower() + str(item["msg"])[1:]


ToolName = Literal["simulate", "answer"]
INPUTS: dict[ToolName, type[ToolInput]] = {"simulate": SimulateInput, "answer": AnswerInput}
