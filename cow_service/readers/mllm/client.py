"""The client of a multimodal LLM: one prompt with its images out, a checked value in, or a typed error."""

import asyncio
import concurrent.futures
import hashlib
import logging
import random
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from http import HTTPStatus
from threading import Thread
from typing import Any, Generic, TypeVar, cast

import anyio
from pydantic_ai import Agent, BinaryContent, ModelRetry, TextOutput
from pydantic_ai import exceptions as errors
from pydantic_ai import messages as ai
from pydantic_ai.direct import model_request
from pydantic_ai.models import ModelRequestParameters
from pydantic_ai.models.wrapper import WrapperModel
from pydantic_ai.output import OutputObjectDefinition
from pydantic_ai.settings import ModelSettings
from pydantic_ai.usage import RunUsage
from tenacity import AsyncRetrying, RetryCallState, retry_if_exception, wait_random_exponential

from cow_service.adaptive import BUSY, AdaptivePlaces
from cow_service.errors import CowError, InvalidRequest, MllmBadReply, MllmRefused, MllmUnavailable
from cow_service.net import EgressError
from cow_service.readers.base import CallLog, ReaderInput
from cow_service.readers.chat import ChatTurn, log_refusal
from cow_service.readers.mllm.capabilities import MAX_STEPS, REFUSED, CapabilityStore
from cow_service.readers.mllm.chat import completion_of, prepare_chat
from cow_service.readers.mllm.coordinates import MEDIA_TYPE
from cow_service.readers.mllm.known import UNKNOWN, MllmNotes
from cow_service.readers.mllm.models import ConfiguredModel
from cow_service.readers.mllm.replies import ReplyError, Schema
from cow_service.readers.mllm.sheets import fit_images
from cow_service.readers.prompts import load_prompt
from cow_service.records import Usage
from cow_service.settings import Settings

MAX_REASKS = 2  # repeats in which a model hears what was wrong with its reply
CANCEL_POLL_SECONDS = 0.2
MAX_SEED = 2**31  # what every provider takes is below
SYSTEM_PROMPT = "looking"

PARSER_BUGS = (ArithmeticError, LookupError, TypeError, ValueError, RecursionError)
log = logging.getLogger("cow_service")

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
    vote: int = 0  # each has its own seed
    temperature: float | None = None  # by default that of the manifest


@dataclass
class _ReplyParser(Generic[T]):
    """Parses the replies to one call, and remembers what was wrong with the last one."""

    parse: Callable[[str], T]
    fault: str = "it was empty"
    reply: str = ""
    usable: T | None = None  # of a reply that was asked for again for the rest

    def read(self, reply: str) -> T:
        """The value of a reply. Raises `ModelRetry`, which has the model asked again with the reason."""
        self.reply = reply
        try:
            return self.parse(reply)
        except ReplyError as error:
            if self.usable is not None:
                return self.usable if error.usable is None else cast("T", error.usable)
            self.fault, self.usable = str(error), cast("T | None", error.usable)
            raise ModelRetry(f"That cannot be used: {error}.") from error
        except PARSER_BUGS as error:  # on an unforeseen reply; the other votes must not be lost
            log.warning("a reply could not be parsed", exc_info=error)
            self.fault = "it could not be read"
            raise ModelRetry("That cannot be read. Reply with the JSON object alone.") from error


