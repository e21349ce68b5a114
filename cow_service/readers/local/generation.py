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
from torch import Tensor

from cow_service.errors import ImageUnreadable
from cow_service.media.images import decode

# One space after commas and colons, as most JSON in training data has it. Free whitespace would let a model write
# line breaks up to the limit of tokens.
_LAYOUT: Any = {"whitespace_flexible": False, "item_separator": ", ", "key_separator": ": "}
_BY_NAME = ("properties", "$defs", "definitions")  # what they hold is schemas by names that may be anything
_AS_IT_IS = ("allOf", "enum", "const", "default", "examples")  # parts of one object, and values
# With the one, the chat templates of models that think open a reply; the other is the token that ends the thought.
_THOUGHT_START, _THOUGHT_END = "<think>", "</think>"
Finish = Literal["stop", "length"]
Turn = dict[str, Any]  # as chat templates take it: {"role": ..., "content": [{"type": "text", "text": ...}, ...]}


@dataclass(frozen=True)
class Conversation:
    """All that was said up to the reply that is wanted. `images` are in the order of their places in the turns."""

    turns: tuple[Turn, ...]
    images: tuple[Image.Image, ...]


def conversation_of(
    messages: Iterable[ai.ModelMessage], instructions: Sequence[str], special_tokens: Sequence[str]
) -> Conversation:
    """The conversation of prepared messages. Text that spells one of the special tokens is not taken for it.

    What one role says in a row is one turn, and texts that meet are one text. Raises `UserError` for what such a model
    cannot be given (tools, files other than images), and the errors of `images.decode`.
    """
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

    # A space goes into every special token that a text spells, or a question could end its turn or claim an image.
    tokens = sorted((token for token in special_tokens if len(token) > 1), key=len, reverse=True)
    special = re.compile("|".join(map(re.escape, tokens)) or r"(?!)")
    turns: list[Turn] = []
    images: list[Image.Image] = []
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
    return Conversation(tuple(turns), tuple(images))


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


@dataclass(eq=False)
class BatchRow:
    """One reply of a batch while it is written. It knows no other row, and not how it came to be in the batch.

    `on_end` is called once, when the reply is complete. Where the reply begins with a thought, `thought_end` is the
    token that ends it, and the grammar holds from there.
    """

    sampling: TokenSampling
    limit: int
    ends: Collection[int]
    matcher: LLMatcher | None
    on_end: Callable[["BatchRow", Finish], None]
    is_canceled: Callable[[], bool]
    thought_end: int | None = None  # None once the thought is over
    thought: list[int] = field(default_factory=list[int])
    tokens: list[int] = field(default_factory=list[int])
    _is_finished: bool = False
    _random: torch.Generator | None = None

    def done(self) -> bool:
        """Whether nothing more is to be written."""
        return self._is_finished or self.is_canceled()

    def choose(self, logits: Tensor) -> Tensor:
        """The id, [], of a token with which the reply can go on, from logits, [vocabulary]."""
        if self.matcher is not None and self.thought_end is not None:
            logits = logits.index_fill(0, torch.tensor(list(self.ends), device=logits.device), -torch.inf)  # too early
        elif self.matcher is not None:
            # llguidance's own function for tensors needs a C++ compiler at run time.
            bits = np.frombuffer(self.matcher.compute_bitmask(), np.uint8)
            allowed = torch.from_numpy(np.unpackbits(bits, count=len(logits), bitorder="little")).to(logits.device)
            logits = logits.masked_fill(allowed == 0, -torch.inf)
        if self.sampling.temperature == 0:
            return logits.argmax()
        logits = logits / self.sampling.temperature
        if self.sampling.top_k > 0:
            least = logits.topk(min(self.sampling.top_k, len(logits))).values[-1]
            logits = logits.masked_fill(logits < least, -torch.inf)
        chances = logits.softmax(-1)
        if self.sampling.top_p < 1:
            ordered, order = chances.sort(descending=True)
            # What comes before a token decides about it, so that the likeliest always stays.
            chances = chances.index_fill(0, order[ordered.cumsum(0) - ordered >= self.sampling.top_p], 0.0)
        if self._random is None:
            self._random = torch.Generator(logits.device)
            if self.sampling.seed is None:
                self._random.seed()
            else:
                self._random.manual_seed(self.sampling.seed)
        return chances.multinomial(1, generator=self._random)[0]

    def take(self, token: int) -> None:
        """Adds the chosen token, and ends the reply where that completes it or reaches its limit.

        Raises `RuntimeError` where the grammar does not go on, which its mask makes impossible.
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
                raise RuntimeError(f"The grammar of a reply broke down: {self.matcher.get_error()}")
        if self.matcher is not None and self.matcher.is_stopped():
            self._end("stop")
        elif len(self.thought) + len(self.tokens) >= self.limit:
            complete = self.thought_end is None and self.matcher is not None and self.matcher.is_accepting()
            self._end("stop" if complete else "length")

    def _end(self, finish: Finish) -> None:
        self._is_finished = True
        self.on_end(self, finish)


class RowSampler(transformers.LogitsProcessor):
    """Leaves to each row of a batch the one token that it has chosen; to rows that are over, the padding."""

    def __init__(self, rows: Sequence[BatchRow], padding: int) -> None:
        self._rows = rows
        self._padding = padding

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:
        """`scores` is [rows, vocabulary]; what is returned is 0 at each row's token and minus infinity elsewhere."""
        tokens: list[int] = []
        for row, logits in zip(self._rows, scores, strict=True):
            token = self._padding
            if not row.done():
                token = int(row.choose(logits))
                row.take(token)
            tokens.append(token)
        only = torch.tensor(tokens, device=scores.device)[:, None]
        return torch.full_like(scores, -torch.inf).scatter_(1, only, 0.0)


