"""The multimodal LLM of this process, at toy size: the real classes, a real grammar, a real queue."""

from __future__ import annotations

import asyncio
import gc
import io
import json
import threading
import time
import weakref
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jinja2 import UndefinedError
from llguidance import LLMatcher
from PIL import Image
from pydantic import BaseModel, Field
from pydantic_ai import Agent, ModelRetry
from pydantic_ai.exceptions import UserError
from pydantic_ai.messages import (
    BinaryContent,
    ModelMessage,
    ModelRequest,
    ModelResponse,
    SystemPromptPart,
    TextPart,
    ThinkingPart,
    UserPromptPart,
)
from pydantic_ai.models import ModelRequestParameters
from pydantic_ai.output import OutputObjectDefinition
from pydantic_ai.settings import ModelSettings
from safetensors.torch import load_file, save_file

from cow_service.errors import (
    CheckpointInvalid,
    CowError,
    ImageUnreadable,
    MllmUnavailable,
    ReaderUnavailable,
    WeightsUnavailable,
)
from cow_service.readers.local import reader
from cow_service.readers.local.generation import (
    BatchGenerator,
    BatchRow,
    PendingGeneration,
    TokenSampling,
    conversation_of,
)
from cow_service.readers.local.model import LocalModel, LocalOptions
from cow_service.readers.local.reader import device_map, load_local
from cow_service.readers.local.tiny import NAME, SPECIAL, TEMPLATE, THOUGHT, make_tiny
from cow_service.readers.mllm.coordinates import CoordinateFrame
from cow_service.readers.mllm.locate import locate_schema
from cow_service.settings import Settings
from cow_service.weights.manifests import Coordinates, Manifest, Source, load_manifests

pytestmark = pytest.mark.slow

BOX = {
    "type": "object",
    "properties": {
        "reasoning": {"type": "string", "maxLength": 12},
        "bbox_2d": {
            "type": "array",
            "items": {"type": "integer", "minimum": 0, "maximum": 1000},
            "minItems": 4,
            "maxItems": 4,
        },
    },
    "required": ["reasoning", "bbox_2d"],
}
LONG = {"type": "string", "minLength": 3000}  # a reply that takes its time: some ten seconds


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> LocalModel:
    return load_local(told(tmp_path_factory.mktemp("toy")))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved") / "own"
    model, processor = make_tiny(load_manifests()[NAME].architecture)
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


def told(data: Path, **rest: Any) -> Settings:
    return Settings(**({"data_dir": data, "mllm": NAME, "device": "cpu"} | rest))


def picture(seed: int = 0, width: int = 64, height: int = 96) -> BinaryContent:
    """Noise; the toy sees it in (width / 32) * (height / 32) tokens."""
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).save(file, "PNG")
    return BinaryContent(file.getvalue(), media_type="image/png")


def ask(
    model: LocalModel, *content: Any, schema: dict[str, Any] | None = None, **rest: Any
) -> Coroutine[Any, Any, Any]:
    return say(model, [ModelRequest([UserPromptPart(list(content))])], schema, **rest)


async def say(
    model: LocalModel, messages: list[ModelMessage], schema: dict[str, Any] | None = None, **rest: Any
) -> ModelResponse:
    parameters = ModelRequestParameters()
    if schema is not None:
        parameters = ModelRequestParameters(output_mode="native", output_object=OutputObjectDefinition(schema))
    # The toy's manifest wants chance; a test wants it only where it says so.
    calm = ModelSettings(temperature=0.0) if model.model_name == NAME else ModelSettings()
    return await model.request(messages, calm | ModelSettings(**rest), parameters)


def text(response: ModelResponse) -> str:
    (part,) = response.parts
    assert isinstance(part, TextPart)
    return part.content


def now(*asked: Coroutine[Any, Any, ModelResponse]) -> list[ModelResponse]:
    async def together() -> list[ModelResponse]:
        return await asyncio.gather(*asked)

    return asyncio.run(together())