class MllmClient:
    """Calls one model from any thread: as many calls at a time as it takes, `COW_MLLM_CONCURRENCY` at most."""

    def __init__(self, model: ConfiguredModel, settings: Settings) -> None:
        self.model = model
        self._name = f"The multimodal LLM '{model.name}'"
        self.timeout, self.budget = settings.mllm_timeout, settings.mllm_budget
        self.places = AdaptivePlaces(settings.mllm_concurrency)
        self.notes = MllmNotes(settings.data_dir, model.server, model.name)
        self.capabilities = CapabilityStore(self.notes, model.first)
        self.measured = self.notes.measured
        coordinates = (self.measured and self.measured.coordinates) or model.family.coordinates
        self.family = model.family.model_copy(update={"coordinates": coordinates})
        self._instructions = load_prompt(SYSTEM_PROMPT)
        self._agent = Agent(retries=MAX_REASKS, instructions=self._instructions.render())
        self._thread = EventLoopThread(model)

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
        chat = prepare_chat(body, self.model.model)
        settings = self._supported(chat.settings | ModelSettings(timeout=self.timeout, max_retries=0))
        once = RetryingModel(self, self.budget, CallLog(), retries=False)
        try:
            response = await model_request(
                once, chat.messages, model_settings=settings, model_request_parameters=chat.parameters
            )
        except errors.UserError as error:
            raise InvalidRequest(f"{self._name} cannot be asked this: {str(error).splitlines()[0]}") from error
        except errors.ModelHTTPError as error:
            log_refusal(str(error), self.model.key)
            message = f"{self._name} answered with status {error.status_code}: {reason_of(error)}."
            told = {"message": message, "type": "upstream_error", "param": None, "code": str(error.status_code)}
            retry = {} if error.retry_after is None else {"Retry-After": f"{error.retry_after:.0f}"}
            return ChatTurn({"error": told}, error.status_code, chat.warnings, retry)
        except errors.ModelAPIError as error:
            raise MllmUnavailable(f"{self._name} could not be asked: {reason_of(error)}.") from error
        except TimeoutError as error:
            detail = f"{self._name} accepted no chats for {self.budget:g} s (COW_MLLM_BUDGET)."
            raise MllmUnavailable(detail) from error
        except errors.ContentFilterError as error:
            raise MllmBadReply(f"{self._name} refused to answer: its content filter held the reply back.") from error
        return ChatTurn(completion_of(response, self.model.name), warnings=chat.warnings)

    async def _complete(self, call: PromptCall[T], given: ReaderInput) -> T | CowError:
        """The parsed reply, or the error that the call came to: one failed vote must not lose the others."""
        prompt, parser, used = load_prompt(call.prompt), _ReplyParser(call.parse), RunUsage()
        seconds = self.budget if given.until is None else min(self.budget, given.until - time.time())
        model = LearningModel(self, call, seconds, given.calls)
        defaults = self.model.manifest.defaults
        settings = ModelSettings(
            max_tokens=int(defaults.get("max_tokens", 4096)),
            timeout=self.timeout,
            max_retries=0,  # `RetryingModel` retries, and it knows the budget
            framing_announcement="never",
        )
        if "temperature" in defaults:
            wanted = defaults["temperature"] if call.temperature is None else call.temperature
            settings |= ModelSettings(temperature=float(wanted))
            if given.seed is not None:
                settings |= ModelSettings(seed=seed_of_vote(given.seed, call.vote))
        try:
            with anyio.fail_after(self.budget):
                run = await self._agent.run(
                    prompt.render(**call.inputs),
                    output_type=TextOutput(parser.read),
                    model=model,
                    model_settings=self._supported(settings),
                    usage=used,
                )
                return run.output
        except CowError as error:  # of a model that runs in this process
            return error
        except (errors.AgentRunError, errors.UserError, TimeoutError) as error:
            self.capabilities.give_up()
            return self._error(call, parser, model, error)
        finally:  # in the one thread of the event loop, so that calls at the same time do not lose each other's usage
            tokens = {"input_tokens": used.input_tokens, "output_tokens": used.output_tokens}
            given.calls.usage += Usage(**tokens)
            given.calls.prompts |= {prompt.name: prompt.version, SYSTEM_PROMPT: self._instructions.version}

    def _supported(self, settings: ModelSettings) -> ModelSettings:
        for name in self.model.model.unsupported_settings & settings.keys():
            del settings[name]
        return settings

    def _error(
        self, call: PromptCall[Any], parser: _ReplyParser[Any], model: "RetryingModel", error: Exception
    ) -> CowError:
        """The `CowError` for what pydantic-ai raised."""
        tries = f"{model.calls} {'try' if model.calls == 1 else 'tries'}"
        if isinstance(error, errors.UserError):  # what pydantic-ai will not send to this model
            return MllmUnavailable(f"{self._name} cannot be asked this: {str(error).splitlines()[0]}")
        if isinstance(error, errors.ContentFilterError):
            return MllmBadReply(f"{self._name} refused to look at this: its content filter held the reply back.")
        if isinstance(error, (TimeoutError, errors.ModelAPIError)):
            said = [each for each in model.failures if not isinstance(each, errors.ModelTimeoutError)]
            refusal = self._refusal(said[-1]) if said else None
            if refusal is not None and refusal["status"] != HTTPStatus.TOO_MANY_REQUESTS:
                failed: CowError = MllmRefused(f"{self._name} rejected the call ({call.prompt}): {model.reasons}.")
            elif isinstance(error, TimeoutError):
                reasons = f": {model.reasons}" if model.failures else ""
                budget = f"{model.seconds:.3g} s (COW_MLLM_BUDGET, or a chat's `Prefer: wait`)"
                failed = MllmUnavailable(f"{self._name} gave no usable reply within {budget} and {tries}{reasons}.")
            else:
                failed = MllmUnavailable(f"{self._name} could not be asked ({tries}): {model.reasons}.")
            failed.refusal = refusal
            return failed
        fault = parser.fault
        if model.truncated:
            fault += ", and it was cut off: it has no more room than `max_tokens` of the model's manifest"
        excerpt = " ".join(parser.reply.split())[:160]
        return MllmBadReply(
            f"{self._name} was asked {model.calls} times ({call.prompt}) and gave no usable reply. "
            f"Of the last one, '{excerpt}': {fault}."
            + " `cow models check` tells how it writes places."
            * (self.model.manifest.name == UNKNOWN)
        )

    def _refusal(self, error: errors.ModelAPIError) -> dict[str, Any] | None:
        """The refusal of the model's server, for callers of `/v1`; None if the caller cannot fix it."""
        is_own = isinstance(error, errors.ModelQuotaExceededError)
        if is_own or not isinstance(error, errors.ModelHTTPError) or error.status_code not in _CALLERS_STATUS:
            return None
        message = f"{self._name} refused the call: {reason_of(error)}."
        return {"status": error.status_code, "message": message, "retry_after": error.retry_after}

    def _closed(self) -> MllmUnavailable:
        return MllmUnavailable(f"{self._name} is not called any more: this server is stopping.")


