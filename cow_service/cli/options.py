"""The options that `simulate` and `answer` share, the request that they make, and how errors are shown."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from enum import StrEnum
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer
from typer.core import TyperGroup

from cow_service.errors import CowError, InvalidRequest

if TYPE_CHECKING:
    from cow_service.client import Client

_GIVE_PLACE = (
    "Here: --point X,Y or --box X0,Y0,X1,Y1 (and --object NAME) for what moves, --other NAME=X0,Y0,X1,Y1 for the rest."
)
HINTS = {  # what an error's remedy asks for as options, by the error's code
    "cannot-ground": _GIVE_PLACE,
    "object-not-found": _GIVE_PLACE,
    "cannot-read-direction": "Here: --direction DX,DY.",
    "generator-unavailable": "Or here: --generator cutout (or COW_GENERATOR=cutout), without GPU and weights.",
}


class FileUnreadable(CowError):
    """A file of the command line cannot be read."""

    code, status = "file-unreadable", 0  # never on the wire


class FolderNotWritable(CowError):
    """The results cannot be written."""

    code, status = "folder-not-writable", 0


COMMANDS = {
    "Ask": ("demo", "simulate", "answer", "batch"),
    "Serve": ("serve", "worker", "mcp", "keys", "migrate"),
    "Look after it": ("doctor", "models"),
    "Measure and convert": ("eval", "tracks"),
}  # of `cow --help`


class Commands(TyperGroup):
    """A group of commands whose errors are a few plain lines on standard error.

    Exit code 1; 2 for bad settings. With `--json` standard output has the problem (RFC 9457).
    """

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """The commands in groups, by what one wants to do."""
        for title, names in COMMANDS.items():
            found = [(name, self.commands[name]) for name in names if name in self.commands]
            rows = [(name, command.get_short_help_str(formatter.width - 14)) for name, command in found]
            with formatter.section(title):
                formatter.write_dl(rows)

    def invoke(self, ctx: Any) -> Any:
        """Runs a command."""
        wants_json = "--json" in ctx.args
        try:
            return super().invoke(ctx)
        except CowError as error:
            if wants_json:
                typer.echo(json.dumps(error.as_problem(), ensure_ascii=False))
            typer.secho(f"{error.code}: {error.title}", fg="red", bold=True, err=True)
            typer.echo(printable(error.detail), err=True)
            if hint := HINTS.get(error.code, error.remedy):
                typer.echo(hint, err=True)
            for field in (field for field in error.errors if field.detail not in error.detail):
                typer.echo(printable(f"  {field.pointer}: {field.detail}"), err=True)
            raise typer.Exit(1) from error
        except typer.BadParameter as error:
            if "is not one of" in error.message:
                kinds = error.message.removeprefix("Value error, ").rstrip(".")
                error.message = f"{kinds}. Choose one of these, or leave the option out."
            raise
        except Exception as error:
            from cow_service.settings import SettingsError  # noqa: PLC0415 - its import would slow down --help

            if not isinstance(error, SettingsError):
                raise
            typer.secho(str(error), fg="red", err=True)
            raise typer.Exit(2) from error


def printable(text: str) -> str:
    """The text without characters that control a terminal: control codes, escapes, marks of writing direction."""
    return "".join(character if character.isprintable() or character == "\n" else "\ufffd" for character in text)


def option(help: str, *names: str, shown: str | None = None, **more: Any) -> Any:
    """The declaration of an option; `shown` is what the help calls its default, where that has no value of its own."""
    return typer.Option(*names, help=help, show_default=shown or True, **more)


def argument(help: str, name: str | None = None, **more: Any) -> Any:
    """The declaration of an argument."""
    return typer.Argument(metavar=name, help=help, **more)


EXISTING: dict[str, Any] = {"exists": True, "dir_okay": False}  # of a path: a file that is there
Image = Annotated[Path, argument("PNG, JPEG or WebP.", "IMAGE", readable=True, **EXISTING)]
Question = Annotated[
    str, argument('For example "If the red ball moves to the left, will it hit the vase?"', "QUESTION")
]
Url = Annotated[str | None, option("The server.", shown="COW_BASE_URL, http://127.0.0.1:8000")]
AsJson = Annotated[bool, option("Print JSON.", "--json")]
Texts = list[str] | None
Policy = Literal["initial", "uniform", "events"]
Kind = Literal["linear", "projectile", "fall", "static"]
Law = Literal["contact", "ballistic"]
Until = Literal["contact"]
Language = Literal["en", "de", "es", "fr", "zh", "ja"]


class Format(StrEnum):
    """What a clip can be made into, beside the mp4. Typer takes no list of a `Literal`."""

    GIF = "gif"
    WEBP = "webp"
    SHEET = "sheet"


# Where an option stands in the request. Typer needs their declarations below before pydantic could be imported: a test
# checks that their defaults are those of the fields.
FIELDS = {
    "point": "grounding/point",
    "box": "grounding/bbox",
    "name": "grounding/object",
    "direction": "motion/direction",
    "kind": "motion/kind",
    "speed": "motion/speed",
    "distance": "motion/distance",
    "duration": "motion/duration",
    "until": "motion/until",
    "law": "motion/law",
    "frames": "frames/policy",
    "count": "frames/count",
    "max_side": "frames/max_side",
}
_NUMBERS = {"point": 2, "box": 4, "direction": 2}  # how many an option takes, with commas between
_SAME_NAME = ("language", "ensemble", "reader", "generator", "num_frames", "fps", "seed")


def request_body(
    point: Annotated[str | None, option("X,Y of a point on the object that moves, px.")] = None,
    box: Annotated[str | None, option("X0,Y0,X1,Y1 of the object that moves, px.")] = None,
    name: Annotated[
        str | None, option("What the object is called, with --point, --box or --trajectory.", "--object")
    ] = None,
    direction: Annotated[str | None, option("DX,DY of the motion, px, x right, y down.")] = None,
    kind: Annotated[
        Kind | None, option("Kind of motion, with --direction (or alone for fall and static).", shown="linear")
    ] = None,
    speed: Annotated[float | None, option("px/s.", shown="0.26 widths/s")] = None,
    distance: Annotated[float | None, option("px, after which it is stopped.")] = None,
    duration: Annotated[float | None, option("Seconds, after which it is stopped.")] = None,
    until: Annotated[Until | None, option("contact: stopped where it first meets something.")] = None,
    remove: Annotated[Texts, option("Taken away before the motion; may be repeated.", metavar="NAME")] = None,
    place: Annotated[
        Texts, option('Such as "apple into bowl"; may be repeated.', metavar="THING RELATION THING")
    ] = None,
    law: Annotated[
        Law | None, option("contact: floor, bounces, pushes; ballistic: through everything.", shown="contact")
    ] = None,
    other: Annotated[
        Texts,
        option(
            'Another object and its box (or X,Y of a point on it), such as "red mug=10,20,90,140"; may be repeated.',
            metavar="NAME=X0,Y0,X1,Y1",
        ),
    ] = None,
    ensemble: Annotated[int, option("How many worlds the probabilities are counted in, at most; 0: none.")] = 50,
    depth: Annotated[Path | None, option("Depth map of the image: a grey PNG with 16 bits.", **EXISTING)] = None,
    depth_scale: Annotated[float | None, option("Metres per unit of the depth map.", shown="not known")] = None,
    trajectory: Annotated[Path | None, option("JSON with the `trajectory` of a request.", **EXISTING)] = None,
    language: Annotated[Language | None, option("Language of answer and story.", shown="en")] = None,
    fields: Annotated[
        str | None,
        option('Other fields of the request: {"camera": {"pitch": 25}}.', "--request", metavar="JSON", shown="none"),
    ] = None,
    reader: Annotated[str | None, option("Who looks at the image.", shown="COW_READER")] = None,
    generator: Annotated[str | None, option("Who makes the frames.", shown="COW_GENERATOR")] = None,
    own: Annotated[
        Texts,
        option("An option of the generator, such as steps=20; may be repeated.", "--option", metavar="NAME=VALUE"),
    ] = None,
    num_frames: Annotated[int, option("Frames of the clip.")] = 81,
    fps: Annotated[float, option("Frames per second.")] = 16,
    seed: Annotated[int | None, option("For what draws random numbers.", shown="0, and none for an MLLM")] = None,
    frames: Annotated[Policy, option("Which frames to keep as pictures.")] = "events",
    count: Annotated[int, option("How many of them.")] = 4,
    max_side: Annotated[int, option("Their longest side, px; 0 for the clip's own size.")] = 512,
) -> dict[str, Any]:
    """The fields of the request that both commands have. Raises `InvalidRequest` naming the option that is wrong."""
    given = locals()
    body: dict[str, Any] = {name: given[name] for name in _SAME_NAME} | {"generator_options": {}}
    for text in own or []:
        own_name, equals, own_value = text.partition("=")
        if not own_name or not equals:
            raise InvalidRequest(f"--option takes NAME=VALUE, such as steps=20; got '{text}'.")
        body["generator_options"][own_name] = own_value
        with suppress(ValueError):  # a value that is no JSON is text
            body["generator_options"][own_name] = json.loads(own_value)
    body["objects"] = [_other_object(text) for text in other or []]
    removed = ({"kind": "remove", "object": thing} for thing in remove or [])
    body["interventions"] = [*removed, *map(_placement, place or [])]
    for option_name, path in FIELDS.items():
        if (value := given[option_name]) is not None:
            record, _, field = path.partition("/")
            if option_name in _NUMBERS:
                value = _numbers(f"--{option_name}", value, _NUMBERS[option_name])
            body.setdefault(record, {})[field] = value
    body["frames"]["max_side"] = max_side or None
    if depth is not None or depth_scale is not None:
        body["depth"] = _depth_map(depth, depth_scale)
    if trajectory is not None:
        body["trajectory"] = object_in(read_file(trajectory), trajectory.name)
    if body.get("grounding", {}).keys() == {"object"}:
        points = body.get("trajectory", {}).get("points")
        if not points:
            raise InvalidRequest(
                "--object goes with --point, --box or --trajectory; else the question names the object."
            )
        body["grounding"]["point"] = points[0]
    more = object_in(fields or "{}", "--request")
    if isinstance(more.get("depth"), dict):  # beside the file of the map, its focal length or deviation
        more["depth"] = body.get("depth", {}) | more["depth"]
    return body | more


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


def open_client(url: str | None) -> Client:
    """A client of the SDK. Raises `InvalidRequest` for what is no address."""
    from cow_service.client import Client  # noqa: PLC0415

    try:
        return Client(url)
    except ValueError as error:
        raise InvalidRequest(f"{error}.") from error


def read_file(path: Path) -> bytes:
    """The bytes of a file of the command line. Raises `FileUnreadable`."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileUnreadable(f"'{path}' cannot be read: {error.strerror}. Choose another file.") from error


