"""The multimodal LLM of this process as a model of pydantic-ai, which the reader asks like any provider's."""

import asyncio
import gc
import traceback
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field, replace
from threading import Lock, Thread
from typing import Literal

import torch
from pydantic import Field
from pydantic_ai.exceptions import UserError
from pydantic_ai.messages import ModelMessage, ModelResponse
from pydantic_ai.models import Model, ModelRequestParameters
from pydantic_ai.profiles import ModelProfile
from pydantic_ai.settings import ModelSettings

from cow_service.errors import MllmUnavailable
from cow_service.readers.local import generation
from cow_service.readers.local.generation import PendingGeneration
from cow_service.records import Record
from cow_service.weights.device import cpu_threads, is_out_of_memory


class LocalOptions(Record):
    """How an MLLM runs in this process: the section `local` of its manifest."""

    dtype: Literal["float32", "bfloat16", "float16", "auto"] = Field(
        default="auto", description="Of the weights; auto takes them as they are saved."
    )
    max_batch: int = Field(default=4, ge=1, le=256, description="Replies that are written together.")
    max_new_tokens: int = Field(default=2048, ge=1, description="The most tokens of a reply, whatever a request says.")
    threads: int | None = Field(default=None, ge=1, description="Of the CPU; null for PyTorch's own number.")


@dataclass(eq=False)
class BatchWorker:
    """The one thread that runs a model. It lives while there are requests, so that it keeps no idle model alive."""

    generator: generation.BatchGenerator
    name: str
    options: LocalOptions
    _queue: list[PendingGeneration] = field(default_factory=list[PendingGeneration])
    _lock: Lock = field(default_factory=Lock)
    _running: bool = False

    def submit(self, pending: PendingGeneration) -> Future[ModelResponse]:
        """The reply to come; canceling it takes it out of the queue, or ends it at the next token.

        Its errors: `MllmUnavailable` out of memory, and those of `BatchGenerator.generate`.
        """
        with self._lock:
            self._queue.append(pending)
            if not self._running:
                self._running = True
                # No daemon: one that is stopped in the midst of PyTorch's code takes the whole process down with it.
                Thread(target=self._work, name=f"mllm {self.name}").start()
        return pending.future

    def _work(self) -> None:
        with cpu_threads(self.options.threads):
            while True:
                # An empty batch ends the thread, which the lock keeps a new request from missing.
                with self._lock:
                    waiting = [pending for pending in self._queue if not pending.future.done()]
                    batch, self._queue = waiting[: self.options.max_batch], waiting[self.options.max_batch :]
                    self._running = bool(batch)
                if not batch:
                    return
                self._generate(batch)

    def _generate(self, batch: list[PendingGeneration]) -> None:
        """Generates a batch. One that fails is split, until the error has found the request that it belongs to."""
        batch = [pending for pending in batch if not pending.future.done()]
        if not batch:
            return
        try:
            self.generator.generate(batch)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the callers'; the thread has others to serve
            # The failed frames hold their tensors, and live as long as the traceback does.
            traceback.clear_frames(error.__traceback__)
            failed = error
        else:
            return
        gc.collect()
        if self.generator.device.type == "cuda":
            torch.cuda.empty_cache()
        if len(batch) > 1:
            half = len(batch) // 2
            self._generate(batch[:half])
            self._generate(batch[half:])
            return
        if is_out_of_memory(failed):
            failed = MllmUnavailable(
                f"'{self.name}' ran out of memory on {self.generator.device} while it wrote 1 reply. Send a smaller "
                f"image or fewer frames, or set COW_MLLM to a smaller model or COW_DEVICE to a larger device."
            )
        with suppress(InvalidStateError):  # it was canceled
            batch[0].future.set_exception(failed)


PROFILE = ModelProfile(
    supports_tools=False,
    supports_json_schema_output=True,
    default_structured_output_mode="native",
    # A grammar enforces the schema but tells the model nothing, so the prompt describes the schema, too.
    native_output_requires_schema_in_instructions=True,
)