def seed_of_vote(seed: int, vote: int) -> int:
    """The seed that a vote is sent with: the request's for the first one, a digest of both for the others.

    Seeds in a row would give requests with neighbouring seeds votes in common.
    """
    if vote == 0:
        return seed % MAX_SEED
    return int.from_bytes(hashlib.sha256(f"{seed} {vote}".encode()).digest()[:8]) % MAX_SEED


MIN_BACKOFF, MAX_BACKOFF = 0.5, 20.0  # seconds before a retry, where the server names no time
CONNECT_SECONDS = 10.0  # after which an address that accepts no connection is given up: a restart takes longer anyway
_NEVER_RETRIED = (errors.ModelRequestRejectedError, errors.ModelQuotaExceededError)
_RETRIED_STATUS = (
    HTTPStatus.REQUEST_TIMEOUT, HTTPStatus.CONFLICT, HTTPStatus.TOO_EARLY, HTTPStatus.TOO_MANY_REQUESTS,
)  # fmt: skip
# Of what was asked, or how often: not of this server's key, address or account.
_CALLERS_STATUS = (
    HTTPStatus.BAD_REQUEST, HTTPStatus.REQUEST_ENTITY_TOO_LARGE, HTTPStatus.UNPROCESSABLE_ENTITY,
    HTTPStatus.TOO_MANY_REQUESTS,
)  # fmt: skip
_REASONS: tuple[tuple[type[errors.ModelAPIError], str], ...] = (
    (errors.ModelAuthenticationError, "it refused the key; set COW_MLLM_API_KEY, or the provider's own variable"),
    (
        errors.ModelNotFoundError,
        "there is no model of that name; COW_MLLM_MODEL says under which name it is served there",
    ),
    (
        errors.ModelContextWindowExceededError,
        "the images and the question are more than it takes; start it with a larger context, or send a smaller image",
    ),
    (errors.ModelQuotaExceededError, "the account's quota is used up"),
    (errors.ModelRateLimitError, "it takes no more requests for now (429); try later"),
    (errors.ModelTimeoutError, "it did not reply in time; COW_MLLM_TIMEOUT says how long to wait"),
    (errors.ModelConnectionError, "it could not be reached, or broke off; check that it runs, and COW_MLLM_BASE_URL"),
)
# What pydantic-ai's and the providers' code raises over a response that is not shaped as it should be.
_MALFORMED = (IndexError, KeyError, TypeError, AttributeError, ValueError, EgressError)


