"""Commands of processes that go on: `serve`, `worker` and `mcp`, their job database, and the keys of their callers."""

from __future__ import annotations

import gc
import json
import logging
import os
import re
import socket
import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cow_service.cli.options import Texts, argument, option
from cow_service.errors import CowError, InvalidRequest, install_line

if TYPE_CHECKING:
    from cow_service.service import Service
    from cow_service.settings import Settings

# Log levels of libraries that print notes when they are imported, such as on optional packages.
QUIET = {"TRANSFORMERS_VERBOSITY": "error", "DIFFUSERS_VERBOSITY": "error"}
keys = typer.Typer(rich_markup_mode=None, help="Create API keys.", no_args_is_help=True)


def serve(
    host: Annotated[str | None, option("Address to listen on.", shown="COW_HOST, 127.0.0.1")] = None,
    port: Annotated[int | None, option("Port to listen on; 0 takes a free one.", shown="COW_PORT, 8000")] = None,
    role: Annotated[
        Literal["all", "api"] | None,
        option("api: take requests only, and leave the jobs to `cow worker`.", shown="COW_ROLE, all"),
    ] = None,
) -> None:
    """Start the server."""
    with quick_imports():
        service = _served(host=host, port=port, role=role)
        check_port(service.settings)
        from cow_service.workers.pool import WorkerPool  # noqa: PLC0415

        settings = service.settings
        pool = WorkerPool(settings, service.metrics) if settings.workers and settings.role == "all" else None
        if pool is not None:
            pool.start()  # its processes start while the server is imported
        from cow_service.api.app import warn_if_open  # noqa: PLC0415
        from cow_service.server import run_server  # noqa: PLC0415

    warn_if_open(settings)
    run_server(service, pool)


def worker(
    queues: Annotated[
        str | None, option("Queues to take jobs from: light, and ati or another name.", shown="COW_QUEUES, all")
    ] = None,
) -> None:
    """Compute the jobs of servers on the same job database."""
    named = None if queues is None else tuple(name.strip() for name in queues.split(",") if name.strip())
    with quick_imports():
        service = _served(queues=named)
        from cow_service.workers.pool import WorkerPool  # noqa: PLC0415

        pool = WorkerPool(service.settings, service.metrics)
        pool.start()
        from cow_service.observability import tracing  # noqa: PLC0415
        from cow_service.server import run_worker  # noqa: PLC0415

    run_worker(service, pool)
    tracing.stop()
    os._exit(0)  # while the database is away, DBOS retries in threads for which Python would wait


def migrate() -> None:
    """Create or update the tables of the job database.

    Servers and workers do so themselves when they start, unless COW_MIGRATE is false.
    """
    from cow_service.jobs.webhooks import migrate as run  # noqa: PLC0415
    from cow_service.settings import load_settings  # noqa: PLC0415

    run(load_settings())
    typer.echo("The job database is up to date.")


class McpNotInstalled(CowError):
    """The Python package that speaks the Model Context Protocol is not installed."""

    code, status = "mcp-not-installed", 0


def mcp(
    transport: Annotated[
        Literal["stdio", "http"],
        option("stdio: with the program that starts this one; http: at --host and --port, /mcp."),
    ] = "stdio",
    host: Annotated[str, option("Address to listen on, with --transport http.")] = "127.0.0.1",
    port: Annotated[int, option("Port to listen on; 0 takes a free one.", min=0, max=65535)] = 8001,
    url: Annotated[
        str | None,
        option(
            "COW server that does the work; its key is COW_API_KEY, or that of the caller over HTTP.",
            envvar="COW_BASE_URL",
            shown="none: this process does it",
        ),
    ] = None,
    allow_host: Annotated[
        Texts,
        option("Another name by which it may be asked, such as that of a proxy; may be repeated.", metavar="NAME"),
    ] = None,
) -> None:
    """Serve `simulate` and `answer` as tools over MCP.

    MCP is the Model Context Protocol, by which agents call tools.
    """

    from cow_service.observability import logging as logs  # noqa: PLC0415
    from cow_service.settings import load_settings  # noqa: PLC0415

    settings = load_settings(host=host, port=port)
    # Standard output is the protocol's.
    logs.set_up(settings, out=sys.stderr)
    try:
        from cow_service.mcp.serving import backend_for, for_its_owner, run_http, run_stdio  # noqa: PLC0415
    except ImportError as error:
        if (error.name or "").partition(".")[0] not in ("mcp", "mcp_types"):
            raise
        raise McpNotInstalled(
            f"`cow mcp` needs the Python package `mcp`, 2.3 or later: {install_line('mcp')}"
        ) from error

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


@keys.callback()
def _keys() -> None:
    """Create API keys."""


@keys.command()
def new(name: Annotated[str, argument("Whose key it is; logs and limits go by it.", "NAME")]) -> None:
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


def open_service(*, ahead: bool = False, **overrides: Any) -> Service:
    """`ahead`: its first worker process, where there will be one, is started before all that it needs is imported."""
    from cow_service.settings import load_settings  # noqa: PLC0415

    for name, level in QUIET.items():
        os.environ.setdefault(name, level)
    settings = load_settings(**overrides)
    if ahead and settings.workers and settings.role == "all":
        from cow_service.concurrency import spawn_ahead  # noqa: PLC0415

        spawn_ahead("cow_service.workers")
    from cow_service.service import Service  # noqa: PLC0415

    return Service(settings)


def _served(**overrides: Any) -> Service:
    """The service of a process that goes on, with its logs and traces."""
    service = open_service(ahead=True, **overrides)
    from cow_service.jobs.queues import check_queues  # noqa: PLC0415
    from cow_service.observability import logging as logs  # noqa: PLC0415
    from cow_service.observability import tracing  # noqa: PLC0415

    check_queues(service.settings)
    logs.set_up(service.settings)
    tracing.start()
    return service


@contextmanager
def quick_imports() -> Generator[None]:
    """Without garbage collection: nothing of imports is garbage, and looking for it takes a fifth of the time."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def check_port(settings: Settings) -> None:
    """Raises `SettingsError` where nobody can listen at the server's address and port."""
    from cow_service.settings import SettingsError  # noqa: PLC0415

    host, port = settings.host, settings.port
    if port == 0:
        return
    try:
        for family, _, _, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            socket.create_server(address[:2], family=family).close()
    except OSError as error:
        raise SettingsError(
            f"Bad settings: COW_HOST={host}, COW_PORT={port}: {error.strerror}. Choose others with --host and --port; "
            "port 0 takes a free one."
        ) from error
