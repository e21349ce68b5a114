"""Asks a multimodal LLM: one prompt with its images out, a checked value in, or a typed error."""

from __future__ import annotations

import concurrent.futures
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, Generic, TypeVar, cast

import anyio
from pydantic_ai import Agent, BinaryContent, ModelRetry, RunContext, TextOutput
from pydantic_ai.exceptions import AgentRunError, ContentFilterError, ModelAPIError, UserError
from pydantic_ai.messages import UserContent
from pydantic_ai.models.concurrency import ConcurrencyLimitedModel
from pydantic_ai.settings import ModelSettings
from pydantic_ai.usage import RunUsage

from cow_service.errors import CowError, MllmBadReply, MllmUnavailable
from cow_service.readers.base import Asked
from cow_service.readers.mllm.loop import Loop
from cow_service.readers.mllm.patience import OneTry, Patient, why
from cow_service.readers.mllm.pictures import MEDIA_TYPE
from cow_service.readers.mllm.replies import ReplyError
from cow_service.readers.mllm.schemas import Schema
from cow_service.readers.mllm.serving import Served
from cow_service.readers.prompts import load_prompt
from cow_service.records import Usage
from cow_service.settings import Settings

REASKS = 2  # times that a model is told what was wrong with its reply
POLL = 0.2  # seconds between looks at whether the caller still waits

_UNFORESEEN = (ArithmeticError, LookupError, TypeError, ValueError, RecursionError)
_log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class Question(Generic[T]):
    """One thing to ask: a prompt and its images (JPEG), the shape of the reply and how to read it.

    `read` raises `ReplyError` for a reply that cannot be used.
    """

    prompt: str  # name in prompts/
    inputs: dict[str, object]
    images: tuple[bytes, ...]
    schema: Schema
    read: Callable[[str], T]
    seed: int
    temperature: float | None = None  # by default that of the manifest


@dataclass
class Tally:
    """What has been asked so far."""

    usage: Usage = field(default_factory=Usage)
    prompts: dict[str, int] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def add(self, prompt: str, version: int, usage: Usage) -> None:
        """Counts one question that was asked, whatever came of it."""
        with self._lock:
            self.usage += usage
            self.prompts[prompt] = version


class _Attempt:
    """What happens while one question is asked: its calls and tokens, and what was wrong with the last reply."""

    def __init__(self, read: Callable[[str], Any]) -> None:
        self._read = read
        self.used = RunUsage()
        self.calls = 0
        self.fault: tuple[str, str] | None = None  # the reason, and the reply

    @property
    def usage(self) -> Usage:
        """Calls and tokens, whatever came of them."""
        return Usage(calls=self.calls, input_tokens=self.used.input_tokens, output_tokens=self.used.output_tokens)

    def count(self) -> None:
        """One more call."""
        self.calls += 1

    def read(self, reply: str) -> Any:
        """The value of a reply; one that cannot be used has the model asked again, with the reason."""
        try:
            return self._read(reply)
        except ReplyError as error:
            self.fault = str(error), reply
            raise ModelRetry(f"That cannot be used: {error}.") from error
        except _UNFORESEEN as error:  # in whatever a model may write, and no reason to lose the other votes
            _log.warning("a reply could not be read", exc_info=error)
            self.fault = "it could not be read", reply
            raise ModelRetry("That cannot be read. Reply with the JSON object alone.") from error


