"""How each token of a reply is chosen: its grammar first, then its own temperature and its own random numbers.

`generate` of transformers has one set of sampling settings and one source of randomness for a whole batch. Here the
choice is made in a logits processor, row by row, and `generate` is left with the one token that was chosen. So rows of
any settings and schemas share a batch, and a seed gives the same reply in whatever company it is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from llguidance import LLMatcher
from numpy.typing import NDArray
from torch import Tensor
from transformers import LogitsProcessor, StoppingCriteria

Finish = Literal["stop", "length"]


@dataclass(frozen=True)
class Sampling:
    """How tokens are chosen. Temperature 0 takes the likeliest; without a seed, replies differ from call to call."""

    temperature: float = 0.0
    top_p: float = 1.0
    top_k: int = 0  # 0: no limit
    seed: int | None = None


class BatchRow:
    """One reply of a batch while it is written. It knows no other row, and not how it came to be in the batch.

    `on_end` is called once, when the reply is complete. Where the reply begins with a thought, `thought_end` is the
    token that ends it, and the grammar holds from there.
    """

    def __init__(
        self,
        sampling: Sampling,
        limit: int,
        ends: Sequence[int],
        matcher: LLMatcher | None,
        on_end: Callable[[BatchRow, Finish], None],
        is_canceled: Callable[[], bool],
        thought_end: int | None = None,
    ) -> None:
        self.thought: list[int] = []
        self.tokens: list[int] = []
        self._finished = False
        self._matcher = matcher
        self._is_canceled = is_canceled
        self._thought_end = thought_end  # None once the thought is over
        self._sampling = sampling
        self._limit = limit
        self._ends = frozenset(ends)
        self._on_end = on_end
        self._random: torch.Generator | None = None

    def done(self) -> bool:
        """Whether nothing more is to be written."""
        return self._finished or self._is_canceled()

    def allowed(self, vocabulary: int) -> NDArray[np.bool_] | None:
        """[vocabulary]: the tokens with which the reply can go on. None for all."""
        if self._matcher is None:
            return None
        if self._thought_end is not None:
            thinking = np.ones(vocabulary, dtype=np.bool_)
            thinking[list(self._ends)] = False  # the reply is still to come
            return thinking
        # llguidance's own function for tensors needs a C++ compiler at run time.
        bits = np.frombuffer(self._matcher.compute_bitmask(), np.uint8)
        return np.unpackbits(bits, count=vocabulary, bitorder="little").astype(np.bool_)

    def choose(self, logits: Tensor) -> Tensor | None:
        """A token id, [], from the allowed logits, [vocabulary]; None where the likeliest will do."""
        if self._sampling.temperature == 0:
            return None
        logits = logits / self._sampling.temperature
        if self._sampling.top_k > 0:
            least = logits.topk(min(self._sampling.top_k, len(logits))).values[-1]
            logits = logits.masked_fill(logits < least, -torch.inf)
        chances = logits.softmax(-1)
        if self._sampling.top_p < 1:
            ordered, order = chances.sort(descending=True)
            # What comes before a token decides about it, so that the likeliest always stays.
            chances = chances.index_fill(0, order[ordered.cumsum(0) - ordered >= self._sampling.top_p], 0.0)
        if self._random is None:
            self._random = torch.Generator(logits.device)
            if self._sampling.seed is None:
                self._random.seed()
            else:
                self._random.manual_seed(self._sampling.seed)
        return chances.multinomial(1, generator=self._random)[0]

    def take(self, token: int) -> None:
        """Adds the chosen token, and ends the reply where that completes it or reaches its limit.

        Raises `RuntimeError` where the grammar does not go on, which its mask makes impossible.
        """
        if token in self._ends:
            self._end("stop")
            return
        if self._thought_end is not None:
            self.thought.append(token)
            if token == self._thought_end:
                self._thought_end = None
        else:
            self.tokens.append(token)
            if self._matcher is not None and not self._matcher.consume_token(token):
                raise RuntimeError(f"The grammar of a reply broke down: {self._matcher.get_error()}")
        if self._matcher is not None and self._matcher.is_stopped():
            self._end("stop")
        elif len(self.thought) + len(self.tokens) >= self._limit:
            self._end("stop" if self._complete() else "length")

    def _complete(self) -> bool:
        return self._thought_end is None and self._matcher is not None and self._matcher.is_accepting()

    def _end(self, finish: Finish) -> None:
        self._finished = True
        self._on_end(self, finish)


class RowSampler(LogitsProcessor):
    """Leaves to each row of a batch the one token that it has chosen; to rows that are over, the padding."""

    def __init__(self, rows: Sequence[BatchRow], padding: int) -> None:
        self._rows = rows
        self._padding = padding

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:
        """`scores` is [rows, vocabulary]; what is returned is 0 at each row's token and minus infinity elsewhere."""
        scores = scores.masked_fill(~self._allowed(scores), -torch.inf)
        chosen = scores.argmax(-1)
        for i, row in enumerate(self._rows):
            if not row.done() and (token := row.choose(scores[i])) is not None:
                chosen[i] = token
        tokens: list[int] = chosen.tolist()
        for i, row in enumerate(self._rows):
            if row.done():
                tokens[i] = self._padding
            else:
                row.take(tokens[i])
        only = torch.tensor(tokens, device=scores.device)[:, None]
        return torch.full_like(scores, -torch.inf).scatter_(1, only, 0.0)

    def _allowed(self, scores: Tensor) -> Tensor:
        """[rows, vocabulary], bool: the tokens with which each grammar can go on. Without a grammar, all."""
        allowed = np.ones(tuple(scores.shape), dtype=np.bool_)
        for i, row in enumerate(self._rows):
            if not row.done() and (tokens := row.allowed(scores.shape[1])) is not None:
                allowed[i] = tokens
        return torch.from_numpy(allowed).to(scores.device)


class RowsDone(StoppingCriteria):
    """Ends the rows that are complete, and those that nobody waits for any more."""

    def __init__(self, rows: Sequence[BatchRow]) -> None:
        self._rows = rows

    def __call__(self, input_ids: Tensor, scores: Any, **kwargs: Any) -> Any:
        """[rows], bool."""
        return torch.tensor([row.done() for row in self._rows], device=input_ids.device)