class RetryingModel(WrapperModel):
    """A model that repeats a failed request while that may help: no attempt begins when `seconds` are over.

    Each attempt waits for one of the client's places, within its budget, then takes its `timeout` at most. `calls`
    counts the attempts, and so does the `log`; `failures` keeps the errors of those that failed.
    """

    def __init__(self, client: MllmClient, seconds: float, log: CallLog, *, retries: bool = True) -> None:
        super().__init__(client.model.model)
        self._places, self._timeout, self._retries = client.places, client.timeout, retries
        self.seconds, self._ends = max(0.0, seconds), time.monotonic() + seconds
        self._place_ends = time.monotonic() + client.budget
        self.calls, self._log = 0, log
        self.failures: list[errors.ModelAPIError] = []
        self.truncated = False  # whether the last reply reached the limit of tokens

    @property
    def reasons(self) -> str:
        """Why attempts failed, each reason once: the last attempt alone may hide what the others failed of."""
        return "; ".join(dict.fromkeys(reason_of(error) for error in self.failures))

    async def request(
        self,
        messages: list[ai.ModelMessage],
        model_settings: ModelSettings | None,
        model_request_parameters: ModelRequestParameters,
    ) -> ai.ModelResponse:
        """The reply. Raises `ModelAPIError`, `ContentFilterError`."""

        def is_transient(error: BaseException) -> bool:
            if isinstance(error, errors.ModelHTTPError) and error.status_code < HTTPStatus.INTERNAL_SERVER_ERROR:
                return error.status_code in _RETRIED_STATUS
            return isinstance(error, errors.ModelAPIError) and not isinstance(error, _NEVER_RETRIED)

        def is_over(state: RetryCallState) -> bool:
            """Whether the time ends before the next attempt, or the address has long accepted no connection."""
            error = state.outcome.exception() if state.outcome else None
            refused = isinstance(error, errors.ModelConnectionError) and error.phase == "connect"
            unreachable = refused and (state.seconds_since_start or 0.0) > CONNECT_SECONDS
            too_late = time.monotonic() + state.upcoming_sleep >= self._ends
            return unreachable or too_late or not self._retries

        def seconds_to_wait(state: RetryCallState) -> float:
            """Those that the server asked for, else exponential backoff, with jitter."""
            error = state.outcome.exception() if state.outcome else None
            retry_after = error.retry_after if isinstance(error, errors.ModelAPIError) else None
            if retry_after is not None:
                return retry_after + random.uniform(0, MIN_BACKOFF)  # many callers were told the same
            return wait_random_exponential(MIN_BACKOFF, MAX_BACKOFF)(state)

        retry = retry_if_exception(is_transient)
        retrying = AsyncRetrying(retry=retry, wait=seconds_to_wait, stop=is_over, reraise=True)
        return await retrying(self._attempt, messages, model_settings, model_request_parameters)

    async def _send(
        self, messages: list[ai.ModelMessage], settings: ModelSettings | None, parameters: ModelRequestParameters
    ) -> ai.ModelResponse:
        return await super().request(messages, settings, parameters)

    async def _attempt(
        self, messages: list[ai.ModelMessage], settings: ModelSettings | None, parameters: ModelRequestParameters
    ) -> ai.ModelResponse:
        async with AsyncExitStack() as stack:
            now = time.monotonic()
            # Where the server has asked for a longer pause than there is time, no place comes free in time.
            ends = self._ends if self._places.limit.seconds_paused > self._ends - now else self._place_ends
            try:
                with anyio.fail_after(max(0.0, ends - now)):
                    call = await stack.enter_async_context(self._places.held())
            except TimeoutError as error:  # without a place; what failed before tells more
                if not self.failures and (pause := self._places.limit.seconds_paused):
                    told = errors.ModelHTTPError.for_category(  # as another call was told
                        errors.ModelRateLimitError, status_code=429, model_name=self.model_name, retry_after=pause
                    )
                    self.failures.append(told)
                raise (self.failures[-1] if self.failures else error) from None
            self.calls += 1
            self._log.usage += Usage(calls=1)  # at once: a call that is canceled has been made, too
            try:
                with anyio.fail_after(self._timeout):
                    response = await self._send(messages, settings, parameters)
                call.succeeded = True
            except errors.ContentFilterError:
                raise
            except (errors.AgentRunError, TimeoutError, *_MALFORMED) as error:
                if isinstance(error, errors.ModelAPIError):
                    failure = error
                elif isinstance(error, TimeoutError):
                    failure = errors.ModelTimeoutError(self.model_name, f"no reply within {self._timeout:g} s")
                else:
                    failure = errors.ModelAPIError(self.model_name, "the reply was no chat completion")
                self.failures.append(failure)
                if is_busy(failure):
                    # With a longer pause every other call would fail without having been made.
                    most = max(self._ends - time.monotonic(), self._timeout)
                    call.refuse(failure.retry_after if (failure.retry_after or 0.0) < most else None)
                if failure is error:
                    raise
                raise failure from error
        self.truncated = response.finish_reason == "length"
        return response