class Asker:
    """Asks one model; from several threads at once, `COW_MLLM_CONCURRENCY` calls at a time."""

    def __init__(self, served: Served, settings: Settings) -> None:
        self.served = served
        self._budget = settings.mllm_budget
        tried = OneTry(served.model, settings.mllm_timeout)
        self._model = ConcurrencyLimitedModel(tried, settings.mllm_concurrency)
        self._timeout = settings.mllm_timeout
        instructions = load_prompt("looking")
        self._looking = instructions.version
        self._agent: Agent[Any, Any] = Agent(
            output_type=TextOutput(_read),
            deps_type=object,
            retries=REASKS,
            instructions=instructions.render(),
        )
        self._loop = Loop(served.model)

    def close(self) -> None:
        """Closes its connections; it can ask no more."""
        self._loop.close()

    def ask(self, question: Question[T], tally: Tally, asked: Asked) -> T:
        """The reply, read. Raises `MllmBadReply`, `MllmUnavailable`, and what `asked.still_wanted` raises."""
        told = self.ask_all([question], tally, asked)[0]
        if isinstance(told, CowError):
            raise told
        return told

    def ask_all(self, questions: Sequence[Question[T]], tally: Tally, asked: Asked) -> list[T | CowError]:
        """All replies at the same time, each read, or the error that it came to. Raises what `still_wanted` raises."""
        if self._loop.is_closed:
            raise self._closed()
        futures = [self._loop.submit(self._ask(each, tally)) for each in questions]
        try:
            with asked.elsewhere():
                waiting = set(futures)
                while waiting:
                    asked.still_wanted()
                    waiting = concurrent.futures.wait(waiting, POLL).not_done
        finally:
            for future in futures:
                future.cancel()  # nothing happens to one that is done
        return [self._closed() if future.cancelled() else future.result() for future in futures]

    async def _ask(self, question: Question[T], tally: Tally) -> T | CowError:
        """The reply, read, or the error that asking came to: one failed vote must not lose the others."""
        prompt, attempt = load_prompt(question.prompt), _Attempt(question.read)
        schema = question.schema if self.served.holds_to_schema else None
        model = Patient(self._model, self._budget, schema, attempt.count)
        images = [BinaryContent(image, media_type=MEDIA_TYPE) for image in question.images]
        content: list[UserContent] = [*images, prompt.render(**question.inputs)]
        try:
            with anyio.fail_after(self._budget):
                run = await self._agent.run(
                    content,
                    model=model,
                    deps=attempt.read,
                    model_settings=self._settings(question),
                    usage=attempt.used,
                )
                return cast("T", run.output)
        except CowError as error:  # of a model that runs in this process
            return error
        except (AgentRunError, UserError, TimeoutError) as error:
            return self._error(question, attempt, model, error)
        finally:
            tally.add(question.prompt, prompt.version, attempt.usage)
            tally.add("looking", self._looking, Usage())

    def _error(self, question: Question[Any], attempt: _Attempt, model: Patient, error: Exception) -> CowError:
        """What asking came to, as ours."""
        tries = f"{attempt.calls} {'try' if attempt.calls == 1 else 'tries'}"
        if isinstance(error, UserError):  # what pydantic-ai will not send to this model
            return MllmUnavailable(f"{self._name} cannot be asked this: {str(error).splitlines()[0]}")
        if isinstance(error, ContentFilterError):
            return MllmBadReply(f"{self._name} refused to look at this: its content filter held the reply back.")
        if isinstance(error, TimeoutError):
            told = "" if model.failed is None else f": {why(model.failed)}"
            return MllmUnavailable(
                f"{self._name} gave no usable reply within {self._budget:g} s (COW_MLLM_BUDGET) and {tries}{told}."
            )
        if isinstance(error, ModelAPIError):
            return MllmUnavailable(f"{self._name} could not be asked ({tries}): {why(error)}.")
        reason, reply = attempt.fault or ("it was empty", "")
        if model.cut:
            reason += ", and it was cut off: it has no more room than `max_tokens` of the model's manifest"
        excerpt = " ".join(reply.split())[:160]
        return MllmBadReply(
            f"{self._name} was asked {attempt.calls} times ({question.prompt}) and gave no reply that can be used. "
            f"Of the last one, '{excerpt}': {reason}."
        )

    def _closed(self) -> MllmUnavailable:
        return MllmUnavailable(f"{self._name} is asked no more: this server is stopping.")

    @property
    def _name(self) -> str:
        return f"The multimodal LLM '{self.served.name}'"

    def _settings(self, question: Question[Any]) -> ModelSettings:
        defaults = self.served.manifest.defaults
        temperature = question.temperature if question.temperature is not None else defaults.get("temperature")
        settings = ModelSettings(
            max_tokens=int(defaults.get("max_tokens", 4096)),
            timeout=self._timeout,
            max_retries=0,  # `Patient` repeats, and it knows the budget
            framing_announcement="never",
        )
        if temperature is not None and "temperature" in defaults:
            settings["temperature"] = float(temperature)
            settings["seed"] = question.seed
        for name in self.served.model.unsupported_settings & settings.keys():
            del settings[name]
        return settings


def _read(context: RunContext[Any], reply: str) -> Any:
    """Hands a reply to the question that it answers."""
    return context.deps(reply)
