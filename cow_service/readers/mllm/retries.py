"""A model whose requests are retried with backoff, each attempt and all of them together bounded in time."""

from __future__ import annotations

import asyncio
import random
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
from tenacity import AsyncRetrying, RetryCallState, retry_if_exception, stop_before_delay, wait_random_exponential

from cow_service.readers.mllm.schemas import Schema

MIN_BACKOFF, MAX_BACKOFF = 0.5, 20.0  # seconds before a retry, where the server names no time
CONNECT_SECONDS = 10.0  # after which an address that accepts no connection is given up: a restart takes longer anyway
_NEVER_RETRIED = (ModelRequestRejectedError, ModelQuotaExceededError)
_RETRIED_STATUS = (
    HTTPStatus.REQUEST_TIMEOUT, HTTPStatus.CONFLICT, HTTPStatus.TOO_EARLY, HTTPStatus.TOO_MANY_REQUESTS,
)  # fmt: skip
_REASONS: tuple[tuple[type[ModelAPIError], str], ...] = (
    (ModelAuthenticationError, "it refused the key; set COW_MLLM_API_KEY, or the provider's own variable"),
    (ModelNotFoundError, "there is no model of that name; COW_MLLM_MODEL says under which name it is served there"),
    (ModelContextWindowExceededError, "the images and the question are more than it takes; send fewer frames"),
    (ModelQuotaExceededError, "the account's quota is used up"),
    (ModelRateLimitError, "it takes no more requests for now (429); lower COW_MLLM_CONCURRENCY, or try later"),
    (ModelTimeoutError, "it did not reply in time; COW_MLLM_TIMEOUT says how long to wait"),
    (ModelConnectionError, "it could not be reached, or broke off; check that it runs, and COW_MLLM_BASE_URL"),
)
# What pydantic-ai's and the providers' code raises over a response that is not shaped as it should be.
_MALFORMED = (IndexError, KeyError, TypeError, AttributeError, ValueError)


class RetryingModel(WrapperModel):
    """A model that repeats a failed request while that may help and `budget` seconds are not over.

    Each attempt waits for one of `slots`, then takes `timeout` seconds at most. `calls` counts the attempts.
    """

    def __init__(
        self, wrapped: Model, slots: asyncio.Semaphore, timeout: float, budget: float, schema: Schema | None
    ) -> None:
        super().__init__(wrapped)
        self._slots = slots
        self._timeout = timeout
        self._budget = budget
        self._schema = schema
        self.calls = 0
        self.last_error: ModelAPIError | None = None
        self.truncated = False  # whether the last reply reached the limit of tokens

    async def request(
        self,
        messages: list[ModelMessage],
        model_settings: ModelSettings | None,
        model_request_parameters: ModelRequestParameters,
    ) -> ModelResponse:
        """A reply held to the schema where there is one. Raises `ModelAPIError`, `ContentFilterError`."""
        parameters = model_request_parameters
        if self._schema is not None:
            # The text is read by our own tolerant rules all the same: a server may ignore the schema.
            output = OutputObjectDefinition(self._schema, "reply")
            parameters = replace(parameters, output_mode="native", output_object=output)
        retrying = AsyncRetrying(
            retry=retry_if_exception(_is_transient),
            wait=_backoff,
            stop=lambda state: stop_before_delay(self._budget)(state) or _is_unreachable(state),
            reraise=True,
        )
        return await retrying(self._attempt, messages, model_settings, parameters)

    async def _attempt(
        self, messages: list[ModelMessage], settings: ModelSettings | None, parameters: ModelRequestParameters
    ) -> ModelResponse:
        self.calls += 1
        try:
            async with self._slots:
                with anyio.fail_after(self._timeout):
                    response = await super().request(messages, settings, parameters)
        except ContentFilterError:
            raise
        except ModelAPIError as error:
            self.last_error = error
            raise
        except TimeoutError as error:
            self.last_error = ModelTimeoutError(self.model_name, f"no reply within {self._timeout:g} s")
            raise self.last_error from error
        except (AgentRunError, *_MALFORMED) as error:
            self.last_error = ModelAPIError(self.model_name, "the reply was no chat completion")
            raise self.last_error from error
        self.truncated = response.finish_reason == "length"
        return response


def reason_of(error: ModelAPIError) -> str:
    """What went wrong and what to do about it, in words without addresses, keys or the server's own text."""
    for kind, words in _REASONS:
        if isinstance(error, kind):
            return words
    if isinstance(error, ModelHTTPError):
        return f"it answered with status {error.status_code}"
    return "its reply could not be read; check that COW_MLLM_BASE_URL is that of an OpenAI-compatible server"


def _is_transient(error: BaseException) -> bool:
    if isinstance(error, ModelHTTPError) and error.status_code < HTTPStatus.INTERNAL_SERVER_ERROR:
        return error.status_code in _RETRIED_STATUS
    return isinstance(error, ModelAPIError) and not isinstance(error, _NEVER_RETRIED)


def _is_unreachable(state: RetryCallState) -> bool:
    """Whether the address has accepted no connection for a while."""
    error = state.outcome.exception() if state.outcome else None
    refused = isinstance(error, ModelConnectionError) and error.phase == "connect"
    return refused and (state.seconds_since_start or 0.0) > CONNECT_SECONDS


def _backoff(state: RetryCallState) -> float:
    """Seconds until the next attempt: those that the server asked for, else exponential backoff, with jitter."""
    error = state.outcome.exception() if state.outcome else None
    retry_after = error.retry_after if isinstance(error, ModelAPIError) else None
    if retry_after is not None:
        return retry_after + random.uniform(0, MIN_BACKOFF)  # many callers were told the same
    return wait_random_exponential(MIN_BACKOFF, MAX_BACKOFF)(state)