class LearningModel(RetryingModel):
    """Asks in the way that the server takes, which its refusals teach."""

    def __init__(self, client: MllmClient, call: PromptCall[Any], seconds: float, log: CallLog) -> None:
        super().__init__(client, seconds, log)
        self._model, self._capabilities, self._call = client.model, client.capabilities, call
        self._takes, self._steps = self._capabilities.current, 0
        self._note, self._is_longer = "", False

    async def _attempt(
        self, messages: list[ai.ModelMessage], settings: ModelSettings | None, parameters: ModelRequestParameters
    ) -> ai.ModelResponse:
        while True:
            self._takes = self._capabilities.current
            try:
                response = await super()._attempt(messages, settings, parameters)
            except errors.ModelAPIError as error:
                self._steps += 1
                if isinstance(error, errors.ModelHTTPError):
                    log_refusal(str(error), self._model.key)
                # A first fault of a server may pass; a refusal of the call itself does not.
                is_refusal = isinstance(error, errors.ModelHTTPError) and error.status_code in REFUSED
                may_pass = not is_refusal and len(self.failures) == 1
                if self._steps > MAX_STEPS or not self._capabilities.refuse(
                    self._takes, error, len(self._call.images), may_pass=may_pass
                ):
                    raise
                self.failures.pop()
            else:
                self._capabilities.succeed(self._takes, len(self._call.images))
                if self._note:
                    self._log.notes[self._note] = None
                response, was_longer = with_text(response), self._is_longer
                self._is_longer = was_longer or self.truncated
                if response.text or was_longer or not self.truncated:
                    return response  # else it was still thinking: once more, with more room

    async def _send(
        self, messages: list[ai.ModelMessage], settings: ModelSettings | None, parameters: ModelRequestParameters
    ) -> ai.ModelResponse:
        takes = self._takes
        fitted = await anyio.to_thread.run_sync(fit_images, self._call.images, takes)
        self._note = fitted.note
        shown = [BinaryContent(each, media_type=MEDIA_TYPE) for each in fitted.jpegs]
        messages = with_shown(messages, [*shown, *([fitted.caption] if fitted.caption else [])])
        sent = (settings or ModelSettings()).copy()
        for name in ("temperature", "seed"):
            if not getattr(takes, name):
                sent.pop(name, None)
        if self._is_longer and (most := sent.get("max_tokens")):
            sent |= ModelSettings(max_tokens=2 * most)
        if takes.output != "prompt":
            # The text is read by our own tolerant rules all the same: a server may ignore the schema.
            parameters = replace(
                parameters,
                output_mode="native" if takes.output == "json_schema" else "prompted",
                output_object=OutputObjectDefinition(self._call.schema, "reply"),
                prompted_output_template=False,  # the prompt shows the shape
            )
        model = self.wrapped if self._model.variant is None else self._model.variant(takes)
        if takes.delivery == "declared":
            sent |= ModelSettings(extra_body={"stream": True})
        if takes.delivery != "streamed":
            return await model.request(messages, sent, parameters)
        async with model.request_stream(messages, sent, parameters) as stream:
            async for _ in stream:
                pass
            return stream.get()


