"""Runs one process: an HTTP server with its engine, readiness and a graceful shutdown, or a worker without HTTP."""

import asyncio
import logging
import resource
import signal
import socket
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from functools import partial
from typing import ClassVar

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from cow_service.api.app import create_app
from cow_service.errors import CowError, StorageUnavailable
from cow_service.jobs.computing import Computer
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.readiness import Readiness, warm_up
from cow_service.service import Service
from cow_service.settings import SettingsError
from cow_service.workers.pool import WorkerPool

# That the start waits for the job database, and for models; after that the server answers probes meanwhile.
START_WAIT_SECONDS, LOAD_WAIT_SECONDS = 1.0, 0.5
LOAD_SECONDS = 3600.0  # longest that models may take to load where nothing is asked before
START_POLL_SECONDS = 0.01
CLOSE_SECONDS = 5.0  # for open connections, after the grace period of running jobs

log = logging.getLogger("cow_service")


class Server(uvicorn.Server):
    """Tells the engine as soon as the server is to stop, so that requests that wait for jobs do not hold it up."""

    def __init__(self, config: uvicorn.Config, engine: JobEngine) -> None:
        super().__init__(config)
        self._engine = engine
        self.is_ending = threading.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listens, and logs how to begin."""
        await super().startup(sockets)
        if self.started:
            key = ' -H "Authorization: Bearer $COW_API_KEY"' if self._engine.service.settings.api_keys else ""
            question = "If the ball falls freely, what does it hit?"
            log.info("open %s/ in a browser", self.address)
            log.info('or try: curl%s -F image=@photo.jpg -F question="%s" %s/simulate', key, question, self.address)

    @property
    def address(self) -> str:
        """Where it listens, once it has started, as this machine reaches it."""
        host, port = self._engine.service.settings.host, self.servers[0].sockets[0].getsockname()[1]
        name = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        return f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}"

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Accepts no more jobs, then closes connections, then lets the app end."""
        self.is_ending.set()
        if self._engine.is_running:
            self._engine.drain()
        await super().shutdown(sockets)


