"""The client of a multimodal LLM: one prompt with its images out, a checked value in, or a typed error."""

from __future__ import annotations

import asyncio
import concurrent.futures
import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import anyio
from pydantic_ai import Agent, BinaryContent, ModelRetry, RunContext, TextOutput
from pydantic_ai.direct import model_request
from pydantic_ai.exceptions import AgentRunError, ContentFilterError, ModelAPIError, ModelHTTPError, UserError
from pydantic_ai.settings import ModelSettings
from pydantic_ai.usage import RunUsage

from cow_service.errors import CowError, InvalidRequest, MllmBadReply, MllmUnavailable
from cow_service.readers.base import ReaderInput
from cow_service.readers.chat import ChatTurn
from cow_service.readers.mllm.chat import completion_of, prepare_chat
from cow_service.readers.mllm.event_loop import EventLoopThread
from cow_service.readers.mllm.images import MEDIA_TYPE
from cow_service.readers.mllm.models import ConfiguredModel
from cow_service.readers.mllm.replies import ReplyError
from cow_service.readers.mllm.retries import RetryingModel, reason_of
from cow_service.readers.mllm.schemas import Schema
from cow_service.readers.prompts import load_prompt
from cow_service.records import Usage
from cow_service.settings import Settings

MAX_REASKS = 2  # times that a model is told what was wrong with its reply
CANCEL_POLL_SECONDS = 0.2
MAX_SEED = 2**31  # what every provider takes is below
SYSTEM_PROMPT = "looking"

_PARSER_BUGS = (ArithmeticError, LookupError, TypeError, ValueError, RecursionError)
_log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class PromptCall(Generic[T]):
    """One call: a prompt with its inputs and images (JPEG), the JSON schema of the reply and the parser of its text.

    `parse` raises `ReplyError` for a reply that cannot be used.
    """

    prompt: str  # name in prompts/
    inputs: dict[str, object]
    images: tuple[bytes, ...]
    schema: Schema
    parse: Callable[[str], T]
    vote: int = 0  # each has a seed of its own
    temperature: float | None = None  # by default that of the manifest


class _ReplyParser:
    """Parses the replies to one call, and remembers what was wrong with the last one."""

    def __init__(self, parse: Callable[[str], Any]) -> None:
        self._parse = parse
        self.fault, self.reply = "it was empty", ""

    def __call__(self, reply: str) -> Any:
        """The value of a reply. Raises `ModelRetry`, which has the model asked again with the reason."""
        self.reply = reply
        try:
            return self._parse(reply)
        except ReplyError as error:
            self.fault = str(error)
            raise ModelRetry(f"That cannot be used: {error}.") from error
        except _PARSER_BUGS as error:  # over something that nobody foresaw; the other votes must not be lost
            _log.warning("a reply could not be parsed", exc_info=error)
            self.fault = "it could not be read"
            raise ModelRetry("That cannot be read. Reply with the JSON object alone.") from error


