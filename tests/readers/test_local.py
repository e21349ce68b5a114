"""The multimodal LLM of this process, at toy size: the real classes, a real grammar, a real queue."""

from __future__ import annotations

import asyncio
import gc
import json
import shutil
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from conftest import example
from jsonschema import Draft202012Validator
from refusals import refused
from waiting import TIME_LIMIT, eventually

from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.weights.manifests import Manifest, Source, load_manifests

if TYPE_CHECKING:
    from toy_mllm import Call, Toy

    from cow_service.readers.local.model import LocalModel

pytest.importorskip("llguidance")
pytestmark = pytest.mark.slow

NAME = "tiny-qwen3-vl"
NUMBERS = {"type": "array", "items": {"type": "integer", "minimum": 0, "maximum": 1000}, "minItems": 4, "maxItems": 4}
FIELDS = {"reasoning": {"type": "string", "maxLength": 12}, "bbox_2d": NUMBERS}
BOX = {"type": "object", "properties": FIELDS, "required": list(FIELDS)}
LONG = {"type": "string", "minLength": 3000}  # a reply of thousands of tokens


@pytest.fixture(scope="module")
def toy() -> Toy:
    from toy_mllm import Toy

    return Toy()


@pytest.fixture(scope="module")
def saved(toy: Toy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved") / "own"
    toy.weights.save_pretrained(folder)
    toy.processor.save_pretrained(folder)
    return folder


def load(data: Path, **rest: Any) -> LocalModel:
    from cow_service.readers.local.reader import load_local

    return load_local(Settings(**({"data_dir": data, "mllm": NAME, "device": "cpu"} | rest)))


# What is said.


def test_a_reply_is_held_to_any_schema(toy: Toy) -> None:
    """Nothing but what it names is written, also in objects within others and under the names that schemas use."""
    parts = {
        "properties": {"type": "array", "items": {"enum": ["ü", "b c"]}, "minItems": 1, "maxItems": 3},
        "reasoning": {"type": "object", "properties": {"n": {"type": "integer", "minimum": -5, "maximum": 9}}},
        "none": {"anyOf": [{"type": "null"}, {"type": "boolean"}]},
    }
    schema = {"type": "object", "properties": parts, "required": sorted(parts)}
    for seed in (0, 1):
        (found,) = toy.now(toy.ask(toy.model(), "?", schema=schema, temperature=1.5, seed=seed, max_tokens=600))
        assert found.finish_reason == "stop"
        reply = json.loads(toy.text(found))
        assert fits(schema, reply)
        assert reply.keys() == parts.keys()
        assert reply["reasoning"].keys() <= {"n"}


def fits(schema: dict[str, Any], value: Any) -> bool:
    return Draft202012Validator(schema).is_valid(value)


def test_a_reply_is_no_longer_than_the_call_and_the_manifest_allow_and_says_that_it_was_cut_off(toy: Toy) -> None:
    limited, model = toy.model(max_new_tokens=7), toy.model()
    short, long = toy.now(toy.ask(limited, "what?", toy.picture(), max_tokens=5), toy.ask(limited, "?", max_tokens=50))
    for found, tokens in ((short, 5), (long, 7)):
        assert (found.finish_reason, found.usage.output_tokens) == ("length", tokens)
        assert (found.model_name, found.provider_name, model.model_name, model.system) == (NAME, "local", NAME, "local")
    whole, cut = toy.now(toy.ask(model, "?", schema=BOX), toy.ask(model, "?", schema=BOX, max_tokens=9))
    assert (whole.finish_reason, cut.finish_reason) == ("stop", "length")
    assert toy.text(whole).startswith(toy.text(cut).rstrip("\ufffd"))
    (exact,) = toy.now(toy.ask(model, "?", schema=BOX, max_tokens=whole.usage.output_tokens))
    assert (exact.finish_reason, toy.text(exact)) == ("stop", toy.text(whole))
    assert fits(BOX, json.loads(toy.text(whole)))
    assert list(json.loads(toy.text(whole))) == list(BOX["properties"])  # in this order


def test_schemas_and_settings_that_replies_cannot_be_held_to(toy: Toy) -> None:
    from pydantic_ai.exceptions import UserError

    settings = ({"temperature": -1.0}, {"top_p": 0.0}, {"top_p": 1.5}, {"top_k": -1}, {"max_tokens": 0})
    for wrong in ({"schema": {"type": "array", "uniqueItems": True}}, *settings):
        with pytest.raises(UserError):
            toy.now(toy.ask(toy.model(), "?", **wrong))


# How tokens are chosen.


def test_a_batch_says_what_each_alone_says(toy: Toy) -> None:
    """Of any settings and lengths, with images and without; a seed gives the same reply in any company."""
    model = toy.model()

    def asked() -> list[Call]:
        return [
            toy.ask(model, "short", max_tokens=12),
            toy.ask(model, "a much longer question " * 4, schema=BOX),
            toy.ask(model, "with an image", toy.picture(3), schema={"enum": ["yes", "no", "not sure"]}),
            toy.ask(model, toy.picture(4, 128, 64), "and", toy.picture(5), max_tokens=9),
            toy.ask(model, "say", temperature=1.0, seed=5, max_tokens=12),
        ]

    alone = [toy.now(one)[0] for one in asked()]
    with toy.noted() as sizes:
        _, *together = toy.now(toy.ask(model, "say", temperature=1.0, seed=4, max_tokens=60), *asked())
    assert max(sizes) > 1
    assert sum(sizes) == 6
    assert [toy.text(found) for found in together] == [toy.text(found) for found in alone]
    assert [found.usage for found in together] == [found.usage for found in alone]


def test_a_checkpoints_own_advice_counts_where_nothing_is_said(toy: Toy) -> None:
    import torch
    from pydantic_ai.settings import ModelSettings

    from cow_service.readers.local.generation import BatchGenerator, TokenSampling

    advised = toy.another(do_sample=True, temperature=0.7, top_p=0.8, top_k=20)
    assert advised.generator.default_sampling == TokenSampling(temperature=0.7, top_p=0.8, top_k=20)
    calm = advised.model("calm", ModelSettings(temperature=0, max_tokens=9))
    for model, is_same in ((advised.model(), False), (calm, True)):
        found = toy.now(*[toy.ask(model, "?", **({} if model is calm else {"max_tokens": 9})) for _ in range(4)])
        assert (len({toy.text(each) for each in found}) == 1) is is_same
        assert {each.usage.output_tokens for each in found} == {9}
    assert calm.deterministic
    half = BatchGenerator(advised.weights.to(torch.bfloat16), advised.processor)
    assert not half.is_float32, "only full precision promises the same reply"


def test_a_model_that_thinks_first(toy: Toy) -> None:
    """The thought is free and kept apart; the reply after it is held to the schema."""
    from cow_service.readers.local.tiny import TEMPLATE, THOUGHT

    toy = toy.another()
    toy.processor.chat_template = TEMPLATE.removesuffix("{% endif %}") + THOUGHT[0] + "\n{% endif %}"
    thinker = toy.model("thinker")
    for found in toy.now(*[toy.ask(thinker, "?", schema=BOX, temperature=9.0, seed=seed) for seed in (1, 9)]):
        thought, reply = found.parts
        assert (thought.part_kind, reply.part_kind) == ("thinking", "text")
        assert THOUGHT[1] not in thought.content
        assert fits(BOX, json.loads(reply.content))
        assert found.finish_reason == "stop"
        assert found.usage.output_tokens > len(reply.content)
    (endless,) = toy.now(toy.ask(thinker, "?", schema=BOX, temperature=0.0, max_tokens=400))
    assert fits(BOX, json.loads(endless.text or "")), "a thought leaves room for the reply"
    assert endless.usage.output_tokens > 200
    (cut,) = toy.now(toy.ask(thinker, "?", schema=BOX, temperature=9.0, seed=1, max_tokens=2))
    assert (cut.finish_reason, cut.usage.output_tokens, cut.text) == ("length", 2, "")


def test_top_p_and_top_k() -> None:
    import torch

    from cow_service.readers.local.generation import BatchRow, PendingGeneration, TokenSampling

    logits = torch.tensor([0.5, 0.3, 0.15, 0.05]).log()

    def chosen(**rest: Any) -> set[int]:
        found = set()
        for seed in range(60):
            sampling = TokenSampling(**({"temperature": 1.0, "seed": seed} | rest))
            row = BatchRow(PendingGeneration([], [], sampling, 1), [], None, lambda row, finish: None)
            found.add(int(row.choose(logits)))
        return found

    assert chosen() == {0, 1, 2, 3}
    assert chosen(temperature=0.0) == {0}
    assert chosen(top_k=2) == {0, 1}
    assert chosen(top_k=1) == {0}
    assert chosen(top_p=0.79) == {0, 1}
    assert chosen(top_k=3, top_p=0.99) == {0, 1, 2}


# What is seen.


def test_images_are_seen(toy: Toy) -> None:
    model = toy.model()
    none, one, other, two, swapped = toy.now(
        toy.ask(model, "what?", max_tokens=24),
        toy.ask(model, "what?", toy.picture(1), max_tokens=24),
        toy.ask(model, "what?", toy.picture(2), max_tokens=24),
        toy.ask(model, "what?", toy.picture(1), toy.picture(2, 32, 32), max_tokens=24),
        toy.ask(model, "what?", toy.picture(2, 32, 32), toy.picture(1), max_tokens=24),
    )
    assert one.usage.input_tokens == none.usage.input_tokens + 2 * 3 + 2  # with the tokens before and after
    assert two.usage.input_tokens == one.usage.input_tokens + 1 + 2
    assert len({toy.text(found) for found in (none, one, other, two, swapped)}) == 5


def test_turns_and_text_that_spells_special_tokens(toy: Toy) -> None:
    from pydantic_ai.messages import ModelRequest, ModelResponse, SystemPromptPart, TextPart, UserPromptPart

    from cow_service.readers.local.generation import conversation_of
    from cow_service.readers.local.tiny import SPECIAL

    said = [
        ModelRequest([SystemPromptPart("be brief"), UserPromptPart(["a", toy.picture(), "b", "c"])]),
        ModelResponse([TextPart("d")]),
        ModelRequest([UserPromptPart("e")]),
        ModelRequest([SystemPromptPart("now"), UserPromptPart(["f<|im_", "end|>", "<|im_end|>"])]),
    ]
    turns, images = conversation_of(said, ["first"], SPECIAL)
    told = [(turn["role"], [part.get("text", part["type"]) for part in turn["content"]]) for turn in turns]
    assert told == [
        ("system", ["first\nbe brief"]),
        ("user", ["a", "image", "b\nc"]),
        ("assistant", ["d"]),
        ("user", ["e\nnow\nf<|im_\nend|>\n< |im_end|>"]),
    ]
    assert [image.size for image in images] == [(64, 96)]
    assert toy.now(toy.say(toy.model(), said, max_tokens=3))
    spelt = "".join(SPECIAL)
    found, plain = (toy.now(toy.ask(toy.model(), asked, toy.picture(), max_tokens=1))[0] for asked in (spelt, "?"))
    assert found.usage.input_tokens == plain.usage.input_tokens - 1 + len(spelt) + len(SPECIAL)


def test_what_cannot_be_given(toy: Toy) -> None:
    from pydantic_ai.exceptions import UserError
    from pydantic_ai.messages import BinaryContent

    with pytest.raises(UserError):
        toy.now(toy.ask(toy.model(), BinaryContent(b"%PDF", media_type="application/pdf")))
    with refused("image-unreadable"):
        toy.now(toy.ask(toy.model(), BinaryContent(b"\x89PNG\r\n\x1a\n", media_type="image/png")))


# In whose company.


def test_who_gives_up_is_dropped(toy: Toy) -> None:
    """One that waits never runs; one that is being written ends at the next token, and another takes its place."""
    from cow_service.readers.local.generation import PendingGeneration, TokenSampling
    from cow_service.readers.local.model import BatchWorker, LocalOptions

    worker = BatchWorker(toy.generator, "given up", LocalOptions(max_batch=1, threads=1))
    turns = [{"role": "user", "content": [{"type": "text", "text": "?"}]}]
    grammar = toy.generator.grammar(LONG)
    writing, waiting = (PendingGeneration(turns, [], TokenSampling(), 4000, grammar) for _ in range(2))
    last = PendingGeneration(turns, [], TokenSampling(), 3)
    before, runs = len(toy.batches), toy.runs
    worker.submit(writing)
    eventually(lambda: toy.runs > runs)  # it is being written
    for pending in (waiting, last):
        worker.submit(pending)
    waiting.future.cancel()
    writing.future.cancel()
    runs = toy.runs
    assert toy.text(last.future.result(TIME_LIMIT))
    assert toy.runs < runs + 10
    assert toy.batches[before:] == [[writing], [last]]


def test_an_error_finds_whom_it_belongs_to(toy: Toy) -> None:
    """An image that the processor refuses, in a batch with others; a batch has a limit."""
    model = toy.model(max_batch=3)

    async def main() -> list[Any]:
        asked = [toy.ask(model, "busy", max_tokens=60), toy.ask(model, "a", max_tokens=5)]
        asked += [toy.ask(model, toy.picture(0, 2400, 8)), toy.ask(model, toy.picture(), max_tokens=5)]
        return await asyncio.gather(*asked, toy.ask(model, "b", max_tokens=5), return_exceptions=True)

    with toy.noted() as sizes:
        _, first, failed, *others = asyncio.run(main())
    assert getattr(failed, "code", None) == "image-unreadable"
    assert all(toy.text(found) for found in (first, *others))
    assert max(sizes) == 3


def test_memory_that_runs_out(toy: Toy) -> None:
    """A batch that does not fit is split; one that does not fit alone gets an error; others go on."""
    import torch

    def narrow(model: Any, args: Any, given: dict[str, Any]) -> None:
        rows, tokens = given["input_ids"].shape
        if rows > 2 or tokens > 200:
            raise torch.OutOfMemoryError("CUDA out of memory.")

    model = toy.model()
    hook = toy.weights.register_forward_pre_hook(narrow, with_kwargs=True)
    try:
        with toy.noted() as sizes:
            found = toy.now(*[toy.ask(model, f"{i}", max_tokens=4) for i in range(8)])
        assert all(toy.text(one) for one in found)
        assert max(sizes) > 2
        with refused("mllm-unavailable"):
            toy.now(toy.ask(model, "long " * 50, max_tokens=4))
    finally:
        hook.remove()
    assert toy.text(toy.now(toy.ask(model, "again", max_tokens=4))[0])


def test_an_idle_model_can_go(toy: Toy, tmp_path: Path) -> None:
    """Its thread ends where nothing waits."""
    model = load(tmp_path)
    toy.now(*[toy.ask(model, f"{i}", max_tokens=2) for i in range(9)])  # more than one batch
    eventually(lambda: toy.is_idle(NAME))
    gone = weakref.ref(model)
    del model
    gc.collect()
    assert gone() is None


# Where it comes from.


def as_published(folder: Path) -> None:
    """The files of Qwen3-VL on the hub: parts of the processor apart, its image processor under the former name."""
    parts = json.loads((folder / "processor_config.json").read_text())
    images = parts["image_processor"] | {"processor_class": "Qwen3VLProcessor"}
    images["image_processor_type"] = "Qwen2VLImageProcessorFast"
    (folder / "preprocessor_config.json").write_text(json.dumps(images))
    videos = images | {"video_processor_type": "Qwen3VLVideoProcessor"}
    (folder / "video_preprocessor_config.json").write_text(json.dumps(videos))
    template = (folder / "chat_template.jinja").read_text()
    (folder / "chat_template.json").write_text(json.dumps({"chat_template": template}))
    (folder / "chat_template.jinja").unlink()
    (folder / "processor_config.json").unlink()


def test_a_folder_of_ones_own_or_as_published_says_the_same(toy: Toy, saved: Path, tmp_path: Path) -> None:
    published = Path(shutil.copytree(saved, tmp_path / "published"))
    as_published(published)
    (wanted,) = toy.now(toy.ask(toy.model(), "what?", toy.picture(), max_tokens=20))
    for folder in (saved, published):
        model = load(tmp_path, checkpoints={NAME: folder})
        (found,) = toy.now(toy.ask(model, "what?", toy.picture(), max_tokens=20, temperature=0.0))
        assert toy.text(found) == toy.text(wanted)


def rename_weights(folder: Path) -> None:
    from safetensors.torch import load_file, save_file

    weights = load_file(folder / "model.safetensors")
    weights["model.stranger"] = weights.pop("model.language_model.layers.0.self_attn.q_proj.weight")
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (shutil.rmtree, "spoilt"),
        (lambda folder: (folder / "config.json").write_text('{"model_type": "qwen2_5_vl"}'), "qwen2_5_vl"),
        (lambda folder: (folder / "model.safetensors").rename(folder / "pytorch_model.bin"), "safetensors"),
        (lambda folder: [file.unlink() for file in folder.glob("tokenizer*.json")], NAME),
        (rename_weights, "model.language_model.layers.0.self_attn.q_proj.weight"),
    ],
    ids=["no folder", "another family", "pickles", "what a library raises", "names that do not fit"],
)
def test_a_folder_that_does_not_fit(saved: Path, tmp_path: Path, spoil, named: str) -> None:
    """The error names what does not fit, and no path."""
    folder = Path(shutil.copytree(saved, tmp_path / "spoilt"))
    spoil(folder)
    with refused("checkpoint-invalid") as caught:
        load(tmp_path, checkpoints={NAME: folder})
    assert named in caught.value.detail
    for path in (str(tmp_path), "site-packages", "/tmp"):
        assert path not in caught.value.detail


