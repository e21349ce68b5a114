"""Errors under `/v1`: problems as elsewhere, each with the member `error` that OpenAI's clients read."""

from __future__ import annotations

import re
from http import HTTPStatus
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cow_service.api.openai.records import ChatError, ChatProblem
from cow_service.api.problems import MEDIA_TYPE
from cow_service.errors import TYPE_PREFIX
from cow_service.records import Problem

ROOT = "/v1/"
TYPES = {
    HTTPStatus.UNAUTHORIZED: "authentication_error",
    HTTPStatus.FORBIDDEN: "permission_error",
    HTTPStatus.TOO_MANY_REQUESTS: "rate_limit_error",
}


def chat_problem(problem: Problem) -> ChatProblem:
    """A problem with what OpenAI's clients read."""
    other = "server_error" if problem.status >= HTTPStatus.INTERNAL_SERVER_ERROR else "invalid_request_error"
    error = ChatError(
        message=problem.detail,
        type=TYPES.get(HTTPStatus(problem.status), other),
        param=_parameter(problem.errors[0].pointer) if problem.errors else None,
        code=problem.type.removeprefix(TYPE_PREFIX),
    )
    return ChatProblem(**dict(problem), error=error)


class ChatProblems:
    """ASGI middleware, the outermost: adds the member `error` to every problem under `/v1`."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on; a response that is a problem is buffered and extended."""
        if scope["type"] != "http" or not scope["path"].startswith(ROOT):
            await self.app(scope, receive, send)
            return
        start: Message | None = None
        body = b""

        async def extended(message: Message) -> None:
            nonlocal start, body
            if message["type"] == "http.response.start" and _is_problem(message):
                start = message
            elif start is None:
                await send(message)
            else:
                body += message.get("body", b"")
                if not message.get("more_body", False):
                    text = chat_problem(Problem.model_validate_json(body)).model_dump_json().encode()
                    MutableHeaders(scope=start)["Content-Length"] = str(len(text))
                    await send(start)
                    await send({**message, "body": text})

        await self.app(scope, receive, extended)


def document_problems(document: dict[str, Any]) -> None:
    """Puts their shape into the contract."""
    reference = {"$ref": f"#/components/schemas/{ChatProblem.__name__}"}
    for path, operations in document["paths"].items():
        for operation in operations.values() if path.startswith(ROOT) else ():
            for response in operation["responses"].values():
                if problem := response.get("content", {}).get(MEDIA_TYPE):
                    problem["schema"] = reference


def _is_problem(start: Message) -> bool:
    return Headers(raw=start["headers"]).get("content-type") == MEDIA_TYPE


def _parameter(pointer: str) -> str | None:
    """A JSON Pointer as OpenAI writes places: messages[0].content."""
    parts = [part.replace("~1", "/").replace("~0", "~") for part in pointer.split("/")[1:]]
    written = "".join(f"[{part}]" if re.fullmatch("[0-9]+", part) else f".{part}" for part in parts)
    return written.lstrip(".") or None
