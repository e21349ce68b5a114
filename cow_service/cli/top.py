"""`cow top`: what the processes on a server's job database do, once a second."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from cow_service.client import Client

REFRESH_SECONDS = 1.0
TIMEOUT_SECONDS = 5.0  # that the server may say nothing


def top(
    url: Annotated[
        str | None, typer.Option(help="The server.", show_default="COW_BASE_URL, http://127.0.0.1:8000")
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Print one picture, and end.")] = False,
) -> None:
    """Show processes, workers and queues of a server, until Ctrl-C.

    Where standard output is no terminal, one picture is printed.
    """
    from rich.console import Console  # noqa: PLC0415 - rich and httpx would slow down --help

    from cow_service.cli.top_tables import picture  # noqa: PLC0415
    from cow_service.client import Client  # noqa: PLC0415
    from cow_service.errors import InvalidRequest  # noqa: PLC0415

    console = Console()
    try:
        client = Client(url, timeout=TIMEOUT_SECONDS, retries=0)
    except ValueError as error:
        raise InvalidRequest(f"{error}.") from error
    with client:
        first = picture(client.workers(), client.base_url)
        if once or not console.is_terminal:
            console.print(first)
        else:
            _watch(console, client, first)


def _watch(console: Console, client: Client, shown: RenderableType) -> None:
    """Shows a new picture each second; one that cannot be had leaves the last one, and says why."""
    from rich.live import Live  # noqa: PLC0415

    from cow_service.cli.top_tables import picture, with_fault  # noqa: PLC0415
    from cow_service.errors import CowError  # noqa: PLC0415

    seen = time.monotonic()
    try:
        with Live(shown, console=console, screen=True, auto_refresh=False) as live:
            while True:
                time.sleep(REFRESH_SECONDS)
                try:
                    shown, seen = picture(client.workers(), client.base_url), time.monotonic()
                    live.update(shown, refresh=True)
                except CowError as error:
                    live.update(with_fault(shown, error.detail, time.monotonic() - seen), refresh=True)
    except KeyboardInterrupt:
        pass
