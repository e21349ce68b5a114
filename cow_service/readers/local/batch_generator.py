"""Writes a batch of replies with one model and its processor. Knows no event loop and no queue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from transformers import (
    GenerationConfig,
    LogitsProcessorList,
    PreTrainedModel,
    PreTrainedTokenizerFast,
    ProcessorMixin,
    StoppingCriteriaList,
)

from cow_service.errors import ImageUnreadable
from cow_service.readers.local.conversation import Conversation
from cow_service.readers.local.decoding import BatchRow, Finish, RowSampler, RowsDone, Sampling
from cow_service.readers.local.grammars import Grammars

# With the one, the chat templates of models that think open a reply; the other is the token that ends the thought.
_THOUGHT_START, _THOUGHT_END = "<think>", "</think>"


@dataclass(frozen=True)
class GenerationRequest:
    """What a reply is wanted for. `limit` is the most tokens that it may have; `grammar`, what it is held to."""

    conversation: Conversation
    sampling: Sampling
    limit: int
    grammar: str | None = None


@dataclass(frozen=True)
class Generation:
    """What was written. With the finish `length` it was cut off, and is no whole JSON.

    `thought` is what the model wrote for itself before, where its chat template opens a thought.
    """

    text: str
    thought: str
    finish: Finish
    input_tokens: int
    output_tokens: int


@dataclass(frozen=True, eq=False)
class PendingGeneration:
    """A request and its reply to come. Canceling the future ends the reply at the next token.

    The future is never marked as running: such a future could no longer be canceled.
    """

    request: GenerationRequest
    future: Future[Generation] = field(default_factory=Future[Generation])

    def resolve(self, generation: Generation) -> None:
        """Ends it with its reply, unless it was canceled."""
        with suppress(InvalidStateError):
            self.future.set_result(generation)

    def fail(self, error: BaseException) -> None:
        """Ends it with an error, unless it was canceled."""
        with suppress(InvalidStateError):
            self.future.set_exception(error)


class BatchGenerator:
    """A model of images and text with its processor, as transformers has them."""

    def __init__(self, model: PreTrainedModel, processor: ProcessorMixin) -> None:
        self._model: Any = model
        self._model.eval().requires_grad_(False)
        self._processor: Any = processor
        self._tokenizer: PreTrainedTokenizerFast = self._processor.tokenizer
        advice = model.generation_config or GenerationConfig()
        self.default_sampling = _sampling_of(advice)
        ends = advice.eos_token_id
        self._ends = _as_tuple(self._tokenizer.eos_token_id if ends is None else ends)
        padding = self._tokenizer.pad_token_id
        self._padding: int = self._ends[0] if padding is None else _as_tuple(padding)[0]
        # Else the checkpoint's advice on sampling would be mixed into every call, after ours.
        self._model.generation_config = self._config()
        self.special_tokens = tuple(self._tokenizer.get_added_vocab())
        self.grammars = Grammars(self._tokenizer, self._model.get_output_embeddings().weight.shape[0], self._ends)

    @property
    def is_float32(self) -> bool:
        """Whether it computes in full precision."""
        return self._model.dtype == torch.float32

    @property
    def device(self) -> torch.device:
        """Where its inputs go."""
        return self._model.device

    def generate(self, batch: Sequence[PendingGeneration]) -> None:
        """Writes all replies at once; each future has its result as soon as that reply is complete.

        Raises `ImageUnreadable` for an image that the model's processor refuses, and whatever the model raises.
        """
        conversations = [pending.request.conversation for pending in batch]
        texts: list[str] = [
            self._processor.apply_chat_template(list(each.turns), add_generation_prompt=True, tokenize=False)
            for each in conversations
        ]
        inputs = self._inputs(texts, [list(each.images) for each in conversations])
        counts: list[int] = inputs["attention_mask"].sum(-1).tolist()
        rows = [self._row(*row) for row in zip(batch, texts, counts, strict=True)]
        self._model.generate(
            **inputs,
            generation_config=self._config(
                do_sample=False, max_new_tokens=max(pending.request.limit for pending in batch)
            ),
            logits_processor=LogitsProcessorList([RowSampler(rows, self._padding)]),
            stopping_criteria=StoppingCriteriaList([RowsDone(rows)]),
        )

    def _config(self, **rest: Any) -> GenerationConfig:
        return GenerationConfig(eos_token_id=list(self._ends), pad_token_id=self._padding, **rest)

    def _inputs(self, texts: list[str], images: list[list[Any]]) -> Mapping[str, Any]:
        try:
            # Replies grow on the right, so that padding belongs on the left.
            inputs = self._processor(
                text=texts,
                images=images if any(images) else None,
                padding=True,
                padding_side="left",
                add_special_tokens=False,  # the template has written those that belong there
                return_tensors="pt",
            )
        except ValueError as error:
            if not any(images):
                raise
            raise ImageUnreadable(f"The multimodal LLM does not take such an image: {error}.") from error
        return inputs.to(self._model.device, dtype=self._model.dtype)

    def _row(self, pending: PendingGeneration, text: str, input_tokens: int) -> BatchRow:
        request, thinks = pending.request, text.rstrip().endswith(_THOUGHT_START)
        return BatchRow(
            request.sampling,
            request.limit,
            self._ends,
            None if request.grammar is None else self.grammars.matcher(request.grammar),
            on_end=partial(self._resolve, pending, input_tokens),
            is_canceled=pending.future.done,
            thought_end=self._tokenizer.get_vocab().get(_THOUGHT_END) if thinks else None,
        )

    def _resolve(self, pending: PendingGeneration, input_tokens: int, row: BatchRow, finish: Finish) -> None:
        thought = self._decoded(row.thought).removesuffix(_THOUGHT_END).strip()
        output_tokens = len(row.thought) + len(row.tokens)
        pending.resolve(Generation(self._decoded(row.tokens), thought, finish, input_tokens, output_tokens))

    def _decoded(self, tokens: list[int]) -> str:
        return str(self._tokenizer.decode(tokens, skip_special_tokens=True, clean_up_tokenization_spaces=False))


def _sampling_of(advice: GenerationConfig) -> Sampling:
    if not advice.do_sample:
        return Sampling()
    given = {name: getattr(advice, name) for name in ("temperature", "top_p", "top_k")}
    known: dict[str, Any] = {"temperature": 1.0} | {name: value for name, value in given.items() if value is not None}
    return Sampling(**known)


def _as_tuple(ids: Any) -> tuple[int, ...]:
    return (ids,) if isinstance(ids, int) else tuple(ids)
