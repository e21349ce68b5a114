"""Writes a batch of replies with one model and its processor. Knows no event loop and no queue."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from PIL.Image import Image
from transformers import (
    GenerationConfig,
    LogitsProcessorList,
    PreTrainedModel,
    PreTrainedTokenizerFast,
    ProcessorMixin,
    StoppingCriteriaList,
)

from cow_service.errors import ImageUnreadable
from cow_service.readers.local.chat import Chat
from cow_service.readers.local.decoding import Chooser, Finish, Over, Row, Sampling
from cow_service.readers.local.grammars import Grammars

# With the one, the chat templates of models that think open a reply; the other is the token that ends the thought.
_THOUGHT_START, _THOUGHT_END = "<think>", "</think>"


@dataclass(frozen=True)
class Wish:
    """A reply that is wanted. `limit` is the most tokens that it may have; `grammar`, what it is held to."""

    chat: Chat
    sampling: Sampling
    limit: int
    grammar: str | None = None


@dataclass(frozen=True)
class Reply:
    """What was written. With the finish `length` it was cut off, and is no whole JSON.

    `thought` is what the model wrote for itself before, where its chat template opens a thought.
    """

    text: str
    thought: str
    finish: Finish
    input_tokens: int
    output_tokens: int


@dataclass(frozen=True)
class Order:
    """A wish, whom to tell of its reply, and whether anyone still waits for it."""

    wish: Wish
    told: Callable[[Reply], None]
    wanted: Callable[[], bool]


class Engine:
    """A model of images and text with its processor, as transformers has them."""

    def __init__(self, model: PreTrainedModel, processor: ProcessorMixin) -> None:
        self._model: Any = model
        self._model.eval().requires_grad_(False)
        self._processor: Any = processor
        self._tokenizer: PreTrainedTokenizerFast = self._processor.tokenizer
        advice = model.generation_config or GenerationConfig()
        self.advice = _sampling(advice)
        ends = advice.eos_token_id
        self._ends = _numbers(self._tokenizer.eos_token_id if ends is None else ends)
        padding = self._tokenizer.pad_token_id
        self._padding: int = self._ends[0] if padding is None else _numbers(padding)[0]
        # Else the checkpoint's advice on sampling would be mixed into every call, after ours.
        self._model.generation_config = GenerationConfig(eos_token_id=list(self._ends), pad_token_id=self._padding)
        vocabulary = self._model.get_output_embeddings().weight.shape[0]
        self._grammars = Grammars(self._tokenizer, vocabulary, self._ends)

    @property
    def device(self) -> torch.device:
        """Where its inputs go."""
        return self._model.device

    def special(self) -> tuple[str, ...]:
        """The tokens that mean more than the characters that they are written with."""
        return tuple(self._tokenizer.get_added_vocab())

    def grammar(self, schema: Mapping[str, Any]) -> str:
        """The grammar of a JSON schema. Raises `UserError`, see `Grammars.grammar`."""
        return self._grammars.grammar(schema)

    def write(self, orders: Sequence[Order]) -> None:
        """Writes all replies at once, and tells of each when it is complete.

        Raises `ImageUnreadable` for an image that the model's processor refuses, and whatever the model raises.
        """
        texts = [self._text(order.wish.chat) for order in orders]
        inputs = self._inputs(texts, [list(order.wish.chat.images) for order in orders])
        counts: list[int] = inputs["attention_mask"].sum(-1).tolist()
        rows = [self._row(*row) for row in zip(orders, texts, counts, strict=True)]
        self._model.generate(
            **inputs,
            generation_config=GenerationConfig(
                do_sample=False,
                max_new_tokens=max(order.wish.limit for order in orders),
                eos_token_id=list(self._ends),
                pad_token_id=self._padding,
            ),
            logits_processor=LogitsProcessorList([Chooser(rows, self._padding)]),
            stopping_criteria=StoppingCriteriaList([Over(rows)]),
        )

    def _text(self, chat: Chat) -> str:
        return self._processor.apply_chat_template(list(chat.turns), add_generation_prompt=True, tokenize=False)

    def _inputs(self, texts: list[str], images: list[list[Image]]) -> Mapping[str, Any]:
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

    def _row(self, order: Order, text: str, input_tokens: int) -> Row:
        def told(row: Row) -> None:
            assert row.finish is not None
            thought = self._decoded(row.thought).removesuffix(_THOUGHT_END).strip()
            reply, count = self._decoded(row.tokens), len(row.thought) + len(row.tokens)
            order.told(Reply(reply, thought, row.finish, input_tokens, count))

        wish, thinks = order.wish, text.rstrip().endswith(_THOUGHT_START)
        matcher = None if wish.grammar is None else self._grammars.matcher(wish.grammar)
        thought_end = self._tokenizer.get_vocab().get(_THOUGHT_END) if thinks else None
        return Row(wish.sampling, wish.limit, self._ends, matcher, told, order.wanted, thought_end)

    def _decoded(self, tokens: list[int]) -> str:
        return str(self._tokenizer.decode(tokens, skip_special_tokens=True, clean_up_tokenization_spaces=False))


def _sampling(advice: GenerationConfig) -> Sampling:
    if not advice.do_sample:
        return Sampling()
    given = {name: getattr(advice, name) for name in ("temperature", "top_p", "top_k")}
    known: dict[str, Any] = {"temperature": 1.0} | {name: value for name, value in given.items() if value is not None}
    return Sampling(**known)


def _numbers(ids: Any) -> tuple[int, ...]:
    return (ids,) if isinstance(ids, int) else tuple(ids)