class RowsDone(transformers.StoppingCriteria):
    """Ends the rows that are complete, and those that nobody waits for any more."""

    def __init__(self, rows: Sequence[BatchRow]) -> None:
        self._rows = rows

    def __call__(self, input_ids: Tensor, scores: Any, **kwargs: Any) -> Any:
        """[rows], bool."""
        return torch.tensor([row.done() for row in self._rows], device=input_ids.device)


@dataclass(frozen=True)
class GenerationRequest:
    """What a reply is wanted for. `limit` is the most tokens that it may have; `grammar`, what it is held to."""

    conversation: Conversation
    sampling: TokenSampling
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


class BatchGenerator:
    """A model of images and text with its processor, as transformers has them."""

    def __init__(self, model: transformers.PreTrainedModel, processor: transformers.ProcessorMixin) -> None:
        self._model: Any = model
        self._model.eval().requires_grad_(False)
        self._processor: Any = processor
        self._tokenizer: transformers.PreTrainedTokenizerFast = self._processor.tokenizer
        advice = model.generation_config or transformers.GenerationConfig()
        given = {name: getattr(advice, name) for name in ("temperature", "top_p", "top_k")}
        known: dict[str, Any] = {"temperature": 1.0}
        known |= {name: value for name, value in given.items() if value is not None}
        self.default_sampling = TokenSampling(**known) if advice.do_sample else TokenSampling()
        ends = advice.eos_token_id
        self._ends = _as_tuple(self._tokenizer.eos_token_id if ends is None else ends)
        padding = self._tokenizer.pad_token_id
        self._padding: int = self._ends[0] if padding is None else _as_tuple(padding)[0]
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
        conversations = [pending.request.conversation for pending in batch]
        texts: list[str] = [
            self._processor.apply_chat_template(list(each.turns), add_generation_prompt=True, tokenize=False)
            for each in conversations
        ]
        images = [list(each.images) for each in conversations]
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
        inputs = inputs.to(self._model.device, dtype=self._model.dtype)
        counts: list[int] = inputs["attention_mask"].sum(-1).tolist()
        rows = [self._row(*row) for row in zip(batch, texts, counts, strict=True)]
        limit = max(pending.request.limit for pending in batch)
        self._model.generate(
            **inputs,
            generation_config=self._config(do_sample=False, max_new_tokens=limit),
            logits_processor=transformers.LogitsProcessorList([RowSampler(rows, self._padding)]),
            stopping_criteria=transformers.StoppingCriteriaList([RowsDone(rows)]),
        )

    def _config(self, **rest: Any) -> transformers.GenerationConfig:
        return transformers.GenerationConfig(eos_token_id=list(self._ends), pad_token_id=self._padding, **rest)

    def _row(self, pending: PendingGeneration, text: str, input_tokens: int) -> BatchRow:
        request, thinks = pending.request, text.rstrip().endswith(_THOUGHT_START)

        def resolve(row: BatchRow, finish: Finish) -> None:
            thought = self._decoded(row.thought).removesuffix(_THOUGHT_END).strip()
            output_tokens = len(row.thought) + len(row.tokens)
            with suppress(InvalidStateError):  # it was canceled
                pending.future.set_result(
                    Generation(self._decoded(row.tokens), thought, finish, input_tokens, output_tokens)
                )

        return BatchRow(
            request.sampling,
            request.limit,
            self._ends,
            None if request.grammar is None else LLMatcher(self.grammar_tokens, request.grammar),
            on_end=resolve,
            is_canceled=pending.future.done,
            thought_end=self._tokenizer.get_vocab().get(_THOUGHT_END) if thinks else None,
        )

    def _decoded(self, tokens: list[int]) -> str:
        return str(self._tokenizer.decode(tokens, skip_special_tokens=True, clean_up_tokenization_spaces=False))


def _as_tuple(ids: Any) -> tuple[int, ...]:
    return (ids,) if isinstance(ids, int) else tuple(ids)
