"""JSON schemas as grammars over the tokens of one model. Knows no tensor and no batch."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from llguidance import LLMatcher, LLTokenizer
from llguidance.hf import from_tokenizer
from pydantic_ai.exceptions import UserError
from transformers import PreTrainedTokenizerFast

# One space after commas and colons, as most JSON in training data has it. Free whitespace would let a model write
# line breaks up to the limit of tokens.
_LAYOUT: Any = {"whitespace_flexible": False, "item_separator": ", ", "key_separator": ": "}
_BY_NAME = ("properties", "$defs", "definitions")  # what they hold is schemas by names that may be anything
_AS_IT_IS = ("allOf", "enum", "const", "default", "examples")  # parts of one object, and values


class Grammars:
    """Grammars of JSON schemas over one tokenizer, for a model with `vocabulary` logits."""

    def __init__(self, tokenizer: PreTrainedTokenizerFast, vocabulary: int, ends: Sequence[int]) -> None:
        self._tokens: LLTokenizer = from_tokenizer(tokenizer, n_vocab=vocabulary, eos_token=list(ends))

    def grammar(self, schema: Mapping[str, Any]) -> str:
        """The grammar of the JSON texts that a schema allows, without properties that it does not name.

        Raises `UserError` for a schema that is wrong or that says what cannot be held to, such as `uniqueItems`.
        """
        grammar = LLMatcher.grammar_from_json_schema(json.dumps(_closed(schema)), overrides=_LAYOUT)
        is_error, messages = LLMatcher.validate_grammar_with_warnings(grammar, self._tokens)
        if is_error:
            raise UserError(f"Replies cannot be held to this JSON schema: {messages[0]}")
        return grammar

    def matcher(self, grammar: str) -> LLMatcher:
        """A new reader of a reply, at its start."""
        return LLMatcher(self._tokens, grammar)


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