def with_shown(messages: list[ai.ModelMessage], shown: list[ai.UserContent]) -> list[ai.ModelMessage]:
    """Messages with images and their caption before the first prompt."""
    first = cast("ai.ModelRequest", messages[0])
    parts = [
        replace(part, content=[*shown, cast("str", part.content)]) if isinstance(part, ai.UserPromptPart) else part
        for part in first.parts
    ]
    return [replace(first, parts=parts), *messages[1:]]


def with_text(response: ai.ModelResponse) -> ai.ModelResponse:
    """The reply as text: servers put it into a tool call or, with nothing else, at the end of what was thought."""
    if any(isinstance(part, ai.TextPart) and part.content.strip() for part in response.parts):
        return response
    called = [part.args_as_json_str() for part in response.parts if isinstance(part, ai.ToolCallPart)]
    thought = [part.content for part in response.parts if isinstance(part, ai.ThinkingPart) if part.content]
    ended = [text for text in thought if text.rstrip().endswith(("}", "]", "```"))]
    said = called or (ended if response.finish_reason != "length" else [])
    return replace(response, parts=[ai.TextPart(said[-1])]) if said else response


def is_busy(error: errors.ModelAPIError) -> bool:
    """Whether fewer calls at the same time may help."""
    if isinstance(error, errors.ModelHTTPError):
        return error.status_code in BUSY
    return isinstance(error, (errors.ModelTimeoutError, errors.ModelConnectionError))


def reason_of(error: errors.ModelAPIError) -> str:
    """What went wrong and what to do about it, without addresses, keys or the server's own text."""
    for kind, words in _REASONS:
        if isinstance(error, kind):
            return words
    if isinstance(error, errors.ModelHTTPError):
        return f"it answered with status {error.status_code} (COW_LOG_LEVEL=debug logs its own words)"
    return "its reply could not be read; check that COW_MLLM_BASE_URL is that of an OpenAI-compatible server"


CLOSE_SECONDS = 5.0  # that closing waits for connections


class EventLoopThread:
    """Runs the coroutines that call one model. Ends with the process, or earlier by `close`."""

    def __init__(self, model: ConfiguredModel) -> None:
        self._model = model
        self._loop = asyncio.new_event_loop()
        # A daemon, so that a reader that was not closed does not keep the process alive.
        self._thread = Thread(target=self._loop.run_forever, name="mllm", daemon=True)
        self.closed = False
        self._thread.start()
        self.submit(model.model.__aenter__()).result()

    def submit(self, work: Coroutine[Any, Any, T]) -> concurrent.futures.Future[T]:
        """Starts a coroutine; its future may be canceled."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def close(self) -> None:
        """Cancels what is running, closes the connections and ends the thread. May be called twice."""
        if self.closed:
            return
        self.closed = True

        async def end() -> None:
            running = asyncio.all_tasks() - {asyncio.current_task()}
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)
            await self._model.model.__aexit__(None, None, None)
            if self._model.http is not None:
                await self._model.http.aclose()

        concurrent.futures.wait([self.submit(end())], CLOSE_SECONDS)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(CLOSE_SECONDS)
        if not self._thread.is_alive():
            self._loop.close()
