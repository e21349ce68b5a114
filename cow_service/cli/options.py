"""Options that `simulate` and `answer` share, and the request that they make."""

from __future__ import annotations

import json
from collections.abc import Callable
from enum import StrEnum
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from cow_service.cli.errors import FileUnreadable
from cow_service.cli.interventions import intervention_fields
from cow_service.errors import InvalidRequest


class Format(StrEnum):
    """What a clip can be made into, beside the mp4."""

    GIF = "gif"
    WEBP = "webp"
    SHEET = "sheet"


Policy = Literal["initial", "uniform", "events"]
Kind = Literal["linear", "projectile", "fall", "static"]
Law = Literal["contact", "ballistic"]
Until = Literal["contact"]
Image = Annotated[
    Path, typer.Argument(metavar="IMAGE", help="PNG, JPEG or WebP.", exists=True, dir_okay=False, readable=True)
]
Question = Annotated[
    str,
    typer.Argument(metavar="QUESTION", help='For example "If the red ball moves to the left, will it hit the vase?"'),
]


def request_body(
    point: Annotated[str | None, typer.Option(help="X,Y of a point on the object that moves, px.")] = None,
    box: Annotated[str | None, typer.Option(help="X0,Y0,X1,Y1 of the object that moves, px.")] = None,
    name: Annotated[
        str | None, typer.Option("--object", help="What the object is called, with --point or --box.")
    ] = None,
    direction: Annotated[str | None, typer.Option(help="DX,DY of the motion, px, x right, y down.")] = None,
    kind: Annotated[
        Kind, typer.Option(help="Kind of motion, with --direction (or alone for fall and static).")
    ] = "linear",
    speed: Annotated[float | None, typer.Option(help="px/s.", show_default="0.26 widths/s")] = None,
    distance: Annotated[float | None, typer.Option(help="px, after which it is stopped.")] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds, after which it is stopped.")] = None,
    until: Annotated[Until | None, typer.Option(help="contact: stopped where it first meets something.")] = None,
    remove: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Taken away before the motion; may be repeated.")
    ] = None,
    put: Annotated[
        list[str] | None,
        typer.Option("--place", metavar="THING RELATION THING", help='Such as "apple into bowl"; may be repeated.'),
    ] = None,
    law: Annotated[
        Law | None,
        typer.Option(help="contact: floor, bounces, pushes; ballistic: through everything.", show_default="contact"),
    ] = None,
    other: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=X0,Y0,X1,Y1",
            help='Another object and its box (or X,Y of a point on it), such as "red mug=10,20,90,140"; '
            "may be repeated.",
        ),
    ] = None,
    ensemble: Annotated[int, typer.Option(help="How many worlds the probabilities are counted in; 0: none.")] = 50,
    trajectory: Annotated[
        Path | None,
        typer.Option(
            help="JSON with the `trajectory` of a request, as `cow tracks import` makes it.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    reader: Annotated[str | None, typer.Option(help="Who looks at the image.", show_default="COW_READER")] = None,
    generator: Annotated[str | None, typer.Option(help="Who makes the frames.", show_default="COW_GENERATOR")] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="An option of the generator, such as steps=20; may be repeated."),
    ] = None,
    num_frames: Annotated[int, typer.Option(help="Frames of the clip.")] = 81,
    fps: Annotated[float, typer.Option(help="Frames per second.")] = 16,
    seed: Annotated[
        int | None, typer.Option(help="For what draws random numbers.", show_default="0, and none for an MLLM")
    ] = None,
    frames: Annotated[Policy, typer.Option(help="Which frames to keep as pictures.")] = "events",
    count: Annotated[int, typer.Option(help="How many of them.")] = 3,
    max_side: Annotated[int, typer.Option(help="Their longest side, px; 0 for the clip's own size.")] = 512,
) -> dict[str, Any]:
    """The request's body, as far as both commands have it.

    Raises `InvalidRequest` naming the option that cannot be read.
    """
    body: dict[str, Any] = {
        "reader": reader,
        "generator": generator,
        "generator_options": dict(map(_name_and_value, option or [])),
        "num_frames": num_frames,
        "fps": fps,
        "seed": seed,
        "ensemble": ensemble,
        "objects": [_other(text) for text in other or []],
        "interventions": intervention_fields(remove or [], put or []),
        "frames": {"policy": frames, "count": count, "max_side": max_side or None},
    }
    if point is not None or box is not None:
        body["grounding"] = {
            "object": name,
            "point": None if point is None else _numbers("--point", point, 2),
            "bbox": None if box is None else _numbers("--box", box, 4),
        }
    elif name is not None and trajectory is None:
        raise InvalidRequest("--object goes with --point, --box or --trajectory; else the question names the object.")
    if direction is not None or kind in ("fall", "static"):
        body["motion"] = {
            "direction": None if direction is None else _numbers("--direction", direction, 2),
            "kind": kind,
        }
    elif kind != "linear":
        raise InvalidRequest("--kind goes with --direction; without it the motion is read from the question.")
    said = {"speed": speed, "distance": distance, "duration": duration, "until": until, "law": law}
    if any(value is not None for value in said.values()):
        given = {name: value for name, value in said.items() if value is not None}
        body["motion"] = {**body.get("motion", {}), **given}
    if trajectory is not None:
        body["trajectory"] = path = _json(trajectory)
        if name is not None and "grounding" not in body and isinstance(path, dict):
            first_point = next(iter(cast("dict[str, Any]", path).get("points", [])), None)
            body["grounding"] = {"object": name, "point": first_point}
    return body


def with_request_options(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options of `request_body` in place of its last parameter, `request`."""
    shared = signature(request_body, eval_str=True).parameters
    own = [parameter for name, parameter in signature(command, eval_str=True).parameters.items() if name != "request"]

    @wraps(command)
    def with_options(**given: Any) -> None:
        command(request=request_body(**{name: given.pop(name) for name in shared}), **given)

    keyword_only = [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in (*own, *shared.values())]
    cast("Any", with_options).__signature__ = signature(command).replace(parameters=keyword_only)
    return with_options


def read_file(path: Path) -> bytes:
    """The bytes of a file of the command line. Raises `FileUnreadable`."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileUnreadable(f"'{path}' cannot be read: {error.strerror}. Choose another file.") from error


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.replace(" ", "").split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise InvalidRequest(
            f"{option} takes {count} numbers with commas between, such as {','.join(['10'] * count)}; got '{text}'."
        )
    return values


def _other(text: str) -> dict[str, object]:
    """Another object of the image, by its box or by a point on it."""
    name, _, place = text.rpartition("=")
    if not name.strip():
        raise InvalidRequest(f"--other takes NAME=X0,Y0,X1,Y1 or NAME=X,Y; got '{text}'.")
    is_point = place.count(",") == 1
    field, count = ("point", 2) if is_point else ("bbox", 4)
    return {"object": name.strip(), field: _numbers("--other NAME=", place, count)}


def _name_and_value(given: str) -> tuple[str, object]:
    """An option of the generator; a value that is no JSON is text."""
    name, equals, text = given.partition("=")
    if not name or not equals:
        raise InvalidRequest(f"--option takes NAME=VALUE, such as steps=20; got '{given}'.")
    try:
        return name, json.loads(text)
    except ValueError:
        return name, text


def _json(path: Path) -> object:
    try:
        return json.loads(read_file(path))
    except ValueError as error:
        raise InvalidRequest(f"{path.name} is not JSON: {error}.") from error
