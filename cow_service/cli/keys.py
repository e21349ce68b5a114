"""`cow keys`: creates API keys."""

from __future__ import annotations

import json
import re
from typing import Annotated

import typer

from cow_service.errors import InvalidRequest

app = typer.Typer(rich_markup_mode=None, help="Create API keys.", no_args_is_help=True)


@app.callback()
def keys() -> None:
    """Create API keys."""


@app.command()
def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Whose key it is; logs and limits go by it.")],
) -> None:
    """Create a key for NAME, and print the setting with which the server accepts it. Nothing is stored."""
    from cow_service.api.middleware.access import hash_of, new_key  # noqa: PLC0415
    from cow_service.settings import KEY_NAME, load_settings  # noqa: PLC0415

    if not re.fullmatch(KEY_NAME, name):
        raise InvalidRequest(f"{name!r} is no name for a key: 1 to 64 letters, digits, dots, hyphens, underscores.")
    known = load_settings().api_keys
    if name in known:
        raise InvalidRequest(
            f"COW_API_KEYS has a key of '{name}' already. Take another name, or remove that one first."
        )
    key = new_key()
    typer.echo(f"The key of {name}, shown only now; it goes into the header `Authorization: Bearer <key>`:")
    typer.echo(f"\n    {key}\n")
    typer.echo("The setting of the server, which holds hashes only" + (", with those set here:" if known else ":"))
    typer.echo(f"\n    COW_API_KEYS='{json.dumps(known | {name: hash_of(key)})}'\n")
