"""`cow mcp`: the service as tools of the Model Context Protocol."""

from __future__ import annotations

import logging
import sys
from enum import StrEnum
from typing import Annotated

import typer

from cow_service.errors import CowError

INSTALL = 'pip install "cow-service[mcp]"'


class McpNotInstalled(CowError):
    """The Python package that speaks the Model Context Protocol is not installed."""

    code, status = "mcp-not-installed", 0


class Transport(StrEnum):
    """How the protocol is spoken."""

    stdio = "stdio"
    http = "http"


def mcp(
    transport: Annotated[
        Transport, typer.Option(help="stdio: with the program that starts this one; http: at --host and --port, /mcp.")
    ] = Transport.stdio,
    host: Annotated[str, typer.Option(help="Address to listen on, with --transport http.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on; 0 takes a free one.", min=0, max=65535)] = 8001,
    url: Annotated[
        str | None,
        typer.Option(
            help="COW server that does the work; its key is COW_API_KEY, or that of the caller over HTTP.",
            envvar="COW_BASE_URL",
            show_default="none: this process does it",
        ),
    ] = None,
    allow_host: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Another name by which it may be asked, such as that of a proxy; may be repeated."
        ),
    ] = None,
) -> None:
    """Serve the tools `simulate` and `answer` over the Model Context Protocol."""
    from cow_service.observability import logging as logs  # noqa: PLC0415
    from cow_service.settings import load_settings  # noqa: PLC0415

    settings = load_settings(host=host, port=port)
    # Standard output is the protocol's.
    logs.set_up(settings, out=sys.stderr)
    try:
        from cow_service.mcp import transport as mcp_serving  # noqa: PLC0415
    except ImportError as error:
        if (error.name or "").partition(".")[0] not in ("mcp", "mcp_types"):
            raise
        raise McpNotInstalled(f"`cow mcp` needs the Python package `mcp`, 2.3 or later: {INSTALL}") from error

    if transport is Transport.stdio:
        logging.getLogger(logs.ACCESS).setLevel(logging.WARNING)  # requests are the tools' own, and there is one caller
        mcp_serving.run_stdio(mcp_serving.house_of(mcp_serving.for_its_owner(settings), url))
        return
    from cow_service.api.middleware.order import warn_if_open  # noqa: PLC0415

    if not url:
        warn_if_open(settings)
    elif not mcp_serving.is_local(host):
        logging.getLogger("cow_service").warning(
            "Whoever reaches %s can use the COW server behind it, unless that asks for keys.", host
        )
    mcp_serving.run_http(mcp_serving.house_of(settings, url), settings, names=allow_host or ())
