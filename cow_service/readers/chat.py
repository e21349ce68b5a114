"""Chats with the MLLM of a reader, which such a reader offers besides its readings."""

import logging
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any, Protocol, runtime_checkable

from cow_service.adaptive import AdaptivePlaces
from cow_service.errors import shortened
from cow_service.records import ServerCapabilities

MAX_LOGGED = 2000  # characters of a server's own words


@dataclass(frozen=True)
class Upstream:
    """The OpenAI-compatible server behind a reader: its address, and this server's own credentials for it."""

    base_url: str  # without a slash at its end
    model: str  # as it is served there
    key: str | None = field(default=None, repr=False)


@dataclass(frozen=True)
class ChatTurn:
    """What an MLLM replied, in one piece and in the form of OpenAI's protocol, whichever it was asked over."""

    body: dict[str, Any]  # a chat completion or, where the status is no success, an object with `error`
    status: int = HTTPStatus.OK
    warnings: tuple[str, ...] = ()  # what of the chat could not be sent
    headers: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def succeeded(self) -> bool:
        """Whether it is a completion."""
        return self.status == HTTPStatus.OK


@runtime_checkable
class CallsMllm(Protocol):
    """A reader that calls an MLLM, with a limit of simultaneous calls."""

    @property
    def places(self) -> AdaptivePlaces:
        """Of its calls."""
        ...


@runtime_checkable
class ChatReader(Protocol):
    """A reader with an MLLM behind it."""

    @property
    def upstream(self) -> Upstream | None:
        """Where chats can be sent on as they are; None if its MLLM does not speak OpenAI's protocol."""
        ...

    @property
    def takes(self) -> ServerCapabilities | None:
        """What was learned of that server; None: nothing yet."""
        ...

    async def chat(self, body: dict[str, Any]) -> ChatTurn:
        """The reply to a chat (the JSON object of OpenAI's chat completions), as far as it can be sent.

        Raises `InvalidRequest` for what can neither be sent nor left out, and `MllmUnavailable`.
        """
        ...


def adapted(
    fields: dict[str, Any], messages: list[Any], takes: ServerCapabilities
) -> tuple[dict[str, Any], list[Any], list[str]]:
    """The fields and messages of a chat as its server takes them, and warnings of what could not be sent."""
    refused = [name for name in ("temperature", "seed") if fields.get(name) is not None and not getattr(takes, name)]
    warnings = [f"Not sent: `{name}`. The MLLM's server does not take it." for name in refused]
    sent = {name: value for name, value in fields.items() if name not in refused}
    if takes.token_field == "max_completion_tokens" and "max_tokens" in sent:
        sent.setdefault(takes.token_field, sent.pop("max_tokens"))
    roles = () if takes.system_role else ("system", "developer")
    moved = [isinstance(each, dict) and each.get("role") in roles for each in messages]
    if any(moved):
        messages = [{**each, "role": "user"} if one else each for each, one in zip(messages, moved, strict=True)]
        warnings.append("Sent as messages of the user: those of the system, which the MLLM's server does not take.")
    return sent, messages, warnings


def log_refusal(words: str, key: str | None) -> None:
    """Logs the words of the MLLM's server, without this server's key. Callers are not told them: they may name accounts
    and addresses."""
    said = words.replace(key, "***") if key else words
    logging.getLogger("cow_service").debug("an MLLM refused a call: %s", shortened(said, MAX_LOGGED))
