"""Replies of a model of transformers, a batch at a time: its conversation, its grammar, and how each token is chosen.

`generate` of transformers has one set of sampling settings and one source of randomness for a whole batch. Here the
choice is made in a logits processor, row by row, and `generate` is left with the one token that was chosen. So rows of
any settings and schemas share a batch, and a seed gives the same reply in whatever company it is written.
"""

import itertools
import json
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
import transformers
from llguidance import LLMatcher, LLTokenizer
from llguidance.hf import from_tokenizer
from PIL import Image
from pydantic_ai import messages as ai
from pydantic_ai.exceptions import UserError
from pydantic_ai.usage import RequestUsage
from torch import Tensor

from cow_service.errors import ImageUnreadable
from cow_service.media.images import decode

# One space after commas and colons, as most JSON in training data has it. Free whitespace would let a model write
# line breaks up to the limit of tokens.
_LAYOUT: Any = {"whitespace_flexible": False, "item_separator": ", ", "key_separator": ": "}
_BY_NAME = ("properties", "$defs", "definitions")  # they hold schemas under arbitrary names
_AS_IT_IS = ("allOf", "enum", "const", "default", "examples")  # parts of one object, and values
# With the one, the chat templates of models that think open a reply; the other is the token that ends the thought.
_THOUGHT_START, _THOUGHT_END = "<think>", "</think>"
ANSWER_TOKENS = 1024  # that a thought leaves for the reply, or half of all where those are fewer
Finish = Literal["stop", "length"]
Turn = dict[str, Any]  # as chat templates take it: {"role": ..., "content": [{"type": "text", "text": ...}, ...]}


def conversation_of(
    messages: Iterable[ai.ModelMessage], instructions: Sequence[str], special_tokens: Sequence[str]
) -> tuple[list[Turn], list[Image.Image]]:
    """The turns of prepared messages, and their images in the order of their places there.

    Text that spells one of the special tokens is not taken for it. What one role says in a row is one turn, and texts
    that meet are one text. Raises `UserError` for what such a model cannot be given (tools, files other than images),
    and the errors of `images.decode`.
    """
    # A space goes into every special token that a text spells, or a question could end its turn or claim an image.
    tokens = sorted((token for token in special_tokens if len(token) > 1), key=len, reverse=True)
    special = re.compile("|".join(map(re.escape, tokens)) or r"(?!)")
    turns: list[Turn] = []
    images: list[Image.Image] = []
    said = said_by_role(messages, instructions)
    for role, items in itertools.groupby(said, key=lambda each: each[0]):
        content: list[dict[str, str]] = []
        for _, item in items:
            if isinstance(item, ai.BinaryContent) and item.is_image:
                content.append({"type": "image"})
                images.append(Image.fromarray(decode(item.data).pixels))
                continue
            text = item.content if isinstance(item, ai.TextContent | ai.TextPart) else item
            if not isinstance(text, str):
                kind = type(item).__name__
                raise UserError(f"A model in this process takes text and images (as bytes), not a {kind}.")
            if content and content[-1]["type"] == "text":
                # Joined first: a special token could otherwise come about where two texts meet.
                text = content.pop()["text"] + "\n" + text
            text = special.sub(lambda match: f"{match[0][0]} {match[0][1:]}", text)
            content.append({"type": "text", "text": text})
        turns.append({"role": role, "content": content})
    return turns, images


def said_by_role(messages: Iterable[ai.ModelMessage], instructions: Sequence[str]) -> list[tuple[str, object]]:
    """What each role says, one thing after another."""
    said: list[tuple[str, object]] = [("system", text) for text in instructions]
    for message in messages:
        role = "assistant" if isinstance(message, ai.ModelResponse) else "user"
        for part in message.parts:
            if isinstance(part, ai.SystemPromptPart):
                # Templates take a system turn at the start only.
                opening = all(before == "system" for before, _ in said)
                said.append(("system" if opening else "user", part.content))
            elif isinstance(part, ai.UserPromptPart):
                items = [part.content] if isinstance(part.content, str) else part.content
                said.extend((role, item) for item in items if not isinstance(item, ai.CachePoint))
            elif not isinstance(part, ai.ThinkingPart):
                said.append((role, part))
    return said