@contextmanager
def writable(out: Path) -> Generator[None]:
    """Translates `OSError` to `FolderNotWritable`, which names the folder."""
    try:
        yield
    except OSError as error:
        detail = f"'{out}' cannot be written: {error.strerror}. Choose another place with --out."
        raise FolderNotWritable(detail) from error


def object_in(text: str | bytes, name: str) -> dict[str, Any]:
    """The JSON object that a text is. Raises `InvalidRequest` with the name of the text."""
    try:
        given = json.loads(text)
    except ValueError as error:
        raise InvalidRequest(f'{name} is not JSON: {error}. Give an object: {{"name": value}}.') from error
    if not isinstance(given, dict):
        raise InvalidRequest(f"{name} must be an object, got {type(given).__name__}.")
    return given


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.replace(" ", "").split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        example = {"--direction": "-1,0 for to the left (x right, y down)"}.get(option, "10,20,90,140"[: 4 * count - 3])
        raise InvalidRequest(f"{option} takes {count} numbers with commas between, such as {example}; got '{text}'.")
    return values


def _depth_map(path: Path | None, scale: float | None) -> dict[str, object]:
    """The `depth` of a request, by the file of a map."""
    if path is None:
        raise InvalidRequest("--depth-scale goes with --depth.")
    return {"map": f"data:image/png;base64,{base64.b64encode(read_file(path)).decode()}", "scale": scale}


