"""Qwen3-VL at toy size: the real classes with seeded random weights and a toy tokenizer, both made here.

It goes the whole way in a fraction of a second on a CPU. What it says means nothing: it is for tests, and to try a
deployment out.
"""

from collections.abc import Mapping
from typing import Any, cast

import torch
import transformers
from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

NAME = "tiny-qwen3-vl"
SEED = 0
PIXELS = {"shortest_edge": 32 * 32, "longest_edge": 128 * 128}  # least and most of an image as it is seen
PADDING, START, END = "<|endoftext|>", "<|im_start|>", "<|im_end|>"
VISION_START, VISION_END, IMAGE, VIDEO = "<|vision_start|>", "<|vision_end|>", "<|image_pad|>", "<|video_pad|>"
THOUGHT = ("<think>", "</think>")
SPECIAL = (PADDING, START, END, VISION_START, VISION_END, IMAGE, VIDEO)
TEMPLATE = (
    "{% for turn in messages %}" + START + "{{ turn.role }}\n"
    "{% for part in turn.content %}"
    "{% if part.type == 'image' %}" + VISION_START + IMAGE + VISION_END + "{% else %}{{ part.text }}{% endif %}"
    "{% endfor %}" + END + "\n"
    "{% endfor %}"
    "{% if add_generation_prompt %}" + START + "assistant\n{% endif %}"
)


def make_tiny(
    architecture: Mapping[str, Any],
) -> tuple[transformers.Qwen3VLForConditionalGeneration, transformers.ProcessorMixin]:
    """A model of these sizes and its processor; the same sizes give the same weights.

    Names are those of Qwen3-VL's configuration, with a dot where it nests: `text_config.hidden_size`.
    """
    # Every byte is a token.
    vocabulary = {byte: i for i, byte in enumerate(sorted(pre_tokenizers.ByteLevel.alphabet()))}
    tokens = Tokenizer(models.BPE(vocab=vocabulary, merges=[]))
    tokens.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
    tokens.decoder = decoders.ByteLevel()
    tokens.add_special_tokens([AddedToken(token, special=True) for token in SPECIAL])
    tokens.add_tokens([AddedToken(token) for token in THOUGHT])
    tokenizer = transformers.PreTrainedTokenizerFast(tokenizer_object=tokens, pad_token=PADDING, eos_token=END)
    ids, end, padding = tokenizer.get_vocab(), tokenizer.eos_token_id, tokenizer.pad_token_id

    text, vision = _section(architecture, "text_config"), _section(architecture, "vision_config")
    third = text["head_dim"] // 6  # half a head's channels turn: by time, height and width in about equal parts
    text["rope_parameters"] = {
        "rope_type": "default",
        "rope_theta": 10_000.0,
        "mrope_interleaved": True,
        "mrope_section": [text["head_dim"] // 2 - 2 * third, third, third],
    }
    config = transformers.Qwen3VLConfig(
        text_config={**text, "vocab_size": len(tokenizer), "pad_token_id": padding},
        vision_config={**vision, "out_hidden_size": text["hidden_size"], "deepstack_visual_indexes": [0]},
        tie_word_embeddings=True,
        image_token_id=ids[IMAGE],
        video_token_id=ids[VIDEO],
        vision_start_token_id=ids[VISION_START],
        vision_end_token_id=ids[VISION_END],
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        model = transformers.Qwen3VLForConditionalGeneration(config)
    model.generation_config = transformers.GenerationConfig(eos_token_id=end, pad_token_id=padding)
    patch = vision["patch_size"]
    images = Qwen2VLImageProcessorPil(patch_size=patch, temporal_patch_size=2, merge_size=2, size=PIXELS)
    return model, still(transformers.Qwen3VLProcessor)(images, tokenizer, chat_template=TEMPLATE)


def _section(architecture: Mapping[str, Any], name: str) -> dict[str, Any]:
    start = name + "."
    return {key.removeprefix(start): value for key, value in architecture.items() if key.startswith(start)}


def still(kind: type[transformers.ProcessorMixin]) -> Any:
    """The processor class without videos, which alone would need torchvision.

    It keeps its name, so that what it saves is a usual checkpoint.
    """

    def get_attributes(cls: type[Any]) -> list[str]:
        return [name for name in cast(Any, kind).get_attributes() if name != "video_processor"]

    return type(kind.__name__, (kind,), {"get_attributes": classmethod(get_attributes)})