class LocalModel(Model[None]):
    """A model of images and text in this process. Safe to ask from several threads and event loops at once.

    Replies are held to the JSON schema of the request's output, where it has one; a model that thinks first thinks
    freely. Temperature 0 takes the likeliest tokens; where the settings do not say, the checkpoint's own advice counts.
    Calls that wait together are written together, `max_batch` at most: in float32 that changes no reply; in half
    precision it can change a token that was nearly as likely as another.
    """

    unsupported_settings = frozenset(
        {
            "extra_body", "extra_headers", "frequency_penalty", "logit_bias", "max_retries", "parallel_tool_calls",
            "presence_penalty", "service_tier", "stop_sequences", "timeout",
        }
    )  # fmt: skip

    def __init__(
        self,
        name: str,
        generator: generation.BatchGenerator,
        options: LocalOptions,
        settings: ModelSettings | None = None,
    ) -> None:
        """`settings` are what counts where a request says nothing."""
        super().__init__(profile=PROFILE, settings=settings)
        self._name = name
        self._generator = generator
        self._worker = BatchWorker(generator, name, options)

    @property
    def model_name(self) -> str:
        """The name of its manifest."""
        return self._name

    @property
    def deterministic(self) -> bool:
        """Whether temperature 0 gives the same reply in whatever company it is written: so in float32 alone."""
        return self._generator.is_float32

    @property
    def system(self) -> str:
        """Who serves it: this process."""
        return "local"

    async def request(
        self,
        messages: list[ModelMessage],
        model_settings: ModelSettings | None,
        model_request_parameters: ModelRequestParameters,
    ) -> ModelResponse:
        """The reply. Its finish reason is `length` where it was cut off, as the caller's limit or the model's wants it.

        Raises `MllmUnavailable` if memory runs out, `ImageUnreadable` and the other errors of `images.decode` for
        images, and `UserError` for tools, files that are no images, schemas that replies cannot be held to, and
        settings out of range.
        """
        settings, parameters = self.prepare_request(model_settings, model_request_parameters)
        # Decoding images takes long enough to hold up an event loop.
        pending = await asyncio.to_thread(self._pending, messages, settings or ModelSettings(), parameters)
        # Giving up cancels the future, and so takes the call out of the queue or ends its reply.
        reply = await asyncio.wrap_future(self._worker.submit(pending))
        return replace(reply, model_name=self._name, provider_name=self.system)

    def _pending(
        self, messages: list[ModelMessage], settings: ModelSettings, parameters: ModelRequestParameters
    ) -> PendingGeneration:
        if parameters.function_tools:
            raise UserError("A model in this process takes no tools.")
        default = self._generator.default_sampling
        sampling = generation.TokenSampling(
            temperature=settings.get("temperature", default.temperature),
            top_p=settings.get("top_p", default.top_p),
            top_k=settings.get("top_k", default.top_k),
            seed=settings.get("seed"),
        )
        limit = settings.get("max_tokens", self._worker.options.max_new_tokens)
        if sampling.temperature < 0 or not 0 < sampling.top_p <= 1 or sampling.top_k < 0 or limit < 1:
            raise UserError(
                "A model in this process takes a temperature from 0, a top_p above 0 and up to 1, a top_k from 0 and "
                f"max_tokens from 1; not {sampling} and {settings.get('max_tokens')}."
            )
        output = parameters.output_object if parameters.output_mode == "native" else None
        instructions = [part.content for part in self._get_instruction_parts(messages, parameters) or []]
        return PendingGeneration(
            *generation.conversation_of(messages, instructions, self._generator.special_tokens),
            sampling=sampling,
            limit=min(limit, self._worker.options.max_new_tokens),
            grammar=None if output is None else self._generator.grammar(output.json_schema),
        )
