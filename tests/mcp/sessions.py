"""Clients of the Model Context Protocol, and processes that they speak to. Imported inside fixtures: `mcp` is slow."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import AsyncGenerator, Iterator
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal
from conftest import ROOT
from jsonschema import Draft202012Validator
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from mcp.client.streamable_http import streamable_http_client
from mcp_types import CallToolResult, Tool
from servers import SLOW_GENERATOR
from waiting import TIME_LIMIT, eventually

COMMAND = [sys.executable, "-m", "cow_service.cli.main", "mcp"]
# The slow generator of the job tests, slow without being told: the tools take no options of generators.
LAZY = """
from slow_generator import SlowGenerator, SlowOptions


class LazyOptions(SlowOptions):
    seconds: float = 60


class LazyGenerator(SlowGenerator):
    options_model = LazyOptions


def create(settings):
    return LazyGenerator()
"""


def lazy(folder: Path) -> dict[str, str]:
    """Settings with which the generator `lazy` is installed."""
    known = folder / "lazy-1.0.dist-info"
    known.mkdir(parents=True)
    (known / "METADATA").write_text("Metadata-Version: 2.1\nName: lazy\nVersion: 1.0\n")
    (known / "entry_points.txt").write_text("[cow_service.generators]\nlazy = lazy_generator:create\n")
    (folder / "lazy_generator.py").write_text(LAZY)
    return {"PYTHONPATH": os.pathsep.join((str(ROOT), str(SLOW_GENERATOR), str(folder)))}


def environment(**settings: str) -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("COW_")} | settings


@dataclass
class Session:
    """A client of the protocol, connected, for tests that wait."""

    portal: BlockingPortal
    client: Client
    told: list[tuple[float, float | None, str | None]] = field(default_factory=list)

    def tools(self) -> dict[str, Tool]:
        return {tool.name: tool for tool in self.portal.call(self.client.list_tools).tools}

    def call(self, tool: str, **arguments: Any) -> CallToolResult:
        return self.start(tool, **arguments).result()

    def start(self, tool: str, **arguments: Any) -> Future[CallToolResult]:
        self.told.clear()
        return self.portal.start_task_soon(self._call, tool, arguments)

    def data(self, tool: str, result: CallToolResult) -> dict[str, Any]:
        """The structured content, which is as the tool declares it."""
        assert not result.is_error, result.content
        schema = self.tools()[tool].output_schema
        assert schema is not None
        Draft202012Validator.check_schema(schema)
        Draft202012Validator(schema).validate(result.structured_content)
        return result.structured_content

    async def _call(self, tool: str, arguments: dict[str, Any]) -> CallToolResult:
        result = await self.client.call_tool(tool, arguments, progress_callback=self._hear)
        assert isinstance(result, CallToolResult)
        return result

    async def _hear(self, done: float, total: float | None, doing: str | None) -> None:
        self.told.append((done, total, doing))


@contextmanager
def connected(transport: AbstractAsyncContextManager[Any], mode: str = "auto") -> Iterator[Session]:
    with (
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(Client(transport, mode=mode)) as client,
    ):
        yield Session(portal, client)


@contextmanager
def over_stdio(folder: Path, *options: str, mode: str = "auto", **settings: str) -> Iterator[Session]:
    command = StdioServerParameters(
        command=COMMAND[0], args=[*COMMAND[1:], *options], env=environment(**settings), cwd=folder
    )
    with (folder / "log").open("w") as log, connected(stdio_client(command, errlog=log), mode) as session:
        yield session
    assert "Traceback" not in (folder / "log").read_text()


@contextmanager
def over_http(address: str, key: str | None = None, mode: str = "auto") -> Iterator[Session]:
    @asynccontextmanager
    async def transport() -> AsyncGenerator[Any]:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        async with (
            httpx2.AsyncClient(headers=headers, timeout=TIME_LIMIT) as http,
            streamable_http_client(f"{address}/mcp", http_client=http) as streams,
        ):
            yield streams

    with connected(transport(), mode) as session:
        yield session


@contextmanager
def serving(folder: Path, *options: str, **settings: str) -> Iterator[str]:
    """`cow mcp` over HTTP in its own process, at this address."""
    command = [*COMMAND, "--transport", "http", "--port", "0", *options]
    log = folder / "log"
    with log.open("w") as err:
        process = subprocess.Popen(command, env=environment(**settings), stdout=subprocess.PIPE, stderr=err)

    def port() -> str | None:
        assert process.poll() is None, log.read_text()
        _, _, told = log.read_text().partition("running on http://")
        return told.partition(" ")[0].rpartition(":")[2] if " " in told else None

    try:
        yield f"http://127.0.0.1:{eventually(port)}"
        process.terminate()
        out, _ = process.communicate(timeout=TIME_LIMIT)
        assert not out
        assert process.returncode == 0
        assert "Traceback" not in log.read_text()
    finally:
        process.kill()
        process.wait()


class Raw:
    """`cow mcp` over stdio, spoken to in lines, in a process group of its own."""

    def __init__(self, folder: Path) -> None:
        own = environment(COW_DATA_DIR=str(folder / "data"), COW_LOG_LEVEL="debug", **lazy(folder))
        pipes: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen(COMMAND, env=own, start_new_session=True, **pipes)
        self.ids = iter(range(1, 100))
        hello = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "test", "version": "0"}}
        self.send("initialize", hello)

    def __enter__(self) -> Raw:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def send(self, method: str, params: dict[str, Any] | None) -> None:
        message = {"jsonrpc": "2.0", "method": method}
        message |= {} if params is None else {"id": next(self.ids), "params": params}
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(message).encode() + b"\n")
        self.process.stdin.flush()

    def read(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def begin(self, **arguments: Any) -> None:
        """A call whose clip is in the making."""
        assert self.read()["result"]["serverInfo"]["name"] == "cow"
        self.send("notifications/initialized", None)
        meta = {"progressToken": "t"}
        self.send("tools/call", {"name": "simulate", "arguments": arguments, "_meta": meta})
        while self.read()["params"]["message"] != "generation":
            pass

    def ended(self) -> tuple[int, str]:
        """Exit code and log; standard output has nothing else, and no process is left."""
        out, err = self.process.communicate(timeout=TIME_LIMIT)
        assert all(json.loads(line)["jsonrpc"] == "2.0" for line in out.splitlines())
        with pytest.raises(ProcessLookupError):
            os.killpg(self.process.pid, 0)
        return self.process.returncode, err.decode()