class MllmClient:
    """Calls one model from any thread, with `COW_MLLM_CONCURRENCY` calls at a time."""

    def __init__(self, model: ConfiguredModel, settings: Settings) -> None:
        self.model = model
        self._name = f"The multimodal LLM '{model.name}'"
        self._timeout, self._budget = settings.mllm_timeout, settings.mllm_budget
        self._slots = asyncio.Semaphore(settings.mllm_concurrency)
        self._instructions = load_prompt(SYSTEM_PROMPT)
        self._agent: Agent[_ReplyParser, Any] = Agent(
            output_type=TextOutput(_parsed),
            deps_type=_ReplyParser,
            retries=MAX_REASKS,
            instructions=self._instructions.render(),
        )
        self._thread = EventLoopThread(model.model)

    def close(self) -> None:
        """Closes its connections; no call can be made any more."""
        self._thread.close()

    def complete(self, call: PromptCall[T], given: ReaderInput) -> T:
        """The parsed reply. Raises `MllmBadReply`, `MllmUnavailable`, and what `given.check_canceled` raises."""
        result = self.complete_all([call], given)[0]
        if isinstance(result, CowError):
            raise result
        return result

    def complete_all(self, calls: Sequence[PromptCall[T]], given: ReaderInput) -> list[T | CowError]:
        """All calls at the same time, each with its parsed reply or the error that it came to.

        Raises what `given.check_canceled` raises, and cancels the calls then.
        """
        if self._thread.closed:
            raise self._closed()
        futures = [self._thread.submit(self._complete(call, given)) for call in calls]
        try:
            waiting = set(futures)
            while waiting:
                given.check_canceled()
                waiting = concurrent.futures.wait(waiting, CANCEL_POLL_SECONDS).not_done
        finally:
            for future in futures:
                future.cancel()  # nothing happens to one that is done
        return [self._closed() if future.cancelled() else future.result() for future in futures]

    async def chat(self, body: dict[str, Any]) -> ChatTurn:
        """The reply to a chat of a caller's own words and settings, asked once.

        Raises `InvalidRequest` and `MllmUnavailable`; what the provider refuses comes back with its status.
        """
        if self._thread.closed:
            raise self._closed()
        return await asyncio.wrap_future(self._thread.submit(self._chat(body)))

    async def _chat(self, body: dict[str, Any]) -> ChatTurn:
        model = self.model.model
        chat = prepare_chat(body, model)
        settings = chat.settings | ModelSettings(timeout=self._timeout, max_retries=0)
        for name in model.unsupported_settings & settings.keys():
            del settings[name]
        try:
            async with self._slots:
                with anyio.fail_after(self._timeout):
                    response = await model_request(
                        model, chat.messages, model_settings=settings, model_request_parameters=chat.parameters
                    )
        except UserError as error:
            raise InvalidRequest(f"{self._name} cannot be asked this: {str(error).splitlines()[0]}") from error
        except ModelHTTPError as error:
            message = f"{self._name} answered with status {error.status_code}: {reason_of(error)}."
            told = {"message": message, "type": "upstream_error", "param": None, "code": str(error.status_code)}
            retry = {} if error.retry_after is None else {"Retry-After": f"{error.retry_after:.0f}"}
            return ChatTurn({"error": told}, error.status_code, chat.warnings, retry)
        except TimeoutError as error:
            raise MllmUnavailable(
                f"{self._name} gave no reply within {self._timeout:g} s (COW_MLLM_TIMEOUT)."
            ) from error
        except ModelAPIError as error:
            raise MllmUnavailable(f"{self._name} could not be asked: {reason_of(error)}.") from error
        except AgentRunError as error:
            raise MllmBadReply(f"{self._name} gave a reply that could not be read.") from error
        return ChatTurn(completion_of(response, self.model.name), warnings=chat.warnings)

    async def _complete(self, call: PromptCall[T], given: ReaderInput) -> T | CowError:
        """The parsed reply, or the error that the call came to: one failed vote must not lose the others."""
        prompt, parser, used = load_prompt(call.prompt), _ReplyParser(call.parse), RunUsage()
        schema = call.schema if self.model.supports_schema else None
        model = RetryingModel(self.model.model, self._slots, self._timeout, self._budget, schema)
        images = [BinaryContent(image, media_type=MEDIA_TYPE) for image in call.images]
        content = [*images, prompt.render(**call.inputs)]
        try:
            with anyio.fail_after(self._budget):
                settings = self._settings(call, given.seed)
                run = await self._agent.run(content, model=model, deps=parser, model_settings=settings, usage=used)
                return cast("T", run.output)
        except CowError as error:  # of a model that runs in this process
            return error
        except (AgentRunError, UserError, TimeoutError) as error:
            return self._error(call, parser, model, error)
        finally:  # in the one thread of the event loop, so that calls at the same time do not lose each other's usage
            given.calls.add(Usage(calls=model.calls, input_tokens=used.input_tokens, output_tokens=used.output_tokens))
            given.calls.prompts |= {prompt.name: prompt.version, SYSTEM_PROMPT: self._instructions.version}

    def _error(self, call: PromptCall[Any], parser: _ReplyParser, model: RetryingModel, error: Exception) -> CowError:
        """The `CowError` for what pydantic-ai raised."""
        tries = f"{model.calls} {'try' if model.calls == 1 else 'tries'}"
        if isinstance(error, UserError):  # what pydantic-ai will not send to this model
            return MllmUnavailable(f"{self._name} cannot be asked this: {str(error).splitlines()[0]}")
        if isinstance(error, ContentFilterError):
            return MllmBadReply(f"{self._name} refused to look at this: its content filter held the reply back.")
        if isinstance(error, TimeoutError):
            reason = "" if model.last_error is None else f": {reason_of(model.last_error)}"
            return MllmUnavailable(
                f"{self._name} gave no usable reply within {self._budget:g} s (COW_MLLM_BUDGET) and {tries}{reason}."
            )
        if isinstance(error, ModelAPIError):
            return MllmUnavailable(f"{self._name} could not be asked ({tries}): {reason_of(error)}.")
        fault = parser.fault
        if model.truncated:
            fault += ", and it was cut off: it has no more room than `max_tokens` of the model's manifest"
        excerpt = " ".join(parser.reply.split())[:160]
        return MllmBadReply(
            f"{self._name} was asked {model.calls} times ({call.prompt}) and gave no reply that can be used. "
            f"Of the last one, '{excerpt}': {fault}."
        )

    def _closed(self) -> MllmUnavailable:
        return MllmUnavailable(f"{self._name} is asked no more: this server is stopping.")

    def _settings(self, call: PromptCall[Any], seed: int | None) -> ModelSettings:
        defaults = self.model.manifest.defaults
        settings = ModelSettings(
            max_tokens=int(defaults.get("max_tokens", 4096)),
            timeout=self._timeout,
            max_retries=0,  # `RetryingModel` retries, and it knows the budget
            framing_announcement="never",
        )
        if "temperature" in defaults:
            wanted = defaults["temperature"] if call.temperature is None else call.temperature
            settings |= ModelSettings(temperature=float(wanted))
            if seed is not None:
                settings |= ModelSettings(seed=seed_of_vote(seed, call.vote))
        for name in self.model.model.unsupported_settings & settings.keys():
            del settings[name]
        return settings


def seed_of_vote(seed: int, vote: int) -> int:
    """The seed that a vote is sent with: the request's for the first one, a digest of both for the others.

    Seeds in a row would give requests with neighbouring seeds votes in common.
    """
    if vote == 0:
        return seed % MAX_SEED
    return int.from_bytes(hashlib.sha256(f"{seed} {vote}".encode()).digest()[:8]) % MAX_SEED


def _parsed(context: RunContext[_ReplyParser], reply: str) -> Any:
    return context.deps(reply)