def batches(model: LocalModel, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The sizes of the batches that are written from here on."""
    sizes: list[int] = []
    generate = model._generator.generate

    def listening(batch: list[PendingGeneration]) -> None:
        sizes.append(len(batch))
        generate(batch)

    monkeypatch.setattr(model._generator, "generate", listening)
    return sizes


def another(model: LocalModel, **rest: Any) -> LocalModel:
    """The same weights behind a queue of its own."""
    return LocalModel(
        NAME, model._generator, LocalOptions.model_validate({"max_new_tokens": 4096, "threads": 1} | rest)
    )


# What is said.


def test_a_reply(toy: LocalModel) -> None:
    (found,) = now(ask(toy, "what?", picture(), max_tokens=20))
    assert found.finish_reason == "length"
    assert found.usage.output_tokens == 20
    assert (found.model_name, toy.model_name, toy.system) == (NAME, NAME, "local")
    assert text(found)


def test_a_reply_is_held_to_its_schema_whatever_the_seed(toy: LocalModel) -> None:
    asked = [ask(toy, f"seed {seed}", schema=BOX, temperature=2.0, seed=seed, max_tokens=400) for seed in range(12)]
    for found in now(*asked):
        reply = json.loads(text(found))
        assert found.finish_reason == "stop"
        assert fits(BOX, reply), reply
        assert reply.keys() == BOX["properties"].keys()  # in this order, and no other


def leaves() -> st.SearchStrategy[dict[str, Any]]:
    return st.one_of(
        st.integers(0, 8).map(lambda most: {"type": "string", "maxLength": most}),
        st.tuples(st.integers(-50, 50), st.integers(0, 50)).map(
            lambda ends: {"type": "integer", "minimum": ends[0], "maximum": sum(ends)}
        ),
        st.lists(st.text(max_size=5), min_size=1, max_size=3, unique=True).map(lambda words: {"enum": words}),
        st.sampled_from([{"type": "boolean"}, {"type": "null"}]),
    )


def inner(parts: st.SearchStrategy[dict[str, Any]]) -> st.SearchStrategy[dict[str, Any]]:
    names = st.sampled_from(["reasoning", "bbox_2d", "properties", "ü"])
    return st.one_of(
        st.tuples(parts, st.integers(0, 2), st.integers(0, 2)).map(
            lambda found: {
                "type": "array",
                "items": found[0],
                "minItems": found[1],
                "maxItems": found[1] + found[2],
            }
        ),
        st.dictionaries(names, parts, min_size=1, max_size=3).map(
            lambda found: {"type": "object", "properties": found, "required": sorted(found)}
        ),
    )


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(schema=inner(st.recursive(leaves(), inner, max_leaves=3)), seed=st.integers(0, 2**31))
def test_any_schema(toy: LocalModel, schema: dict[str, Any], seed: int) -> None:
    (found,) = now(ask(toy, "?", schema=schema, temperature=1.5, seed=seed, max_tokens=600))
    assert found.finish_reason == "stop"
    assert fits(schema, json.loads(text(found)))


def fits(schema: dict[str, Any], value: Any) -> bool:
    if "enum" in schema:
        return value in schema["enum"]
    match schema["type"]:
        case "string":
            return isinstance(value, str) and len(value) <= schema["maxLength"]
        case "integer":
            return type(value) is int and schema["minimum"] <= value <= schema["maximum"]
        case "boolean":
            return isinstance(value, bool)
        case "null":
            return value is None
        case "array":
            return schema["minItems"] <= len(value) <= schema["maxItems"] and all(
                fits(schema["items"], item) for item in value
            )
        case _:
            parts = schema["properties"]
            return value.keys() == parts.keys() and all(fits(parts[name], value[name]) for name in parts)


def test_a_reply_that_is_cut_off_says_so(toy: LocalModel) -> None:
    whole, cut = now(ask(toy, "?", schema=BOX), ask(toy, "?", schema=BOX, max_tokens=9))
    assert (whole.finish_reason, cut.finish_reason) == ("stop", "length")
    assert text(whole).startswith(text(cut).rstrip("\ufffd"))
    exact = now(ask(toy, "?", schema=BOX, max_tokens=whole.usage.output_tokens))[0]
    assert (exact.finish_reason, text(exact)) == ("stop", text(whole))


def test_a_reply_is_no_longer_than_its_manifest_allows(toy: LocalModel) -> None:
    (found,) = now(ask(another(toy, max_new_tokens=7), "?", max_tokens=50))
    assert (found.finish_reason, found.usage.output_tokens) == ("length", 7)


@pytest.mark.parametrize("schema", [{"type": "array", "uniqueItems": True}, {"type": "nonsense"}])
def test_a_schema_that_replies_cannot_be_held_to(toy: LocalModel, schema: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="cannot be held to this JSON schema"):
        now(ask(toy, "?", schema=schema))


@pytest.mark.parametrize("wrong", [{"temperature": -1.0}, {"top_p": 0.0}, {"top_k": -1}, {"max_tokens": 0}])
def test_settings_out_of_range(toy: LocalModel, wrong: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="temperature from 0"):
        now(ask(toy, "?", **wrong))


def test_an_agent_asks_again_with_the_reason(toy: LocalModel) -> None:
    """What the reader does: a native output, checked, and refused once."""

    class Place(BaseModel):
        reasoning: str = Field(max_length=8)
        x: int = Field(ge=0, le=1000)

    agent = Agent(toy, output_type=Place, instructions="Be brief.", retries=1)
    seen: list[Place] = []

    @agent.output_validator
    def twice(found: Place) -> Place:
        seen.append(found)
        if len(seen) == 1:
            raise ModelRetry("x is not in the picture")
        return found

    found = asyncio.run(agent.run(["where?", picture()]))
    assert found.output == seen[1]
    assert found.usage.requests == 2
    assert [message.kind for message in found.all_messages()] == ["request", "response"] * 2


SAID = {"reasoning": "", "label": "ball", "bbox_2d": [1, 2, 30, 40]}
HOW = {"cue": "text", "along_arrow": None, "camera": None, "direction": [1, 2, 3, 4]}
CUBE = {"label": "cube", "bbox_2d": [50, 2, 90, 40]}


@pytest.mark.parametrize(
    ("reply", "allowed"),
    [
        (SAID | {"others": []} | HOW, True),
        (SAID | {"size": 0.25, "others": [CUBE, CUBE | {"stands_on": "floor", "shape": "box"}]} | HOW, True),
        (SAID | {"height_above": 1.5, "others": []} | HOW | {"depth_degrees": -30, "speed": "slow"}, True),
        (SAID | {"size": 0.25, "bbox_2d": None, "others": []} | HOW, True),
        (SAID | {"size": -1, "others": []} | HOW, False),
        (SAID | {"others": [CUBE | {"shape": "blob"}]} | HOW, False),
        (SAID | {"others": []} | HOW | {"speed": "slow", "depth_degrees": 120}, False),
        (SAID | {"others": []}, False),
    ],
)
def test_a_reply_may_leave_out_what_is_optional_and_nothing_else(toy: LocalModel, reply: Any, allowed: bool) -> None:
    coordinates = Coordinates(units="thousandths", box="bbox_2d")
    schema = locate_schema(CoordinateFrame(640, 480, (640, 480), coordinates), True, True, 100)
    generator = toy._generator
    matcher = LLMatcher(generator.grammar_tokens, generator.grammar(schema))
    tokens = generator.grammar_tokens.tokenize_str(json.dumps(reply))
    assert (matcher.validate_tokens(tokens) == len(tokens)) == allowed
    if allowed:
        assert matcher.consume_tokens(tokens)
        assert matcher.is_accepting()


# How tokens are chosen.


def test_a_seed_gives_the_same_reply_in_any_company(toy: LocalModel) -> None:
    def sampled(seed: int) -> Coroutine[Any, Any, ModelResponse]:
        return ask(toy, "say", temperature=1.0, seed=seed, max_tokens=12)

    (alone,) = now(sampled(5))
    among = now(ask(toy, "greedy", max_tokens=12), sampled(4), sampled(5), ask(toy, "box", schema=BOX))
    assert text(among[2]) == text(alone)
    assert text(among[1]) != text(alone)
    unseeded = now(*[ask(toy, "say", temperature=1.0, max_tokens=12) for _ in range(3)])
    assert len({text(found) for found in unseeded}) > 1


def test_only_full_precision_promises_the_same_reply(toy: LocalModel) -> None:
    assert toy.deterministic
    model, processor = make_tiny(load_manifests()[NAME].architecture)
    assert not LocalModel("half", BatchGenerator(model.to(torch.bfloat16), processor), LocalOptions()).deterministic


def test_a_checkpoints_own_advice_counts_where_nothing_is_said() -> None:
    model, processor = make_tiny(load_manifests()[NAME].architecture)
    model.generation_config.update(do_sample=True, temperature=0.7, top_p=0.8, top_k=20)
    generator = BatchGenerator(model, processor)
    assert generator.default_sampling == TokenSampling(temperature=0.7, top_p=0.8, top_k=20)
    assert (
        len(
            {
                text(found)
                for found in now(
                    *[ask(LocalModel("advised", generator, LocalOptions()), "?", max_tokens=9) for _ in range(4)]
                )
            }
        )
        > 1
    )
    calm = LocalModel("calm", generator, LocalOptions(), ModelSettings(temperature=0, max_tokens=9))
    assert len({text(found) for found in now(*[ask(calm, "?") for _ in range(4)])}) == 1


def test_a_model_that_thinks_first() -> None:
    """The thought is free and kept apart; the reply after it is held to the schema."""
    model, processor = make_tiny(load_manifests()[NAME].architecture)
    processor.chat_template = TEMPLATE.removesuffix("{% endif %}") + THOUGHT[0] + "\n{% endif %}"
    thinker = LocalModel("thinker", BatchGenerator(model, processor), LocalOptions(threads=1, max_new_tokens=4000))
    asked = [ask(thinker, "?", schema=BOX, temperature=9.0, seed=seed) for seed in (1, 9)]
    for found in now(*asked):
        thought, reply = found.parts
        assert isinstance(thought, ThinkingPart)
        assert THOUGHT[1] not in thought.content
        assert isinstance(reply, TextPart)
        assert fits(BOX, json.loads(reply.content))
        assert found.finish_reason == "stop"
    (cut,) = now(ask(thinker, "?", schema=BOX, temperature=9.0, seed=1, max_tokens=2))
    assert (cut.finish_reason, cut.usage.output_tokens, cut.text) == ("length", 2, "")


def test_top_p_and_top_k() -> None:
    logits = torch.tensor([0.5, 0.3, 0.15, 0.05]).log()

    def chosen(**rest: Any) -> set[int]:
        found = set()
        for seed in range(60):
            sampling = TokenSampling(temperature=1.0, seed=seed, **rest)
            row = BatchRow(PendingGeneration([], [], sampling, 1), [], None, lambda row, finish: None)
            token = row.choose(logits)
            found.add(int(token))
        return found

    assert chosen() == {0, 1, 2, 3}
    assert chosen(top_k=2) == {0, 1}
    assert chosen(top_p=0.79) == {0, 1}
    assert chosen(top_p=0.0001) == {0}
    assert chosen(top_k=3, top_p=0.99) == {0, 1, 2}


# What is seen.


def test_images_are_seen(toy: LocalModel) -> None:
    none, one, other, two, swapped = now(
        ask(toy, "what?", max_tokens=24),
        ask(toy, "what?", picture(1), max_tokens=24),
        ask(toy, "what?", picture(2), max_tokens=24),
        ask(toy, "what?", picture(1), picture(2, 32, 32), max_tokens=24),
        ask(toy, "what?", picture(2, 32, 32), picture(1), max_tokens=24),
    )
    assert one.usage.input_tokens == none.usage.input_tokens + 2 * 3 + 2  # with the tokens before and after
    assert two.usage.input_tokens == one.usage.input_tokens + 1 + 2
    assert len({text(found) for found in (none, one, other, two, swapped)}) == 5


def test_text_cannot_spell_special_tokens(toy: LocalModel) -> None:
    spelt = "".join(SPECIAL)
    (found,) = now(ask(toy, spelt, picture(), max_tokens=1))
    (plain,) = now(ask(toy, "?", picture(), max_tokens=1))
    assert found.usage.input_tokens == plain.usage.input_tokens - 1 + len(spelt) + len(SPECIAL)
    turns, _ = conversation_of([ModelRequest([UserPromptPart(["<|im_", "end|>"])])], [], SPECIAL)
    assert turns[0]["content"] == [{"type": "text", "text": "<|im_\nend|>"}]


def test_turns(toy: LocalModel) -> None:
    said: list[ModelMessage] = [
        ModelRequest([SystemPromptPart("be brief"), UserPromptPart(["a", picture(), "b", "c"])]),
        ModelResponse([TextPart("d")]),
        ModelRequest([UserPromptPart("e")]),
        ModelRequest([SystemPromptPart("now"), UserPromptPart("f")]),
    ]
    turns, images = conversation_of(said, ["first"], SPECIAL)
    told = [(turn["role"], [part.get("text", part["type"]) for part in turn["content"]]) for turn in turns]
    assert told == [
        ("system", ["first\nbe brief"]),
        ("user", ["a", "image", "b\nc"]),
        ("assistant", ["d"]),
        ("user", ["e\nnow\nf"]),
    ]
    assert [image.size for image in images] == [(64, 96)]
    assert now(say(toy, said, max_tokens=3))


def test_what_cannot_be_given(toy: LocalModel) -> None:
    with pytest.raises(UserError, match="not a BinaryContent"):
        now(ask(toy, BinaryContent(b"%PDF", media_type="application/pdf")))
    with pytest.raises(ImageUnreadable):
        now(ask(toy, BinaryContent(b"\x89PNG\r\n\x1a\n", media_type="image/png")))


# In whose company.


def test_a_batch_says_what_each_alone_says(toy: LocalModel, monkeypatch: pytest.MonkeyPatch) -> None:
    def asked() -> list[Coroutine[Any, Any, ModelResponse]]:
        return [
            ask(toy, "short", max_tokens=30),
            ask(toy, "a much longer question " * 4, schema=BOX),
            ask(toy, "with an image", picture(3), schema={"enum": ["yes", "no", "not sure"]}),
            ask(toy, picture(4, 128, 64), "and", picture(5), max_tokens=17),
        ]

    sizes = batches(toy, monkeypatch)
    alone = [now(one)[0] for one in asked()]
    assert sizes == [1, 1, 1, 1]
    del sizes[:]
    first, *together = now(ask(toy, "busy", max_tokens=60), *asked())
    assert max(sizes) > 1
    assert sum(sizes) == 5
    assert [text(found) for found in together] == [text(found) for found in alone]
    assert [found.usage for found in together] == [found.usage for found in alone]
    assert fits(BOX, json.loads(text(together[1])))
    assert text(first)


def test_a_batch_has_a_limit(toy: LocalModel, monkeypatch: pytest.MonkeyPatch) -> None:
    model = another(toy, max_batch=2)
    sizes = batches(model, monkeypatch)
    now(*[ask(model, f"{i}", max_tokens=8) for i in range(5)])
    assert max(sizes) == 2
    assert sum(sizes) == 5


def until(true: Callable[[], bool], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_who_gives_up_is_dropped(toy: LocalModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that waits never runs; one that is being written ends, and another takes its place."""
    model = another(toy, max_batch=1)
    sizes = batches(model, monkeypatch)

    async def main() -> float:
        writing = asyncio.create_task(ask(model, "?", schema=LONG, max_tokens=4000))
        while not sizes:
            await asyncio.sleep(0.01)
        waiting = asyncio.create_task(ask(model, "?", schema=LONG, max_tokens=4000))
        last = asyncio.create_task(ask(model, "?", max_tokens=3))
        while len(model._worker._queue) < 2:
            await asyncio.sleep(0.01)
        waiting.cancel()
        writing.cancel()
        start = time.monotonic()
        assert text(await last)
        assert waiting.cancelled() or waiting.cancelling()
        return time.monotonic() - start

    assert asyncio.run(main()) < 5
    assert sizes == [1, 1]


def test_a_reply_in_time(toy: LocalModel) -> None:
    model = another(toy)
    with pytest.raises(TimeoutError):
        now(asyncio.wait_for(ask(model, "?", schema=LONG, max_tokens=4000), 0.2))
    until(lambda: not model._worker._running, 5)


def test_an_error_finds_whom_it_belongs_to(toy: LocalModel) -> None:
    """An image that the processor refuses, in a batch with others."""

    async def main() -> list[ModelResponse | BaseException]:
        stripe = picture(0, 2400, 8)
        asked = [ask(toy, "busy", max_tokens=60), ask(toy, "a", max_tokens=5), ask(toy, stripe), ask(toy, picture())]
        return await asyncio.gather(*asked, return_exceptions=True)

    _, first, failed, last = asyncio.run(main())
    assert isinstance(failed, ImageUnreadable)
    assert "aspect ratio" in failed.detail
    assert isinstance(first, ModelResponse)
    assert isinstance(last, ModelResponse)


def test_memory_that_runs_out(toy: LocalModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch that does not fit is split; one that does not fit alone gets an error with a remedy; others go on."""

    def narrow(model: Any, args: Any, given: dict[str, Any]) -> None:
        rows, tokens = given["input_ids"].shape
        if rows > 2 or tokens > 200:
            raise torch.OutOfMemoryError("CUDA out of memory.")

    sizes = batches(toy, monkeypatch)
    hook = toy._generator._model.register_forward_pre_hook(narrow, with_kwargs=True)
    try:
        found = now(*[ask(toy, f"{i}", max_tokens=4) for i in range(8)])
        assert all(text(one) for one in found)
        assert max(sizes) > 2
        with pytest.raises(MllmUnavailable, match=r"ran out of memory on cpu.*smaller image.*COW_MLLM"):
            now(ask(toy, "long " * 50, max_tokens=4))
    finally:
        hook.remove()
    assert text(now(ask(toy, "again", max_tokens=4))[0])


def test_any_other_error_reaches_the_caller_and_the_next_call_is_served(
    toy: LocalModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(toy._generator._processor, "chat_template", "{{ nonsense.of.a.template }}")
        with pytest.raises(UndefinedError):
            now(ask(toy, "a", schema={"enum": ["x"]}), ask(toy, "b", max_tokens=3))
    assert text(now(ask(toy, "c", max_tokens=3))[0])


def test_callers_in_several_threads(toy: LocalModel) -> None:
    found: list[str] = []

    def one(i: int) -> None:
        found.extend(text(reply) for reply in now(ask(toy, f"thread {i}", schema=BOX)))

    threads = [threading.Thread(target=one, args=(i,)) for i in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 3


def test_an_idle_model_can_go(tmp_path: Path) -> None:
    model = load_local(told(tmp_path))
    now(ask(model, "?", max_tokens=2))
    until(lambda: not any(thread.name == f"mllm {NAME}" for thread in threading.enumerate()))
    weights = weakref.ref(model._generator._model)
    del model
    gc.collect()
    assert weights() is None


# Where it comes from.


def test_a_folder_of_ones_own(toy: LocalModel, saved: Path, tmp_path: Path) -> None:
    model = load_local(told(tmp_path, checkpoints={NAME: saved}))
    same, other = now(ask(toy, "what?", picture(), max_tokens=20)), now(ask(model, "what?", picture(), max_tokens=20))
    assert [text(found) for found in same] == [text(found) for found in other]
    assert fits(BOX, json.loads(text(now(ask(model, "?", schema=BOX))[0])))


def test_a_folder_as_published(saved: Path, tmp_path: Path, toy: LocalModel) -> None:
    """The files of Qwen3-VL on the hub: parts of the processor apart, its image processor under the former name."""
    folder = tmp_path / "published"
    folder.mkdir()
    for file in saved.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    parts = json.loads((folder / "processor_config.json").read_text())
    images = parts["image_processor"] | {"processor_class": "Qwen3VLProcessor"}
    assert parts["processor_class"] == "Qwen3VLProcessor"
    images["image_processor_type"] = "Qwen2VLImageProcessorFast"
    (folder / "preprocessor_config.json").write_text(json.dumps(images))
    videos = images | {"video_processor_type": "Qwen3VLVideoProcessor"}
    (folder / "video_preprocessor_config.json").write_text(json.dumps(videos))
    template = (folder / "chat_template.jinja").read_text()
    (folder / "chat_template.json").write_text(json.dumps({"chat_template": template}))
    (folder / "chat_template.jinja").unlink()
    (folder / "processor_config.json").unlink()
    model = load_local(told(tmp_path, checkpoints={NAME: folder}))
    found, wanted = (now(ask(one, "what?", picture(), max_tokens=20))[0] for one in (model, toy))
    assert text(found) == text(wanted)


def spoil_config(folder: Path) -> None:
    (folder / "config.json").write_text("{")


def spoil_family(folder: Path) -> None:
    (folder / "config.json").write_text(json.dumps({"model_type": "qwen2_5_vl"}))


def spoil_weights(folder: Path) -> None:
    (folder / "model.safetensors").write_bytes(b"\x10\0\0\0\0\0\0\0nonsense")


def spoil_kind(folder: Path) -> None:
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")


def spoil_tokenizer(folder: Path) -> None:
    (folder / "tokenizer.json").unlink()
    (folder / "tokenizer_config.json").unlink()


def spoil_names(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    weights["model.stranger"] = weights.pop("model.language_model.layers.0.self_attn.q_proj.weight")
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


def spoil_shapes(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    weights["model.language_model.norm.weight"] = torch.zeros(3)
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


def spoil_size(folder: Path) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["text_config"]["num_hidden_layers"] = 3
    (folder / "config.json").write_text(json.dumps(config))


def spoil_all(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (spoil_all, "is no folder of a transformers checkpoint"),
        (spoil_config, "`config.json`"),
        (spoil_family, "of the type 'qwen2_5_vl'"),
        (spoil_kind, "no safetensors files"),
        (spoil_weights, "cannot be loaded: "),
        (spoil_tokenizer, "cannot be loaded: "),
        (spoil_names, "lacks model.language_model.layers.0.self_attn.q_proj.weight"),
        (spoil_shapes, "cannot be loaded: "),
        (spoil_size, "lacks model.language_model.layers.2."),
    ],
)
def test_a_folder_that_does_not_fit(saved: Path, tmp_path: Path, spoil: Callable[[Path], None], said: str) -> None:
    folder = tmp_path / "spoilt"
    folder.mkdir()
    for file in saved.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    spoil(folder)
    with pytest.raises(CheckpointInvalid) as caught:
        load_local(told(tmp_path, checkpoints={NAME: folder}))
    assert said in caught.value.detail
    assert_no_path(caught.value, tmp_path)


def assert_no_path(error: CowError, folder: Path) -> None:
    assert str(folder) not in error.detail
    assert "site-packages" not in error.detail
    assert "/tmp" not in error.detail
    assert "Traceback" not in error.detail


@pytest.mark.parametrize("name", [None, "nonsense", "openai:gpt-5", "ati"])
def test_what_is_no_model_of_this_process(tmp_path: Path, name: str | None) -> None:
    with pytest.raises(ReaderUnavailable, match=f"COW_MLLM.*{NAME}"):
        load_local(told(tmp_path, mllm=name))


def with_manifest(monkeypatch: pytest.MonkeyPatch, **rest: Any) -> None:
    toy = load_manifests()[NAME]
    changed = Manifest.model_validate(toy.model_dump() | {"name": "other"} | rest)
    monkeypatch.setattr(reader, "mllm_manifests", lambda: {NAME: toy, "other": changed})


def test_a_model_that_only_others_serve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, saved: Path) -> None:
    with_manifest(monkeypatch, architecture={}, local={})
    with pytest.raises(ReaderUnavailable, match=f"served by others.*{NAME}"):
        load_local(told(tmp_path, mllm="other"))
    assert load_local(told(tmp_path, mllm="other", checkpoints={"other": saved})).model_name == "other"


def test_weights_that_were_not_pulled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = Source(repository="owner/name", files=("*.json",), licence="Apache-2.0")
    with_manifest(monkeypatch, sources={"weights": source})
    with pytest.raises(WeightsUnavailable, match="cow models pull other"):
        load_local(told(tmp_path, mllm="other"))


def test_devices() -> None:
    assert device_map("cpu") == {"": "cpu"}
    assert device_map("auto") == ("auto" if torch.cuda.is_available() else {"": "cpu"})
    with pytest.raises(ReaderUnavailable, match=r"no GPU 'cuda:99'.*COW_DEVICE"):
        device_map("cuda:99")


@pytest.mark.slow
def test_many_callers_of_all_kinds(toy: LocalModel) -> None:
    """Some give up; each of the others gets the reply that is its own."""

    async def main() -> None:
        async def one(i: int) -> None:
            schema = None if i % 3 == 0 else {"type": "string", "enum": [f"reply {i}"]}
            task = asyncio.create_task(ask(toy, f"question {i}", *[picture(i)] * (i % 4), schema=schema, max_tokens=40))
            await asyncio.sleep(0.01 * i)
            if i % 5 == 0:
                task.cancel()
                return
            found = await task
            if schema is not None:
                assert json.loads(text(found)) == f"reply {i}"

        await asyncio.gather(*[one(i) for i in range(60)])

    asyncio.run(main())
    until(lambda: not toy._worker._running)
