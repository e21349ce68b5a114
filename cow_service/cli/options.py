"""Options: those of `simulate` and `answer`, and the request that they become; and how help and errors are shown."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property, partial
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer
from typer.core import TyperCommand, TyperGroup

from cow_service.errors import CowError, InvalidRequest

if TYPE_CHECKING:
    from cow_service.client import Client
    from cow_service.records import JobKind

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


class Sharing(TyperCommand):
    """A command with the options of a function besides its own; `ctx.obj` becomes what the function returns."""

    reader: Callable[..., Callable[..., dict[str, Any]]]  # of the command: the function

    @cached_property
    def shared(self) -> Any:
        """The function as a command."""
        app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
        app.command()(self.reader())
        return typer.main.get_command(app)

    def get_params(self, ctx: Any) -> list[Any]:
        """All arguments and options."""
        *own, help = super().get_params(ctx)
        return [*own, *self.shared.params, help]

    def invoke(self, ctx: Any) -> Any:
        """Calls the function, then the command."""
        ctx.obj = self.shared.callback(**{each.name: ctx.params.pop(each.name) for each in self.shared.params})
        return super().invoke(ctx)


class Asking(Sharing):
    """A command with fields of a request as options: `ctx.obj` becomes the request.

    They come from the request models when they are needed: the import would slow down `cow --help`.
    """

    def reader(self) -> Callable[..., dict[str, Any]]:
        """Of the kind of request that the command is named after."""
        return request_reader("answer" if self.name == "answer" else "simulate")

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Writes the arguments and the options, its own first."""
        from cow_service.requests.flat import FLAT  # noqa: PLC0415 - it imports pydantic

        groups = {field.option: title for title, fields in FLAT.items() for field in fields if field.option}
        rows: dict[str, list[Any]] = {title: [] for title in ("Arguments", "Options", *FLAT)}
        for param in self.get_params(ctx):
            own = "Arguments" if param.param_type_name == "argument" else "Options"
            if (record := param.get_help_record(ctx)) is not None:
                rows[groups.get(param.name or "", own)].append(record)
        for title, records in rows.items():
            if records:
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


class Format(StrEnum):
    """Formats of a clip besides mp4. Typer does not accept a list of a `Literal`."""

    GIF = "gif"
    WEBP = "webp"
    SHEET = "sheet"


@dataclass(frozen=True)
class Written:
    """How an option is written whose field is not a number or a word."""

    metavar: str | None
    read: Callable[[Any], Any]  # what was written as the field has it; of one where the option may be repeated
    help: str = ""  # instead of the description of the field
    kind: Any = list[str]


def request_reader(kind: JobKind) -> Callable[..., dict[str, Any]]:
    """The function whose parameters are the options of a kind of request; it returns the fields that they set.

    It raises `InvalidRequest`, naming the wrong option.
    """
    from cow_service.requests.flat import flat_fields, put  # noqa: PLC0415 - it imports pydantic

    fields = {field.option: (field.path, schema) for field, schema in flat_fields(kind).items() if field.option}

    def read(request: str | None = None, **given: Any) -> dict[str, Any]:
        body: dict[str, Any] = {}
        for name, (path, schema) in fields.items():
            if (value := given.get(name)) not in (None, [], schema.get("default")):
                put(body, path, _value(name, value, schema))
        if body.get("depth", {}).keys() == {"scale"}:
            raise InvalidRequest("--depth-scale needs --depth, the file of the depth map.")
        if body.get("grounding", {}).keys() == {"object"}:
            if not (points := body.get("trajectory", {}).get("points")):
                raise InvalidRequest("--object needs --point, --box or --trajectory. Or name it in the question.")
            body["grounding"]["point"] = points[0]
        for name, value in WRITTEN["request"].read(request or "{}").items():
            both = isinstance(value, dict) and isinstance(body.get(name), dict)
            body[name] = body[name] | value if both else value  # such as the focal length of a depth map
        return body

    options = {name: schema for name, (_, schema) in fields.items()} | {"request": {}}
    cast("Any", read).__signature__ = Signature([_parameter(name, schema) for name, schema in options.items()])
    return read


def _parameter(name: str, schema: dict[str, Any]) -> Parameter:
    """The option of a field, as `WRITTEN` and the field's JSON schema say it."""
    told, default, how = schema.get("description", ""), schema.get("default"), WRITTEN.get(name)
    kind: Any = Literal[tuple(schema["enum"])] if "enum" in schema else TYPES.get(schema.get("type", ""), str)
    declared = option(told, *(["--" + name] if default is False else []))  # of a flag without its opposite
    if how is not None:
        kind, default = how.kind, default if how.kind is int else None
        declared = option(how.help or told, **(EXISTING if kind is Path else {"metavar": how.metavar}))
    return Parameter(name, Parameter.KEYWORD_ONLY, annotation=Annotated[kind | None, declared], default=default)


def _value(name: str, value: Any, schema: dict[str, Any]) -> Any:
    """The value of a field for what was written."""
    if name not in WRITTEN:
        return value if schema.get("type", "") in TYPES else _json_or_text(value)
    if not isinstance(value, list):
        return WRITTEN[name].read(value)
    each = [WRITTEN[name].read(text) for text in value]
    return dict(each) if schema.get("type") == "object" else each


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


def _json_or_text(text: str) -> Any:
    with suppress(ValueError):
        return json.loads(text)
    return text


def _numbers(option: str, form: str, text: str) -> list[float]:
    """As many numbers as `form` has, such as X,Y."""
    with suppress(ValueError):
        values = [float(part) for part in text.replace(" ", "").split(",")]
        if len(values) == form.count(",") + 1:
            return values
    raise InvalidRequest(f"{option} takes {form}, numbers separated by commas (x right, y down); got '{text}'.")


def _generator_option(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise InvalidRequest(f"--option takes NAME=VALUE, such as steps=20; got '{text}'.")
    return name, _json_or_text(value)


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
    field, form = ("point", "X,Y") if is_point else ("bbox", "X0,Y0,X1,Y1")
    return {"object": name.strip(), field: _numbers("--other NAME=", form, place)}


TYPES = {"integer": int, "number": float, "boolean": bool, "string": str}
WRITTEN = {  # by the option
    **{
        name: Written(form, partial(_numbers, "--" + name, form), kind=str)
        for name, form in {"point": "X,Y", "box": "X0,Y0,X1,Y1", "direction": "DX,DY"}.items()
    },
    "trajectory": Written(
        None, lambda path: object_in(read_file(path), path.name), "JSON file: the `trajectory` of a request.", Path
    ),
    "depth": Written(None, lambda path: f"data:image/png;base64,{b64encode(read_file(path)).decode()}", kind=Path),
    "request": Written(
        "JSON", partial(object_in, name="--request"), 'Other request fields, such as {"camera": {"pitch": 25}}.', str
    ),
    "max_side": Written(None, lambda side: side or None, "Longest side of the pictures, px; 0: that of the clip.", int),
    "choice": Written("TEXT", str, "An answer to choose from; may be repeated: A, B, C... Default: the question's."),
    "remove": Written("NAME", lambda it: {"kind": "remove", "object": it}, "Object to take away; may be repeated."),
    "place": Written("THING RELATION THING", _placement, 'Put an object first: "apple into bowl"; may be repeated.'),
    "other": Written(
        "NAME=X0,Y0,X1,Y1",
        _other_object,
        'Another object and its box (or X,Y of a point on it), such as "red mug=10,20,90,140"; may be repeated.',
    ),
    "option": Written("NAME=VALUE", _generator_option, "Option of the generator, such as steps=20; may be repeated."),
}
