"""`cow mcp`: the service as tools of the Model Context Protocol."""

from __future__ import annotations

import sys
from typing import Annotated, Literal

import typer

from cow_service.errors import CowError

INSTALL = 'pip install "cow-service[mcp]"'


class McpNotInstalled(CowError):
    """The Python package that speaks the Model Context Protocol is not installed."""

    code, status = "mcp-not-installed", 0


def mcp(
    transport: Annotated[
        Literal["stdio", "http"],
        typer.Option(help="stdio: with the program that starts this one; http: at --host and --port, /mcp."),
    ] = "stdio",
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
    """Serve `simulate` and `answer` as tools over MCP.

    MCP is the Model Context Protocol, by which agents call tools.
    """
    import logging  # noqa: PLC0415

    from cow_service.observability import logging as logs  # noqa: PLC0415
    from cow_service.settings import load_settings  # noqa: PLC0415

    settings = load_settings(host=host, port=port)
    # Standard output is the protocol's.
    logs.set_up(settings, out=sys.stderr)
    try:
        from cow_service.mcp.backends import backend_for, for_its_owner  # noqa: PLC0415
        from cow_service.mcp.transport import run_http, run_stdio  # noqa: PLC0415
    except ImportError as error:
        if (error.name or "").partition(".")[0] not in ("mcp", "mcp_types"):
            raise
        raise McpNotInstalled(f"`cow mcp` needs the Python package `mcp`, 2.3 or later: {INSTALL}") from error

    if transport == "stdio":
        # The requests are the tools' own, and there is one caller.
        logging.getLogger(logs.ACCESS).setLevel(logging.WARNING)
        run_stdio(backend_for(for_its_owner(settings), url))
        return
    from cow_service.api.app import warn_if_open  # noqa: PLC0415
    from cow_service.api.middleware.access import is_loopback  # noqa: PLC0415

    if not url:
        warn_if_open(settings)
    elif not is_loopback(host):
        logging.getLogger("cow_service").warning(
            "Whoever reaches %s can use the COW server behind it, unless that asks for keys.", host
        )
    run_http(backend_for(settings, url), settings, names=allow_host or ())
