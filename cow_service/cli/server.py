"""Commands that run servers: `serve`, `worker` and `mcp`; also their job database and API keys."""

from __future__ import annotations

import gc
import json
import logging
import os
import re
import signal
import socket
import sys
from collections.abc import Generator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cow_service.cli.options import NotInstalled, Texts, argument, option
from cow_service.errors import InvalidRequest, install_line

if TYPE_CHECKING:
    from cow_service.service import Service
    from cow_service.settings import Settings
    from cow_service.workers.pool import WorkerPool

# Log levels of libraries that print notes when they are imported, such as on optional packages.
QUIET = {"TRANSFORMERS_VERBOSITY": "error", "DIFFUSERS_VERBOSITY": "error"}
keys = typer.Typer(rich_markup_mode=None, help="Create API keys.", no_args_is_help=True)


def serve(
    host: Annotated[str | None, option("Address to listen on.", shown="COW_HOST, 127.0.0.1")] = None,
    port: Annotated[int | None, option("Port to listen on; 0 takes a free one.", shown="COW_PORT, 8000")] = None,
    role: Annotated[
        Literal["all", "api"] | None,
        option("api: only accept requests and leave the jobs to `cow worker`.", shown="COW_ROLE, all"),
    ] = None,
) -> None:
    """Start the server."""
    end_well()
    with quick_imports():
        service = _served(host=host, port=port, role=role)
        check_port(service.settings)
        settings = service.settings
        computes = settings.role == "all" and (settings.workers or settings.ray is not None)
        pool = _start_pool(service) if computes else None  # while the server's modules are imported
        from cow_service.api.app import warn_if_open  # noqa: PLC0415
        from cow_service.server import run_server  # noqa: PLC0415

    warn_if_open(settings)
    run_server(service, pool)


def worker() -> None:
    """Compute jobs for the servers on the same job database."""
    end_well()
    with quick_imports():
        service = _served()
        pool = _start_pool(service)
        from cow_service.observability import tracing  # noqa: PLC0415
        from cow_service.server import run_worker  # noqa: PLC0415

    run_worker(service, pool)
    tracing.stop()
    os._exit(0)  # Python would wait for threads that a database holds up


def migrate() -> None:
    """Create or update the tables of the job database.

    Servers and workers do this when they start, unless COW_MIGRATE is false.
    """
    from cow_service.jobs.opening import open_database  # noqa: PLC0415
    from cow_service.settings import load_settings  # noqa: PLC0415

    with closing(open_database(load_settings())) as database:
        database.create_tables()
    typer.echo("The job database is up to date.")


def mcp(
    transport: Annotated[
        Literal["stdio", "http"],
        option("stdio: talk to the program that starts it; http: listen at --host and --port, under /mcp."),
    ] = "stdio",
    host: Annotated[str, option("Address to listen on, with --transport http.")] = "127.0.0.1",
    port: Annotated[int, option("Port to listen on; 0 takes a free one.", min=0, max=65535)] = 8001,
    url: Annotated[
        str | None,
        option(
            "COW server that does the work; the key is COW_API_KEY, or over HTTP the caller's.",
            envvar="COW_BASE_URL",
            shown="none: this process does the work",
        ),
    ] = None,
    allow_host: Annotated[
        Texts, option("Another host name that callers use, such as a proxy's; may be repeated.", metavar="NAME")
    ] = None,
) -> None:
    """Serve `simulate` and `answer` as tools for agents (MCP).

    MCP is the Model Context Protocol, which agents use to call tools.
    """
    from cow_service.observability import logging as logs  # noqa: PLC0415
    from cow_service.settings import load_settings  # noqa: PLC0415

    end_well()
    settings = load_settings(host=host, port=port)
    # Standard output is the protocol's.
    logs.set_up(settings, out=sys.stderr)
    try:
        from cow_service.mcp.serving import backend_for, for_its_owner, run_http, run_stdio  # noqa: PLC0415
    except ImportError as error:
        if (error.name or "").partition(".")[0] not in ("mcp", "mcp_types"):
            raise
        raise NotInstalled(f"`cow mcp` needs the Python package `mcp`, 2.3 or later: {install_line('mcp')}") from error
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
            "Anyone who can reach %s can use the COW server behind it, unless that server asks for keys.", host
        )
    run_http(backend_for(settings, url), settings, names=allow_host or ())


@keys.callback()
def _keys() -> None:
    """Create API keys."""


@keys.command(epilog="Example: cow keys new alice")
def new(name: Annotated[str, argument("Owner of the key, as logs and rate limits name it.", "NAME")]) -> None:
    """Create a key for NAME, and print it and the server's setting."""
    from cow_service.api.middleware.access import hash_of, new_key  # noqa: PLC0415
    from cow_service.settings import KEY_NAME, load_settings  # noqa: PLC0415

    if not re.fullmatch(KEY_NAME, name):
        raise InvalidRequest(f"{name!r} cannot be the name of a key: use 1 to 64 letters, digits, '.', '-' or '_'.")
    known = load_settings().api_keys
    if name in known:
        raise InvalidRequest(f"COW_API_KEYS already has a key named '{name}'. Choose another name, or remove that key.")
    key = new_key()
    typer.echo(f"The key of {name}, shown only once; send it in the header `Authorization: Bearer <key>`:")
    typer.echo(f"\n    {key}\n")
    typer.echo("The server's setting, which holds only hashes" + (", including the keys set here:" if known else ":"))
    typer.echo(f"\n    COW_API_KEYS='{json.dumps(known | {name: hash_of(key)})}'\n")


def open_service(*, ahead: bool = False, **overrides: Any) -> Service:
    """The service. With `ahead`, its first worker process, if any, starts before the service's imports."""
    from cow_service.settings import load_settings  # noqa: PLC0415

    for name, level in QUIET.items():
        os.environ.setdefault(name, level)
    settings = load_settings(**overrides)
    if ahead and settings.workers and settings.role == "all" and settings.ray is None:
        from cow_service.concurrency import spawn_ahead  # noqa: PLC0415

        spawn_ahead("cow_service.workers")
    from cow_service.service import Service  # noqa: PLC0415

    return Service(settings)


def _served(**overrides: Any) -> Service:
    """The service of a long-running process, with its logs and traces."""
    service = open_service(ahead=True, **overrides)
    from cow_service.observability import logging as logs  # noqa: PLC0415
    from cow_service.observability import tracing  # noqa: PLC0415

    logs.set_up(service.settings)
    tracing.start()
    return service


def end_well() -> None:
    """Has SIGTERM end this process with the code 0, also while it starts: supervisors take every other for a failure.

    While uvicorn serves it has a handler of its own, which raises the signal again when all is closed.
    """
    signal.signal(signal.SIGTERM, lambda number, frame: os._exit(0))


def _start_pool(service: Service) -> WorkerPool:
    """What computes the jobs: processes of this machine, or a Ray cluster."""
    if service.settings.ray is None:
        from cow_service.workers.pool import WorkerPool as Pool  # noqa: PLC0415
    else:
        from cow_service.workers.ray_cluster import RayCluster as Pool  # noqa: PLC0415
    pool = Pool(service.settings, service.metrics, service.artifacts)
    pool.start()
    return pool


@contextmanager
def quick_imports() -> Generator[None]:
    """Turns garbage collection off: imports leave no garbage, and looking for it takes a fifth of their time."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def check_port(settings: Settings) -> None:
    """Raises `SettingsError` if the server cannot listen at its address and port."""
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
