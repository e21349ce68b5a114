"""The options that `simulate` and `answer` share, the request that they build, and how help and errors are shown."""

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
from typer.core import TyperCommand, TyperGroup

from cow_service.errors import CowError, InvalidRequest

if TYPE_CHECKING:
    from cow_service.client import Client

_GIVE_PLACE = (
    "Use --point X,Y or --box X0,Y0,X1,Y1 (and --object NAME) for the moving object, and "
    "--other NAME=X0,Y0,X1,Y1 for the other objects."
)
HINTS = {  # the remedy in terms of options, by the error's code
    **dict.fromkeys(("cannot-ground", "object-not-found"), _GIVE_PLACE),
    "cannot-read-direction": "Use --direction DX,DY (x right, y down).",
    "generator-unavailable": "Or use --generator cutout (or COW_GENERATOR=cutout), which needs no GPU and no weights.",
}


class FileUnreadable(CowError):
    """A file named on the command line cannot be read."""

    code, status = "file-unreadable", 0  # never in a response


class NotInstalled(CowError):
    """A command needs Python packages that are not installed."""

    code, status = "not-installed", 0


class FolderNotWritable(CowError):
    """The results cannot be written."""

    code, status = "folder-not-writable", 0


COMMANDS = {
    "Ask": ("demo", "simulate", "answer", "batch"),
    "Serve": ("serve", "worker", "mcp", "keys", "migrate"),
    "Maintain": ("doctor", "models"),
    "Measure and convert": ("eval", "tracks"),
}  # of `cow --help`
GROUPS = {
    "The moving object": ("point", "box", "name"),
    "Its motion": ("direction", "kind", "speed", "distance", "duration", "until", "law", "trajectory"),
    "The scene": ("other", "remove", "place", "depth", "depth_scale"),
    "The simulation": ("ensemble", "reader", "language", "seed", "fields"),
    "The frames": ("generator", "own", "num_frames", "fps", "frames", "count", "max_side"),
}  # of the options that `simulate` and `answer` share


class Grouped(TyperCommand):
    """A command whose help lists its options in `GROUPS`, after its own."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Writes the arguments and the options."""
        shared = {name: group for group, names in GROUPS.items() for name in names}
        rows: dict[str, list[Any]] = {title: [] for title in ("Arguments", "Options", *GROUPS)}
        for param in self.get_params(ctx):
            own = "Arguments" if param.param_type_name == "argument" else "Options"
            if (record := param.get_help_record(ctx)) is not None:
                rows[shared.get(param.name or "", own)].append(record)
        for title, records in rows.items():
            with formatter.section(title):
                formatter.write_dl(records)


