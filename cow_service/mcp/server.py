"""The protocol's side: two tools, and the artifacts of their results as resources.

The low-level server of the library takes arguments as they come: its high-level one leaves out those that it does not
know, and reports wrong ones in pydantic's words.
"""

import base64
import logging
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import anyio
import mcp_types as types
from mcp.server.context import ServerRequestContext
from mcp.server.lowlevel import Server
from mcp.shared.exceptions import MCPError

from cow_service import __version__
from cow_service.client import AsyncAnswer, AsyncClient, AsyncSimulation, CowError, ImageLike
from cow_service.client.progress import describe
from cow_service.errors import InternalError
from cow_service.mcp import arguments
from cow_service.mcp.results import output_schema, tool_result
from cow_service.media.artifacts import media_type_of
from cow_service.readers.prompts import load_prompt
from cow_service.records import Job
from cow_service.weights.manifests import TOOL_PROMPTS

TITLES: dict[arguments.ToolName, str] = {"simulate": "Imagine the future of an image", "answer": "Imagine, then answer"}
# The tools only read. Repeating a call changes nothing, though a model that samples may answer differently. The world
# is open: images may be fetched, and shown to a provider's model.
HINTS = {"read_only_hint": True, "destructive_hint": False, "idempotent_hint": True, "open_world_hint": True}
MIN_STEP = 1e-4  # the protocol wants progress that grows, and a stage may begin without any

log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class Caller:
    """Who calls a tool. Key and address are known only for calls over HTTP."""

    key: str | None = None
    address: tuple[str, int] | None = None
    forwarded: bool = False  # by a proxy, which may serve any client


Context: TypeAlias = ServerRequestContext[Any]
Connect: TypeAlias = Callable[[Caller], AbstractAsyncContextManager[AsyncClient]]
Lifespan: TypeAlias = Callable[[Server[Any]], AbstractAsyncContextManager[Any]]
Report: TypeAlias = Callable[[float, str], Coroutine[Any, Any, None]]  # the share that is done, 0 to 1, and the stage


def create_server(connect: Connect, lifespan: Lifespan, *, paths: bool, links: bool) -> Server[Any]:
    """The server of the tools.

    `connect` opens the way to COW for one call, and may raise a `CowError`. `paths` says whether images may be files
    of this machine, `links` whether the addresses of artifacts can be opened by others.
    """
    tools = _Tools(connect, paths=paths, links=links)
    return Server(
        "cow",
        title="COW",
        version=__version__,
        instructions=load_prompt("server", TOOL_PROMPTS).render(),
        lifespan=lifespan,
        on_list_tools=tools.list,
        on_call_tool=tools.call,
        on_list_resources=tools.resources,
        on_list_resource_templates=tools.templates,
        on_read_resource=tools.read,
    )


class _Tools:
    def __init__(self, connect: Connect, *, paths: bool, links: bool) -> None:
        self._connect, self._paths, self._links = connect, paths, links
        image = arguments.HELP_WITH_PATHS if paths else arguments.HELP_WITHOUT_PATHS
        limits = load_prompt("limits", TOOL_PROMPTS).render()
        self._listed = [
            types.Tool(
                name=name,
                title=title,
                description=load_prompt(name, TOOL_PROMPTS).render(limits=limits),
                input_schema=arguments.input_schema(name, image),
                output_schema=output_schema(name),
                annotations=types.ToolAnnotations(title=title, **HINTS),
            )
            for name, title in TITLES.items()
        ]

    async def list(self, *_: Any) -> types.ListToolsResult:
        return types.ListToolsResult(tools=self._listed)

    async def call(self, context: Context, params: types.CallToolRequestParams) -> types.CallToolResult:
        """What a tool returns. An error is returned as text, since that is where a model looks."""
        tool = params.name
        if tool not in TITLES:
            raise MCPError(code=types.INVALID_PARAMS, message=f"Unknown tool: {tool[:80]!r}")

        async def report(done: float, stage: str) -> None:
            await context.session.report_progress(done, 1.0, stage)

        try:
            fields = arguments.request_fields(tool, params.arguments or {})
            image = await anyio.to_thread.run_sync(partial(arguments.image_of, fields.pop("image"), paths=self._paths))
            async with self._connect(_caller(context)) as client:
                result = await result_of(client, tool, image, fields, report)
                return await tool_result(result, client, client.base_url if self._links else None)
        except CowError as error:
            log.info("%s failed: %s", tool, error.code)
            failure = error
        except Exception:
            log.exception("%s failed", tool)
            failure = InternalError("An unexpected error happened in the tool. Its log has the trace.")
        return types.CallToolResult(content=[types.TextContent(text=arguments.error_text(failure))], is_error=True)

    async def resources(self, *_: Any) -> types.ListResourcesResult:
        return types.ListResourcesResult(resources=[])

    async def templates(self, *_: Any) -> types.ListResourceTemplatesResult:
        artifact = types.ResourceTemplate(
            uri_template=arguments.ARTIFACTS + "{sha256}",
            name="artifact",
            title="Pictures and videos of results",
            description="The bytes of a picture or video, by the SHA-256 digest in a result.",
        )
        return types.ListResourceTemplatesResult(resource_templates=[artifact])

    async def read(self, context: Context, params: types.ReadResourceRequestParams) -> types.ReadResourceResult:
        uri = str(params.uri)
        sha256 = arguments.digest_of(uri)
        if sha256 is None:
            raise MCPError(code=types.INVALID_PARAMS, message=f"There is no resource {uri[:200]!r}.")
        try:
            async with self._connect(_caller(context)) as client:
                data = await client.artifact(sha256)
        except CowError as error:
            code = types.INVALID_PARAMS if error.code == "artifact-not-found" else types.INTERNAL_ERROR
            raise MCPError(code=code, message=arguments.error_text(error)) from error
        blob = base64.b64encode(data).decode()
        media_type = media_type_of(data) or "application/octet-stream"
        return types.ReadResourceResult(contents=[types.BlobResourceContents(uri=uri, mime_type=media_type, blob=blob)])


def _caller(context: Context) -> Caller:
    """Who made the HTTP request that brought a message: each has its own headers, also within one session."""
    request = context.request
    if request is None:
        return Caller()
    scheme, _, key = request.headers.get("authorization", "").strip().partition(" ")
    address = None if request.client is None else (request.client.host, request.client.port)
    forwarded = any(name in request.headers for name in ("forwarded", "x-forwarded-for", "x-real-ip", "via"))
    return Caller((key.strip() or None) if scheme.lower() == "bearer" else None, address, forwarded)


async def result_of(
    client: AsyncClient, tool: arguments.ToolName, image: ImageLike, fields: dict[str, Any], report: Report
) -> AsyncSimulation | AsyncAnswer:
    """The result of a tool's job. Raises what it failed with. A call that is canceled cancels its job."""
    call: Callable[..., Awaitable[AsyncSimulation | AsyncAnswer]]
    call = client.simulate if tool == "simulate" else client.answer
    result: AsyncSimulation | AsyncAnswer | CowError | None = None
    done, stage = -MIN_STEP, ""

    def on_update(job: Job) -> None:
        nonlocal done, stage
        now = describe(job)
        if job.progress > done or now != stage:
            done, stage = max(job.progress, done + MIN_STEP), now
            reports.start_soon(report, done, stage)

    async with anyio.create_task_group() as reports:
        try:
            result = await call(image, progress=on_update, **fields)
        except CowError as error:  # raised below: the group would wrap it
            result = error
    if isinstance(result, CowError):
        raise result
    assert result is not None
    return result
