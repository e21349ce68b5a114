"""The toy multimodal LLM of this process, and how tests ask it. Imports torch: import it inside fixtures and tests."""

from __future__ import annotations

import asyncio
import io
import threading
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from PIL import Image
from pydantic_ai.messages import BinaryContent, ModelMessage, ModelRequest, ModelResponse, TextPart, UserPromptPart
from pydantic_ai.models import ModelRequestParameters
from pydantic_ai.output import OutputObjectDefinition
from pydantic_ai.settings import ModelSettings

from cow_service.readers.local.generation import BatchGenerator, PendingGeneration
from cow_service.readers.local.model import LocalModel, LocalOptions
from cow_service.readers.local.tiny import make_tiny
from cow_service.weights.manifests import load_manifests

NAME = "tiny-qwen3-vl"
Call = Coroutine[Any, Any, ModelResponse]


class Toy:
    """The toy's weights and processor, the batches that it was given, and how often it was run."""

    def __init__(self, **advice: Any) -> None:
        self.batches: list[Sequence[PendingGeneration]] = []
        self.runs = 0
        self.weights, self.processor = make_tiny(load_manifests()[NAME].architecture)
        self.weights.generation_config.update(**advice)
        self.weights.register_forward_pre_hook(self._count)
        self.generator = _Noting(self)

    def _count(self, *_: Any) -> None:
        self.runs += 1

    def model(self, name: str = NAME, settings: ModelSettings | None = None, **options: Any) -> LocalModel:
        """The model behind a queue of its own."""
        chosen = LocalOptions.model_validate({"max_new_tokens": 4096, "threads": 1} | options)
        return LocalModel(name, self.generator, chosen, settings)

    @classmethod
    def another(cls, **advice: Any) -> Toy:
        """One of its own, whose checkpoint gives this advice."""
        return cls(**advice)

    @contextmanager
    def noted(self) -> Iterator[list[int]]:
        """The sizes of the batches that are written in the block."""
        sizes, before = list[int](), len(self.batches)
        yield sizes
        sizes += [len(batch) for batch in self.batches[before:]]

    @staticmethod
    def picture(seed: int = 0, width: int = 64, height: int = 96) -> BinaryContent:
        """Noise; the toy sees it in (width / 32) * (height / 32) tokens."""
        noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
        file = io.BytesIO()
        Image.fromarray(noise).save(file, "PNG")
        return BinaryContent(file.getvalue(), media_type="image/png")

    @staticmethod
    def ask(model: LocalModel, *content: Any, schema: dict[str, Any] | None = None, **rest: Any) -> Call:
        return Toy.say(model, [ModelRequest([UserPromptPart(list(content))])], schema, **rest)

    @staticmethod
    async def say(
        model: LocalModel, messages: list[ModelMessage], schema: dict[str, Any] | None = None, **rest: Any
    ) -> ModelResponse:
        parameters = ModelRequestParameters()
        if schema is not None:
            parameters = ModelRequestParameters(output_mode="native", output_object=OutputObjectDefinition(schema))
        return await model.request(messages, ModelSettings(**rest), parameters)

    @staticmethod
    def text(response: ModelResponse) -> str:
        (part,) = response.parts
        assert isinstance(part, TextPart)
        return part.content

    @staticmethod
    def now(*asked: Call) -> list[ModelResponse]:
        async def together() -> list[ModelResponse]:
            return await asyncio.gather(*asked)

        return asyncio.run(together())

    @staticmethod
    def is_idle(name: str) -> bool:
        """Whether the thread that runs a model has ended."""
        return not any(thread.name == f"mllm {name}" for thread in threading.enumerate())


class _Noting(BatchGenerator):
    def __init__(self, toy: Toy) -> None:
        super().__init__(toy.weights, toy.processor)
        self._toy = toy

    def generate(self, batch: Sequence[PendingGeneration]) -> None:
        self._toy.batches.append(list(batch))
        super().generate(batch)