class Commands(TyperGroup):
    """A group of commands whose errors are a few plain lines on standard error.

    Exit code 1; 2 for bad settings. With `--json` standard output has the problem (RFC 9457).
    """

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Writes the commands in groups by purpose."""
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
    """The text without characters that could control a terminal: control codes, escapes, direction marks."""
    return "".join(character if character.isprintable() or character == "\n" else "\ufffd" for character in text)


def option(help: str, *names: str, shown: str | None = None, **more: Any) -> Any:
    """The declaration of an option. `shown` is the default in the help, where the option itself has none."""
    return typer.Option(*names, help=help, show_default=shown or True, **more)


def argument(help: str, name: str | None = None, **more: Any) -> Any:
    """The declaration of an argument."""
    return typer.Argument(metavar=name, help=help, **more)


EXISTING: dict[str, Any] = {"exists": True, "dir_okay": False}  # of a path: a file that is there
Image = Annotated[Path, argument("PNG, JPEG or WebP file.", "IMAGE", readable=True, **EXISTING)]
Question = Annotated[
    str, argument('A what-if question, such as "If the red ball moves left, will it hit the vase?"', "QUESTION")
]
Url = Annotated[str | None, option("URL of the server.", shown="COW_BASE_URL, http://127.0.0.1:8000")]
AsJson = Annotated[bool, option("Print JSON.", "--json")]
Texts = list[str] | None
Policy = Literal["initial", "uniform", "events"]
Kind = Literal["linear", "projectile", "fall", "static"]
Law = Literal["contact", "ballistic"]
Language = Literal["en", "de", "es", "fr", "zh", "ja"]


class Format(StrEnum):
    """Formats of a clip besides mp4. Typer does not accept a list of a `Literal`."""

    GIF = "gif"
    WEBP = "webp"
    SHEET = "sheet"


# The request field of each option. The options below repeat the fields' defaults, because importing pydantic would
# slow down `--help`; a test checks that they agree.
FIELDS = {
    **{"point": "grounding/point", "box": "grounding/bbox", "name": "grounding/object"},
    **{name: f"motion/{name}" for name in ("direction", "kind", "speed", "distance", "duration", "until", "law")},
    **{"frames": "frames/policy", "count": "frames/count", "max_side": "frames/max_side"},
}
_NUMBERS = {"point": 2, "box": 4, "direction": 2}  # how many comma-separated numbers an option takes
_SAME_NAME = ("language", "ensemble", "reader", "generator", "num_frames", "fps", "seed")


def request_body(
    point: Annotated[str | None, option("X,Y of a point on the moving object, px.")] = None,
    box: Annotated[str | None, option("X0,Y0,X1,Y1 of a box around the moving object, px.")] = None,
    name: Annotated[str | None, option("Name of the object, with --point, --box or --trajectory.", "--object")] = None,
    direction: Annotated[str | None, option("DX,DY of the motion in the image; x right, y down.")] = None,
    kind: Annotated[Kind | None, option("Motion; linear and projectile need --direction.", shown="linear")] = None,
    speed: Annotated[float | None, option("Speed, px/s.", shown="0.26 image widths/s")] = None,
    distance: Annotated[float | None, option("Stop the object after this distance, px.")] = None,
    duration: Annotated[float | None, option("Stop the object after this time, s.")] = None,
    until: Annotated[Literal["contact"] | None, option("contact: stop the object at its first contact.")] = None,
    remove: Annotated[Texts, option("Object to take away before the motion; may be repeated.", metavar="NAME")] = None,
    place: Annotated[
        Texts, option('Put an object first: "apple into bowl"; may be repeated.', metavar="THING RELATION THING")
    ] = None,
    law: Annotated[
        Law | None, option("Physics. contact: bounces, pushes; ballistic: through everything.", shown="contact")
    ] = None,
    other: Annotated[
        Texts,
        option(
            'Another object and its box (or X,Y of a point on it), such as "red mug=10,20,90,140"; may be repeated.',
            metavar="NAME=X0,Y0,X1,Y1",
        ),
    ] = None,
    ensemble: Annotated[int, option("Most simulated versions, over which probabilities are counted; 0: none.")] = 50,
    depth: Annotated[Path | None, option("Depth map of the image: a 16-bit grey PNG.", **EXISTING)] = None,
    depth_scale: Annotated[float | None, option("Metres per unit of the depth map.", shown="unknown")] = None,
    trajectory: Annotated[Path | None, option("JSON file: the `trajectory` of a request.", **EXISTING)] = None,
    language: Annotated[Language | None, option("Language of answer and story.", shown="en")] = None,
    fields: Annotated[
        str | None,
        option('Other request fields, such as {"camera": {"pitch": 25}}.', "--request", metavar="JSON", shown="none"),
    ] = None,
    reader: Annotated[str | None, option("Part that understands the question.", shown="COW_READER")] = None,
    generator: Annotated[str | None, option("Part that makes the frames.", shown="COW_GENERATOR")] = None,
    own: Annotated[
        Texts,
        option("An option of the generator, such as steps=20; may be repeated.", "--option", metavar="NAME=VALUE"),
    ] = None,
    num_frames: Annotated[int, option("Length of the clip, frames.")] = 81,
    fps: Annotated[float, option("Frames per second of the clip.")] = 16,
    seed: Annotated[int | None, option("Random seed.", shown="0, and none for a multimodal LLM")] = None,
    frames: Annotated[Policy, option("Frames to save as pictures: around events, uniform, or initial.")] = "events",
    count: Annotated[int, option("Number of these pictures.")] = 4,
    max_side: Annotated[int, option("Their longest side, px; 0: the size of the clip.")] = 512,
) -> dict[str, Any]:
    """The request fields that both commands have. Raises `InvalidRequest`, naming the wrong option."""
    given = locals()
    body: dict[str, Any] = {name: given[name] for name in _SAME_NAME} | {"generator_options": {}}
    for text in own or []:
        own_name, equals, own_value = text.partition("=")
        if not own_name or not equals:
            raise InvalidRequest(f"--option takes NAME=VALUE, such as steps=20; got '{text}'.")
        body["generator_options"][own_name] = own_value
        with suppress(ValueError):  # a value that is not JSON is text
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
    if depth is not None:
        url = f"data:image/png;base64,{base64.b64encode(read_file(depth)).decode()}"
        body["depth"] = {"map": url, "scale": depth_scale}
    elif depth_scale is not None:
        raise InvalidRequest("--depth-scale needs --depth, the file of the depth map.")
    if trajectory is not None:
        body["trajectory"] = object_in(read_file(trajectory), trajectory.name)
    if body.get("grounding", {}).keys() == {"object"}:
        points = body.get("trajectory", {}).get("points")
        if not points:
            raise InvalidRequest("--object needs --point, --box or --trajectory. Or name the object in the question.")
        body["grounding"]["point"] = points[0]
    more = object_in(fields or "{}", "--request")
    if isinstance(more.get("depth"), dict):  # such as focal length or deviation, in addition to the map
        more["depth"] = body.get("depth", {}) | more["depth"]
    return body | more


def with_options(
    command: Callable[..., None], read: Callable[..., dict[str, Any]] = request_body
) -> Callable[..., None]:
    """The command with its last parameter replaced by the options of `read`, of which it gets what that returns."""
    shared = signature(read, eval_str=True).parameters
    *own, last = signature(command, eval_str=True).parameters.values()

    @wraps(command)
    def with_shared(**given: Any) -> None:
        command(**{last.name: read(**{name: given.pop(name) for name in shared})}, **given)

    keyword_only = [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in (*own, *shared.values())]
    cast("Any", with_shared).__signature__ = signature(command).replace(parameters=keyword_only)
    return with_shared


def open_client(url: str | None) -> Client:
    """A client of the SDK. Raises `InvalidRequest` if the URL is not valid."""
    from cow_service.client import Client  # noqa: PLC0415

    try:
        return Client(url)
    except ValueError as error:
        raise InvalidRequest(f"{error}.") from error


def read_file(path: Path) -> bytes:
    """The bytes of a file named on the command line. Raises `FileUnreadable`."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileUnreadable(f"Cannot read '{path}': {error.strerror}. Choose another file.") from error