def test_what_is_no_model_of_this_process_and_what_it_cannot_do(tmp_path: Path, monkeypatch, saved: Path) -> None:
    import torch

    from cow_service.readers.local import reader

    for name in (None, "openai:gpt-5", "ati"):
        with refused("reader-unavailable"):
            load(tmp_path, mllm=name)
    with refused("reader-unavailable"):
        reader.device_map("cuda:99")
    assert reader.device_map("cpu") == {"": "cpu"}
    assert reader.device_map("auto") == ("auto" if torch.cuda.is_available() else {"": "cpu"})

    def describe(**rest: Any) -> None:
        toy = load_manifests()[NAME]
        other = Manifest.model_validate(toy.model_dump() | {"name": "other"} | rest)
        monkeypatch.setattr(reader, "mllm_manifests", lambda: {NAME: toy, "other": other})

    describe(architecture={}, local={})
    with refused("reader-unavailable"):  # others serve it
        load(tmp_path, mllm="other")
    assert load(tmp_path, mllm="other", checkpoints={"other": saved}).model_name == "other"
    describe(sources={"weights": Source(repository="owner/name", files=("*.json",), licence="Apache-2.0")})
    with refused("weights-unavailable"):
        load(tmp_path, mllm="other")


def test_the_same_seed_gives_the_same_answer(tmp_path: Path) -> None:
    """What random weights say means nothing, but it goes the way of a real model's words."""
    scene = example("ball-and-mug")
    with Service(Settings(data_dir=tmp_path, mllm=NAME, reader="local", device="cpu")) as service:
        image = {"artifact": service.keep_image(scene.image).sha256}
        asked = {"image": image, "question": scene.meta["question"], "imagine": "never", "seed": 3}
        first, second = (service.answer(AnswerRequest.model_validate(asked)) for _ in range(2))
        # A batch of eight is written, and the next one waits.
        assert service.readers.get("local").places.limit.most == 16
    assert (first.answer, first.reasoning) == (second.answer, second.reasoning)
    assert first.answer in {"A", "B", "C"}
    assert (first.reader.name, first.reader.model) == ("local", NAME)
    assert first.usage.input_tokens > 0 < first.usage.output_tokens
