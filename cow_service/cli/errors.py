"""How the command line shows errors, and those that only it has."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from cow_service.errors import CowError

_GIVE_PLACE = (
    "Here: --point X,Y or --box X0,Y0,X1,Y1 (and --object NAME) for what moves, --other NAME=X0,Y0,X1,Y1 for the rest."
)
HINTS = {  # the options that an error's remedy asks for, by the error's code
    "cannot-ground": _GIVE_PLACE,
    "object-not-found": _GIVE_PLACE,
    "cannot-read-direction": "Here: --direction DX,DY.",
}


class FileUnreadable(CowError):
    """A file of the command line cannot be read."""

    code, status = "file-unreadable", 0  # never on the wire


class FolderNotWritable(CowError):
    """The results cannot be written."""

    code, status = "folder-not-writable", 0


class Commands(TyperGroup):
    """A group of commands whose errors are a few plain lines on standard error.

    Exit code 1; 2 for bad settings.
    """

    def invoke(self, ctx: Any) -> Any:
        """Runs a command."""
        try:
            return super().invoke(ctx)
        except CowError as error:
            typer.secho(f"{error.code}: {error.title}", fg="red", bold=True, err=True)
            typer.echo(printable(error.detail), err=True)
            if error.code in HINTS:
                typer.echo(HINTS[error.code], err=True)
            for field in (field for field in error.errors if field.detail not in error.detail):
                typer.echo(printable(f"  {field.pointer}: {field.detail}"), err=True)
            raise typer.Exit(1) from error
        except typer.BadParameter as error:
            error.message = _own_words(error)
            raise
        except Exception as error:
            from cow_service.settings import SettingsError  # noqa: PLC0415 - its import would slow down --help

            if not isinstance(error, SettingsError):
                raise
            typer.secho(str(error), fg="red", err=True)
            raise typer.Exit(2) from error


def _own_words(error: typer.BadParameter) -> str:
    """What is wrong with an option, without what the validator of typer puts before it ("Value error, ")."""
    from pydantic import ValidationError  # noqa: PLC0415 - its import would slow down --help

    if not isinstance(error.__cause__, ValidationError):
        return error.message
    raised = error.__cause__.errors()[0].get("ctx", {}).get("error")
    return str(raised) if isinstance(raised, ValueError) else error.message


def printable(text: str) -> str:
    """The text without characters that control a terminal: control codes, escapes, marks of writing direction."""
    return "".join(character if character.isprintable() or character == "\n" else "\ufffd" for character in text)