@contextmanager
def writable(out: Path) -> Generator[None]:
    """Translates `OSError` to `FolderNotWritable`, which names the folder."""
    try:
        yield
    except OSError as error:
        detail = f"Cannot write to '{out}': {error.strerror}. Choose another place with --out."
        raise FolderNotWritable(detail) from error


def object_in(text: str | bytes, name: str) -> dict[str, Any]:
    """Parses a JSON object. Raises `InvalidRequest`, which calls the text by `name`."""
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
        raise InvalidRequest(f"{option} takes {count} numbers separated by commas, such as {example}; got '{text}'.")
    return values


def _placement(text: str) -> dict[str, object]:
    """The intervention that a `--place` option describes."""
    from cow_service.narration.words import PREPOSITIONS, RELATION_WORDS  # noqa: PLC0415 - it imports pydantic

    words = "|".join(sorted(RELATION_WORDS, key=len, reverse=True))  # "in front of" before "in"
    pattern = rf"\s*(?P<object>.+?)\s+(?P<relation>{words})\s+(?P<targets>.+?)\s*"
    found = re.fullmatch(pattern, text, re.IGNORECASE)
    if found is None:
        raise InvalidRequest(
            f"--place takes an object, a relation ({', '.join(PREPOSITIONS)}) and the object or place it refers to, "
            f"such as 'apple into bowl' or 'cube between mug and vase'; got '{text}'."
        )
    relation = RELATION_WORDS[found["relation"].lower()]
    targets = re.split(r"\s+and\s+", found["targets"]) if relation == "between" else [found["targets"]]
    return {"kind": "place", "object": found["object"], "relation": relation, "targets": targets}


def _other_object(text: str) -> dict[str, object]:
    """The object that an `--other` option gives, by its box or a point on it."""
    name, _, place = text.rpartition("=")
    if not name.strip():
        raise InvalidRequest(f"--other takes NAME=X0,Y0,X1,Y1 or NAME=X,Y; got '{text}'.")
    is_point = place.count(",") == 1
    field, count = ("point", 2) if is_point else ("bbox", 4)
    return {"object": name.strip(), field: _numbers("--other NAME=", place, count)}
