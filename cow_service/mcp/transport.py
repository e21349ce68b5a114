"""Serves the tools of the Model Context Protocol, over stdio or HTTP."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from ipaddress import ip_address

import anyio
import uvicorn
from mcp.server.stdio import stdio_server
from mcp.server.transport_security import TransportSecuritySettings

from cow_service.client import AsyncClient
from cow_service.errors import Unauthorized
from cow_service.mcp.backends import Backend
from cow_service.mcp.server import Caller, Connect, create_server
from cow_service.settings import Settings

PATH = "/mcp"
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
WILDCARDS = ("0.0.0.0", "::", "")  # listen on every address of the machine, and are the name of none
CLOSE_SECONDS = 5.0  # for open connections, after the grace period of running jobs


def run_stdio(backend: Backend) -> None:
    """Serves the program that started this process, until it closes standard input or sends a signal."""
    server = create_server(backend.connect, backend.lifespan, paths=True, links=backend.links)

    async def serve() -> None:
        async with stdio_server() as (read, write), anyio.create_task_group() as tasks:
            if sys.platform != "win32":
                tasks.start_soon(_exit_on_signal, backend.close)
            await server.run(read, write, server.create_initialization_options())
            tasks.cancel_scope.cancel()

    anyio.run(serve)


async def _exit_on_signal(close: Callable[[], Awaitable[None]]) -> None:
    with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
        async for number in signals:
            await close()
            os._exit(128 + number)  # the thread that reads standard input cannot be woken, and would be waited for


def run_http(backend: Backend, settings: Settings, *, names: Sequence[str] = ()) -> None:
    """Serves at `settings.host` and `port`, until a signal ends it; `names` are further allowed host names."""
    from cow_service.api.middleware.access import is_loopback  # noqa: PLC0415

    # Another name is that of a proxy, and nothing is known of the callers of a proxy.
    connect = with_own_keys(backend.connect, everybody=bool(names) or not is_loopback(settings.host))
    server = create_server(connect, backend.lifespan, paths=False, links=backend.links)
    app = server.streamable_http_app(
        streamable_http_path=PATH,
        host=settings.host,
        max_request_body_size=int(settings.max_body_mb * 1_000_000),
        transport_security=protection(settings.host, names),
    )
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=int(settings.shutdown_grace + CLOSE_SECONDS),
    )
    uvicorn.Server(config).run()


def with_own_keys(connect: Connect, *, everybody: bool) -> Connect:
    """The same `connect`, which refuses remote callers without a key, or everybody without one.

    The SDK would use COW_API_KEY instead, which is for callers on this machine.
    """

    @asynccontextmanager
    async def connected(caller: Caller) -> AsyncGenerator[AsyncClient]:
        if (everybody or caller.forwarded) and caller.key is None and os.environ.get("COW_API_KEY"):
            raise Unauthorized("The request has no key. Send the header `Authorization: Bearer <key>`.")
        async with connect(caller) as client:
            yield client

    return connected


def protection(host: str, names: Sequence[str]) -> TransportSecuritySettings:
    """The allowed `Host` and `Origin` headers: a page may give its own name this address (DNS rebinding)."""
    given = [socket.gethostname() if host in WILDCARDS else host, *names]
    hosts = dict.fromkeys([*LOOPBACK, *(f"[{name}]" if _is_ipv6(name) else name.lower() for name in given)])
    both = [form for name in hosts for form in (name, f"{name}:*")]
    return TransportSecuritySettings(
        enable_dns_rebinding_protection=True,
        allowed_hosts=both,
        allowed_origins=[f"{scheme}://{form}" for form in both for scheme in ("http", "https")],
    )


def _is_ipv6(name: str) -> bool:
    try:
        return ip_address(name).version == 6
    except ValueError:
        return False
