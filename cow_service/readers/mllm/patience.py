"""One request to a multimodal LLM, with what a network does to it: waited for, repeated, and given up in time."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from http import HTTPStatus

import anyio
from pydantic_ai.exceptions import (
    AgentRunError,
    ContentFilterError,
    ModelAPIError,
    ModelAuthenticationError,
    ModelConnectionError,
    ModelContextWindowExceededError,
    ModelHTTPError,
    ModelNotFoundError,
    ModelQuotaExceededError,
    ModelRateLimitError,
    ModelRequestRejectedError,
    ModelTimeoutError,
)
from pydantic_ai.messages import ModelMessage, ModelResponse
from pydantic_ai.models import Model, ModelRequestParameters
from pydantic_ai.models.wrapper import WrapperModel
from pydantic_ai.output import OutputObjectDefinition
from pydantic_ai.settings import ModelSettings
from tenacity import (
    AsyncRetrying,
    RetryCallState,
    retry_if_exception,
    stop_before_delay,
    wait_random_exponential,
)
from tenacity.stop import stop_base

from cow_service.readers.mllm.schemas import Schema

FIRST_WAIT, LONGEST_WAIT = 0.5, 20.0  # seconds before a retry, where the server names no time
UNREACHED = 10.0  # seconds after which an address that takes no connection is given up: a restart takes longer anyway
# Asking again does not help with these.
_FINAL = (ModelRequestRejectedError, ModelQuotaExceededError)
_PASSING = (HTTPStatus.REQUEST_TIMEOUT, HTTPStatus.CONFLICT, HTTPStatus.TOO_EARLY, HTTPStatus.TOO_MANY_REQUESTS)
_WHY: tuple[tuple[type[ModelAPIError], str], ...] = (
    (ModelAuthenticationError, "it refused the key; set COW_MLLM_API_KEY, or the provider's own variable"),
    (ModelNotFoundError, "there is no model of that name; COW_MLLM_MODEL says under which name it is served there"),
    (ModelContextWindowExceededError, "the images and the question are more than it takes; send fewer frames"),
    (ModelQuotaExceededError, "the account's quota is used up"),
    (ModelRateLimitError, "it takes no more requests for now (429); lower COW_MLLM_CONCURRENCY, or try later"),
    (ModelTimeoutError, "it did not reply in time; COW_MLLM_TIMEOUT says how long to wait"),
    (
        ModelConnectionError,
        "it could not be reached, or broke off; check that it runs, and COW_MLLM_BASE_URL",
    ),
)
# What pydantic-ai's and the providers' code raises over a reply that is not shaped as it should be.
_MISSHAPEN = (IndexError, KeyError, TypeError, AttributeError, ValueError)


class OneTry(WrapperModel):
    """A model whose every request ends within `timeout` seconds, with a reply or with `ModelAPIError`."""

    def __init__(self, wrapped: Model, timeout: float) -> None:
        super().__init__(wrapped)
        self._timeout = timeout

    async def request(
        self,
        messages: list[ModelMessage],
        model_settings: ModelSettings | None,
        model_request_parameters: ModelRequestParameters,
    ) -> ModelResponse:
        """One request. Raises `ModelAPIError`, `ContentFilterError`."""
        try:
            with anyio.fail_after(self._timeout):
                return await super().request(messages, model_settings, model_request_parameters)
        except TimeoutError as error:
            raise ModelTimeoutError(self.model_name, f"no reply within {self._timeout:g} s") from error
        except (ModelAPIError, ContentFilterError):
            raise
        except (AgentRunError, *_MISSHAPEN) as error:
            raise ModelAPIError(self.model_name, "the reply was no chat completion") from error


class Patient(WrapperModel):
    """A model that is asked again while that may help and `budget` seconds are not over; it counts the calls."""

    def __init__(self, wrapped: Model, budget: float, schema: Schema | None, count: Callable[[], None]) -> None:
        super().__init__(wrapped)
        self._budget = budget
        self._schema = schema
        self._count = count
        self.failed: ModelAPIError | None = None  # by what the last try failed
        self.cut = False  # whether the last reply ended because it was too long

    async def request(
        self,
        messages: list[ModelMessage],
        model_settings: ModelSettings | None,
        model_request_parameters: ModelRequestParameters,
    ) -> ModelResponse:
        """A reply held to the schema where there is one, after as many tries as it takes. Raises as `OneTry` does."""
        asked = model_request_parameters
        if self._schema is not None:
            # The text is read by our own tolerant rules all the same: a server may ignore the schema.
            asked = replace(asked, output_mode="native", output_object=OutputObjectDefinition(self._schema, "reply"))
        stop = stop_before_delay(self._budget) | _Unreached()
        tries = AsyncRetrying(retry=retry_if_exception(_may_pass), wait=_wait, stop=stop, reraise=True)
        async for attempt in tries:
            with attempt:
                self._count()
                try:
                    response = await super().request(messages, model_settings, asked)
                    self.cut = response.finish_reason == "length"
                    return response
                except ModelAPIError as error:
                    self.failed = error
                    raise
        raise AssertionError("tenacity ends with a result or an exception")


def why(error: ModelAPIError) -> str:
    """What went wrong and what to do about it, in words without addresses, keys or the server's own text."""
    told = next((words for kind, words in _WHY if isinstance(error, kind)), None)
    if told is not None:
        return told
    if isinstance(error, ModelHTTPError):
        return f"it answered with status {error.status_code}"
    return "its reply could not be read; check that COW_MLLM_BASE_URL is that of an OpenAI-compatible server"


def _may_pass(error: BaseException) -> bool:
    if isinstance(error, ModelHTTPError) and error.status_code < HTTPStatus.INTERNAL_SERVER_ERROR:
        return error.status_code in _PASSING
    return isinstance(error, ModelAPIError) and not isinstance(error, _FINAL)


class _Unreached(stop_base):
    """Whether nobody has taken a connection for a while."""

    def __call__(self, retry_state: RetryCallState) -> bool:
        error = retry_state.outcome.exception() if retry_state.outcome else None
        unreached = isinstance(error, ModelConnectionError) and error.phase == "connect"
        return unreached and (retry_state.seconds_since_start or 0.0) > UNREACHED


def _wait(state: RetryCallState) -> float:
    """Seconds until the next try: those that the server asked for, else more each time and never quite the same."""
    error = state.outcome.exception() if state.outcome else None
    asked = error.retry_after if isinstance(error, ModelAPIError) else None
    if asked is not None:
        return asked + random.uniform(0, FIRST_WAIT)  # many callers were told the same
    return wait_random_exponential(FIRST_WAIT, LONGEST_WAIT)(state)