def _closed(schema: Any) -> Any:
    """The schema with no other properties than those it names: a model could invent some up to the limit of tokens."""
    if isinstance(schema, list):
        return [_closed(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    found = {
        key: {name: _closed(part) for name, part in value.items()} if key in _BY_NAME else _closed(value)
        for key, value in schema.items()
        if key not in _AS_IT_IS
    }
    found |= {key: value for key, value in schema.items() if key in _AS_IT_IS}
    return {"additionalProperties": False, **found} if "properties" in found else found


@dataclass(frozen=True)
class TokenSampling:
    """How tokens are chosen. Temperature 0 takes the likeliest; without a seed, replies differ from call to call."""

    temperature: float = 0.0
    top_p: float = 1.0
    top_k: int = 0  # 0: no limit
    seed: int | None = None


@dataclass(frozen=True, eq=False)
class PendingGeneration:
    """What a reply is wanted for, and the reply to come. Canceling the future ends the reply at the next token.

    The future is never marked as running: such a future could no longer be canceled. A reply with the finish `length`
    was cut off, and is no whole JSON; what the model wrote for itself before it is a part of its own.
    """

    turns: list[Turn]
    images: list[Image.Image]
    sampling: TokenSampling
    limit: int  # the most tokens that the reply may have
    grammar: str | None = None  # the schema that it is held to
    future: Future[ai.ModelResponse] = field(default_factory=Future[ai.ModelResponse])


@dataclass(eq=False)
class BatchRow:
    """One reply of a batch while it is written. It knows no other row, and not how it came to be in the batch.

    `on_end` is called once, when the reply is complete. Where the reply begins with a thought, `thought_end` is the
    token that ends it, and the grammar holds from there.
    """

    pending: PendingGeneration
    ends: Collection[int]
    matcher: LLMatcher | None
    on_end: Callable[["BatchRow", Finish], None]
    thought_end: int | None = None  # None once the thought is over
    thought: list[int] = field(default_factory=list[int])
    tokens: list[int] = field(default_factory=list[int])
    _is_finished: bool = False
    _random: torch.Generator | None = None

    def done(self) -> bool:
        """Whether nothing more is to be written."""
        return self._is_finished or self.pending.future.done()

    def choose(self, logits: Tensor) -> Tensor:
        """The id, [], of a valid next token of the reply, from logits, [vocabulary]."""
        if self.matcher is not None and self.thought_end is not None:
            room = self.pending.limit - len(self.thought)
            if room <= min(ANSWER_TOKENS, self.pending.limit // 2):  # else nothing would be left of it but the thought
                return torch.tensor(self.thought_end, device=logits.device)
            logits = logits.index_fill(0, torch.tensor(list(self.ends), device=logits.device), -torch.inf)  # too early
        elif self.matcher is not None:
            # llguidance's own function for tensors needs a C++ compiler at run time.
            bits = np.frombuffer(self.matcher.compute_bitmask(), np.uint8)
            allowed = torch.from_numpy(np.unpackbits(bits, count=len(logits), bitorder="little")).to(logits.device)
            logits = logits.masked_fill(allowed == 0, -torch.inf)
        sampling = self.pending.sampling
        if sampling.temperature == 0:
            return logits.argmax()
        scores: Any = logits[None] / sampling.temperature
        none: Any = None  # these ask for the tokens before, and do not use them
        if sampling.top_k > 0:
            scores = transformers.TopKLogitsWarper(sampling.top_k)(none, scores)
        if sampling.top_p < 1:
            scores = transformers.TopPLogitsWarper(sampling.top_p)(none, scores)
        if self._random is None:
            self._random = torch.Generator(logits.device)
            if sampling.seed is None:
                self._random.seed()
            else:
                self._random.manual_seed(sampling.seed)
        return scores[0].softmax(-1).multinomial(1, generator=self._random)[0]

    def take(self, token: int) -> None:
        """Adds the chosen token, and ends the reply where that completes it or reaches its limit.

        Raises `RuntimeError` if the grammar does not go on, which its mask makes impossible.
        """
        if token in self.ends:
            self._end("stop")
            return
        if self.thought_end is not None:
            self.thought.append(token)
            if token == self.thought_end:
                self.thought_end = None
        else:
            self.tokens.append(token)
            if self.matcher is not None and not self.matcher.consume_token(token):
                raise RuntimeError(f"The grammar of a reply failed: {self.matcher.get_error()}")
        if self.matcher is not None and self.matcher.is_stopped():
            self._end("stop")
        elif len(self.thought) + len(self.tokens) >= self.pending.limit:
            complete = self.thought_end is None and self.matcher is not None and self.matcher.is_accepting()
            self._end("stop" if complete else "length")

    def _end(self, finish: Finish) -> None:
        self._is_finished = True
        self.on_end(self, finish)


class RowSampler(transformers.LogitsProcessor):
    """Leaves to each row of a batch the one token that it has chosen; to rows that are over, the one that ends them."""

    def __init__(self, rows: Sequence[BatchRow], end: int) -> None:
        self._rows = rows
        self._end = end

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:
        """`scores` is [rows, vocabulary]; what is returned is 0 at each row's token and minus infinity elsewhere."""
        tokens: list[int] = []
        for row, logits in zip(self._rows, scores, strict=True):
            token = self._end
            if not row.done():
                token = int(row.choose(logits))
                row.take(token)
            tokens.append(token)
        only = torch.tensor(tokens, device=scores.device)[:, None]
        return torch.full_like(scores, -torch.inf).scatter_(1, only, 0.0)


class BatchGenerator:
    """A model of images and text with its processor, as transformers has them."""

    def __init__(self, model: transformers.PreTrainedModel, processor: transformers.ProcessorMixin) -> None:
        self._model: Any = model
        self._model.eval().requires_grad_(False)
        self._processor: Any = processor
        self._tokenizer: transformers.PreTrainedTokenizerFast = self._processor.tokenizer
        advice: Any = model.generation_config or transformers.GenerationConfig()
        self.default_sampling = TokenSampling()
        if advice.do_sample:
            self.default_sampling = TokenSampling(advice.temperature or 1.0, advice.top_p or 1.0, advice.top_k or 0)
        ends: Any = self._tokenizer.eos_token_id if advice.eos_token_id is None else advice.eos_token_id
        self._ends: tuple[int, ...] = (ends,) if isinstance(ends, int) else tuple(ends)
        # Else the checkpoint's advice on sampling would be mixed into every call, after ours.
        self._model.generation_config = self._config()
        self.special_tokens = tuple(self._tokenizer.get_added_vocab())
        self.device = model.device  # where its inputs go
        self.is_float32 = model.dtype == torch.float32
        logits = self._model.get_output_embeddings().weight.shape[0]
        self.grammar_tokens: LLTokenizer = from_tokenizer(self._tokenizer, n_vocab=logits, eos_token=list(self._ends))

    def grammar(self, schema: Mapping[str, Any]) -> str:
        """The grammar of the JSON texts that a schema allows, without properties that it does not name.

        Raises `UserError` for a schema that is wrong or that says what cannot be held to, such as `uniqueItems`.
        """
        grammar = LLMatcher.grammar_from_json_schema(json.dumps(_closed(schema)), overrides=_LAYOUT)
        is_error, messages = LLMatcher.validate_grammar_with_warnings(grammar, self.grammar_tokens)
        if is_error:
            raise UserError(f"Replies cannot be held to this JSON schema: {messages[0]}")
        return grammar

    def generate(self, batch: Sequence[PendingGeneration]) -> None:
        """Writes all replies at once; each future has its result as soon as that reply is complete.

        Raises `ImageUnreadable` for an image that the model's processor refuses, and whatever the model raises.
        """
        texts: list[str] = [
            self._processor.apply_chat_template(each.turns, add_generation_prompt=True, tokenize=False)
            for each in batch
        ]
        images = [each.images for each in batch]
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
            raise ImageUnreadable(f"The multimodal LLM cannot use this image: {error}.") from error
        inputs = inputs.to(self._model.device, dtype=self._model.dtype)
        counts: list[int] = inputs["attention_mask"].sum(-1).tolist()
        rows = [self._row(*row) for row in zip(batch, texts, counts, strict=True)]
        limit = max(pending.limit for pending in batch)
        self._model.generate(
            **inputs,
            generation_config=self._config(do_sample=False, max_new_tokens=limit),
            logits_processor=transformers.LogitsProcessorList([RowSampler(rows, self._ends[0])]),
        )

    def _config(self, **rest: Any) -> transformers.GenerationConfig:
        return transformers.GenerationConfig(eos_token_id=list(self._ends), pad_token_id=self._ends[0], **rest)

    def _row(self, pending: PendingGeneration, text: str, input_tokens: int) -> BatchRow:
        thinks = text.rstrip().endswith(_THOUGHT_START)

        def resolve(row: BatchRow, finish: Finish) -> None:
            thought = self._decoded(row.thought).removesuffix(_THOUGHT_END).strip()
            reply = ai.ModelResponse(
                parts=[*([ai.ThinkingPart(thought)] if thought else []), ai.TextPart(self._decoded(row.tokens))],
                usage=RequestUsage(input_tokens=input_tokens, output_tokens=len(row.thought) + len(row.tokens)),
                finish_reason=finish,
            )
            with suppress(InvalidStateError):  # it was canceled
                pending.future.set_result(reply)

        return BatchRow(
            pending,
            self._ends,
            None if pending.grammar is None else LLMatcher(self.grammar_tokens, pending.grammar),
            on_end=resolve,
            thought_end=self._tokenizer.get_vocab().get(_THOUGHT_END) if thinks else None,
        )

    def _decoded(self, tokens: list[int]) -> str:
        return str(self._tokenizer.decode(tokens, skip_special_tokens=True, clean_up_tokenization_spaces=False))