def _placement(text: str) -> dict[str, object]:
    """What `--place` says, as an intervention."""
    from cow_service.narration.words import PREPOSITIONS, RELATION_WORDS  # noqa: PLC0415 - it imports pydantic

    words = "|".join(sorted(RELATION_WORDS, key=len, reverse=True))  # "in front of" before "in"
    pattern = rf"\s*(?P<object>.+?)\s+(?P<relation>{words})\s+(?P<targets>.+?)\s*"
    found = re.fullmatch(pattern, text, re.IGNORECASE)
    if found is None:
        raise InvalidRequest(
            f"--place takes a thing, a relation ({', '.join(PREPOSITIONS)}) and what it is put to, such as "
            f"'apple into bowl' or 'cube between mug and vase'; got '{text}'."
        )
    relation = RELATION_WORDS[found["relation"].lower()]
    targets = re.split(r"\s+and\s+", found["targets"]) if relation == "between" else [found["targets"]]
    return {"kind": "place", "object": found["object"], "relation": relation, "targets": targets}


def _other_object(text: str) -> dict[str, object]:
    """Another object of the image, by its box or by a point on it."""
    name, _, place = text.rpartition("=")
    if not name.strip():
        raise InvalidRequest(f"--other takes NAME=X0,Y0,X1,Y1 or NAME=X,Y; got '{text}'.")
    is_point = place.count(",") == 1
    field, count = ("point", 2) if is_point else ("bbox", 4)
    return {"object": name.strip(), field: _numbers("--other NAME=", place, count)}