def run_worker(service: Service, pool: WorkerPool) -> None:
    """Computes jobs of the queues until a signal ends it. Raises the `CowError` for which its backends do not load."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: ended.set())
    engine = JobEngine(service, pool, "worker")
    try:
        host, port = service.settings.host, service.settings.metrics_port
        if port is not None:
            try:
                service.metrics.serve(host, port)
            except OSError as error:
                raise SettingsError(f"Bad settings: COW_METRICS_PORT={port}: {error.strerror or error}.") from error
        pool.load(ended)
        engine.start_when_possible(ended)
        if ended.is_set():
            return
        log.info("this worker takes jobs")
        ended.wait()
    finally:
        if engine.is_running:
            engine.close()
        pool.close()
        service.close()


def run_server(service: Service, pool: WorkerPool | None = None) -> None:
    """Serves until a signal ends it. Jobs are computed by the pool, where there is one.

    Raises the `CowError` for which the default request cannot be served, and `SettingsError`.
    """
    server, engine, readiness = _server(service, pool)
    failures: list[Exception] = []
    end = partial(setattr, server, "should_exit", True)

    def start() -> None:
        try:
            engine.start_when_possible(server.is_ending)
        except Exception as error:  # noqa: BLE001 # raised where the server ends
            failures.append(error)
            end()

    readiness.start(end)
    try:
        starting = threading.Thread(target=start, name="cow-starting", daemon=True)
        starting.start()  # probes are answered while it waits, and all other requests with 503
        starting.join(START_WAIT_SECONDS)
        if failures:
            raise failures[0]
        try:
            readiness.wait(LOAD_WAIT_SECONDS)
        except CowError:
            server.is_ending.set()
            starting.join()
            if engine.is_running:
                engine.close()
            raise
        server.run()
        readiness.wait(0)
    finally:
        readiness.end()
    if failures:
        raise failures[0]


@contextmanager
def serving(service: Service, pool: WorkerPool | None = None) -> Generator[str]:
    """A server in a thread of this process, at the address of the settings; yields that address. Jobs are computed by
    the pool, where there is one.

    Raises the `CowError` for which the default request cannot be served, and `StorageUnavailable`.
    """
    server, engine, readiness = _server(service, pool)
    readiness.start()
    readiness.wait(LOAD_SECONDS)

    failures: list[CowError | SettingsError] = []

    def serve() -> None:
        try:
            engine.start()  # here and not in the caller's thread, whose event loop may be running
            server.run()
        except (CowError, SettingsError) as error:
            failures.append(error)

    # A daemon: a program that ends without closing this, as Inspect does, would wait for a pool's threads for ever.
    thread = threading.Thread(target=serve, name="cow-server", daemon=True)
    thread.start()
    try:
        while not server.started:
            if not thread.is_alive():
                told = "The server in this process ended before it was ready; its log says why."
                raise failures[0] if failures else StorageUnavailable(told)
            time.sleep(START_POLL_SECONDS)
        yield server.address
    finally:
        server.should_exit = True
        thread.join()


def _server(service: Service, pool: WorkerPool | None) -> tuple[Server, JobEngine, Readiness]:
    """A server of its role that does not run yet, its engine, and its readiness check."""
    settings = service.settings
    if settings.role == "api":
        engine, readiness = JobEngine(service, Computer()), Readiness(service, lambda: None)
    elif pool is not None:
        engine, readiness = JobEngine(service, pool), Readiness(service, pool.load, fault=pool.fault)
    else:
        warm = partial(warm_up, settings) if settings.warmup else lambda: None
        engine, readiness = JobEngine(service), Readiness(service, warm_up=warm)
    config = uvicorn.Config(
        create_app(engine, readiness, starting=False),
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        ws="none",
        http=HttpConnection,  # h11 whatever is installed: parsers differ on which headers they refuse, and on how long
        backlog=MAX_ACCEPTED,
        timeout_graceful_shutdown=int(settings.shutdown_grace + CLOSE_SECONDS),
    )
    allow_connections()
    return Server(config, engine), engine, readiness


REQUEST_SECONDS = 20.0  # for a request's line and headers, from the connection or the first byte behind a response
MAX_CONNECTIONS = 10_000
MAX_ACCEPTED = 64  # at a time, before one more than `most` is noticed, closed and gone: some turns of the event loop
RESERVED_FILES = 384  # of what the system lets this process open: for databases, artifacts, other servers, and those


class HttpConnection(H11Protocol):
    """uvicorn's HTTP/1.1 connection. It is closed where no request comes in time.

    Where there are more than `most`, one that has never sent any is closed for the next, the oldest first.
    """

    most: ClassVar[int] = MAX_CONNECTIONS
    _timer: asyncio.TimerHandle | None = None

    @property
    def waits(self) -> bool:
        """Whether there is no request that is being received or answered."""
        return self.cycle is None or self.cycle.response_complete  # pyright: ignore[reportUnnecessaryComparison]

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begins to wait for a request."""
        super().connection_made(transport)
        self._start_timer()
        if len(self.connections) > self.most:
            alive = [each for each in self.connections if not each.transport.is_closing()]
            idle = [each for each in alive if isinstance(each, HttpConnection) and each.waits]
            min(idle, key=lambda each: each.priority).close()

    def data_received(self, data: bytes) -> None:
        """Goes on to wait where the headers are not all there."""
        super().data_received(data)
        if self.waits:
            self._start_timer()
        else:
            self._stop_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stops waiting."""
        self._stop_timer()
        super().connection_lost(exc)

    @property
    def priority(self) -> tuple[bool, float]:
        """Which of two waiting ones stays, the larger: one that had a request before, then the one that came later."""
        timer = self._timer or self.timeout_keep_alive_task
        return bool(self.cycle), 0.0 if timer is None else timer.when()

    def close(self) -> None:
        """Closes the connection unless it has a request by now."""
        self._timer = None
        if self.waits and not self.transport.is_closing():
            self.transport.close()

    def _start_timer(self) -> None:
        if self._timer is None:  # slow bytes give no new time
            self._timer = self.loop.call_later(REQUEST_SECONDS, self.close)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def allow_connections() -> None:
    """Raises the number of files that this process may open as far as the system lets it, and fits `most` to it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_CONNECTIONS + RESERVED_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        HttpConnection.most = max(soft // 2, min(MAX_CONNECTIONS, soft - RESERVED_FILES))
