"""Runs one process: an HTTP server with its engine, readiness and a graceful shutdown, or a worker without HTTP."""

from __future__ import annotations

import logging
import signal
import socket
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from functools import partial

import uvicorn

from cow_service.api.app import create_app
from cow_service.api.connections import Connection, allow_connections
from cow_service.errors import CowError, StorageUnavailable
from cow_service.jobs.computing import Elsewhere
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.readiness import Readiness
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError
from cow_service.warm_up import warm_up
from cow_service.workers.pool import WorkerPool

EVERYWHERE = ("0.0.0.0", "::")  # addresses at which a server listens, and nobody asks
LOAD_WAIT_SECONDS = 0.5  # that the start waits for models; after that the server answers probes while they load
LOAD_SECONDS = 3600.0  # longest that models may take to load where nothing is asked before
START_POLL_SECONDS = 0.01
CLOSE_SECONDS = 5.0  # for open connections, after the grace period of running jobs

log = logging.getLogger("cow_service")


class Server(uvicorn.Server):
    """Tells the engine as soon as the server is to stop, so that requests that wait for jobs do not hold it up."""

    def __init__(self, config: uvicorn.Config, engine: JobEngine) -> None:
        super().__init__(config)
        self._engine = engine

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listens, and says how to begin."""
        await super().startup(sockets)
        if self.started:
            log.info("open %s/ in a browser", self.address)
            log.info("or try: %s", _example_call(self._engine.service.settings, self.address))

    @property
    def address(self) -> str:
        """Where it listens, once it has started."""
        return _address(self._engine.service.settings.host, self.servers[0].sockets[0].getsockname()[1])

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accepts no more jobs, then closes connections, then lets the app end."""
        self._engine.drain()
        await super().shutdown(sockets)


def _address(host: str, port: int) -> str:
    """Of the server, as this machine reaches it."""
    name = "127.0.0.1" if host in EVERYWHERE else host
    return f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}"


def _example_call(settings: Settings, address: str) -> str:
    """A request from this machine, for a shell."""
    key = ' -H "Authorization: Bearer $COW_API_KEY"' if settings.api_keys else ""
    question = "If the ball falls freely, what does it hit?"
    return f'curl{key} -F image=@photo.jpg -F question="{question}" {address}/simulate'


def _parts(service: Service, pool: WorkerPool | None) -> tuple[JobEngine, Readiness]:
    """The engine of a server of its role, and what tells whether it is ready."""
    if service.settings.role == "api":
        return JobEngine(service, Elsewhere()), Readiness(service, lambda: None)
    if pool is None:
        warm = partial(warm_up, service.settings) if service.settings.warmup else lambda: None
        return JobEngine(service), Readiness(service, warm_up=warm)
    return JobEngine(service, pool), Readiness(service, pool.check)


def run_worker(service: Service, pool: WorkerPool) -> None:
    """Computes jobs of the queues until a signal ends it. Raises the `CowError` for which its backends do not load."""
    ended = threading.Event()

    def end(number: int, frame: object) -> None:
        ended.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    engine = JobEngine(service, pool, "worker")
    try:
        _serve_metrics(service)
        pool.check()
        engine.start()
        log.info("this worker takes jobs: %s", ", ".join(service.settings.queues) or "of all queues")
        ended.wait()
    finally:
        if engine.is_running:
            engine.close()
        pool.close()
        service.close()


def _serve_metrics(service: Service) -> None:
    """Raises `SettingsError` where the port cannot be had."""
    host, port = service.settings.host, service.settings.metrics_port
    if port is None:
        return
    try:
        service.metrics.serve(host, port)
    except OSError as error:
        raise SettingsError(f"Bad settings: COW_METRICS_PORT={port}: {error.strerror or error}.") from error


def run_server(service: Service, pool: WorkerPool | None = None) -> None:
    """Serves until a signal ends it. Jobs are computed by the pool, where there is one.

    Raises the `CowError` for which the default request cannot be served.
    """
    server, engine, readiness = _server(service, pool)

    def failed() -> None:
        server.should_exit = True

    readiness.start(failed)
    try:
        readiness.wait(LOAD_WAIT_SECONDS)
        engine.start()
        server.run()
        readiness.wait(0)
    finally:
        readiness.end()


@contextmanager
def serving(service: Service, pool: WorkerPool | None = None) -> Generator[str]:
    """A server in a thread of this process, at the address of the settings; yields that address. Jobs are computed by
    the pool, where there is one.

    Raises the `CowError` for which the default request cannot be served, and `StorageUnavailable`.
    """
    server, engine, readiness = _server(service, pool)
    readiness.start()
    readiness.wait(LOAD_SECONDS)
    failures: list[CowError] = []

    def serve() -> None:
        try:
            engine.start()  # here and not in the caller's thread, whose event loop may be running
            server.run()
        except CowError as error:
            failures.append(error)

    thread = threading.Thread(target=serve, name="cow-server", daemon=True)
    thread.start()
    try:
        while not server.started:
            if not thread.is_alive():
                told = "The server in this process ended before it had begun; its log says why."
                raise failures[0] if failures else StorageUnavailable(told)
            time.sleep(START_POLL_SECONDS)
        yield server.address
    finally:
        server.should_exit = True
        thread.join()


def _server(service: Service, pool: WorkerPool | None) -> tuple[Server, JobEngine, Readiness]:
    """A server that does not run yet, with its parts."""
    settings = service.settings
    engine, readiness = _parts(service, pool)
    config = uvicorn.Config(
        create_app(engine, readiness),
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        ws="none",
        http=Connection,  # h11 whatever is installed: parsers differ on which headers they refuse, and on how long
        timeout_graceful_shutdown=int(settings.shutdown_grace + CLOSE_SECONDS),
    )
    allow_connections()
    return Server(config, engine), engine, readiness
