"""The manifests of multimodal LLMs: which served name means which, what each family does, sizes computed again."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any

import pytest

from cow_service.weights.manifests import FAMILIES, MANIFESTS, load_families, load_manifests

ALL = {name: manifest for name, manifest in load_manifests().items() if manifest.role == "mllm"}
# One without a name under which it is served is a toy, made from nothing.
MLLMS = {name: manifest for name, manifest in ALL.items() if manifest.model}
OPEN = {name: manifest for name, manifest in MLLMS.items() if manifest.provider is None}
SERVICES = {name: manifest for name, manifest in MLLMS.items() if manifest.provider is not None}
PICKLES = ("model.bin", "pytorch_model.bin", "model.pt", "model.pth", "model.ckpt", "model.pkl", "model.pickle")
NEEDED = (
    "config.json",
    "generation_config.json",
    "preprocessor_config.json",
    "tokenizer.json",
    "tokenizer_config.json",
)

# Names as servers give them, of the vendors, Ollama, vLLM and gateways, by the manifest that each means.
SERVED = {
    "qwen3-vl-8b": ("Qwen/Qwen3-VL-8B-Instruct-FP8", "/weights/Qwen3-VL-8B-Instruct", "qwen3-vl:8b-instruct-q4_K_M"),
    "qwen3-vl-8b-thinking": ("qwen3-vl", "qwen3-vl:8b", "qwen3-vl:8b-thinking"),
    "qwen3-vl-30b-a3b": ("qwen3-vl:30b-a3b-instruct-q8_0",),
    "qwen3-vl-30b-a3b-thinking": ("qwen3-vl:30b",),
    "qwen2.5-vl-7b": ("qwen2.5vl",),
    "llava-onevision-1.5-4b": ("lmms-lab/LLaVA-OneVision-1.5-4B-Instruct",),
    "gpt-5": ("gpt-5-2025-08-07", "openai/gpt-5.1", "gpt-5.5-2026-04-23"),
    "gpt-5-mini": ("gpt-5-mini-2025-08-07", "gpt-5.4-mini"),
    "gemini-2.5-flash": ("google/gemini-2.5-flash", "gemini-2.5-flash-preview-09-2025"),
    "gemini-3.5-flash-lite": ("gemini-2.5-flash-lite",),
    "gemini-3.1-pro": ("gemini-3-pro-preview",),
    "claude-opus-5-5": ("claude-opus-4-8",),
    "claude-sonnet-4-6": ("claude-sonnet-4-5-20250929",),
    "claude-opus-4-6": ("anthropic/claude-opus-4.6",),
}
# They draw, speak or hear, or belong to unknown families.
STRANGERS = (
    "gemini-2.5-flash-image", "gemini-2.5-flash-preview-tts", "gemini-3-pro-image", "gemini-3.1-flash-lite-image",
    "gpt-5-codex", "gpt-4.1", "gpt-oss-20b", "claude-3-5-sonnet-20241022", "qwen3:8b", "qwen2.5-coder:7b",
    "Qwen/Qwen3-8B", "Qwen/Qwen2-VL-7B-Instruct", "lmms-lab/llava-onevision-qwen2-7b-ov",
)  # fmt: skip

# Sizes as in the configurations of the weights: those of the language model, then what differs in vision.
TEXT = ("hidden_size", "num_hidden_layers", "num_attention_heads", "num_key_value_heads", "intermediate_size")
SMALL_VIT = {"depth": 24, "hidden_size": 1024, "intermediate_size": 4096, "deepstack_visual_indexes": [5, 11, 17]}
VIT = {"depth": 27, "hidden_size": 1152, "intermediate_size": 4304, "deepstack_visual_indexes": [8, 16, 24]}
QWEN3_VL: dict[str, tuple[tuple[int, ...], dict[str, Any], dict[str, Any]]] = {
    "2b": ((2048, 28, 16, 8, 6144), {"tie_word_embeddings": True}, SMALL_VIT),
    "30b-a3b": ((2048, 48, 32, 4, 6144), {"num_experts": 128, "moe_intermediate_size": 768}, VIT),
}


def claimants(served: str) -> list[str]:
    """The manifests that a served name means; upper and lower case are the same."""
    return [
        name
        for name, manifest in MLLMS.items()
        if any(fnmatchcase(served.lower(), each.lower()) for each in (manifest.model or "", *manifest.also))
    ]


def test_names_are_those_of_the_files_and_lower_case() -> None:
    assert all(load_manifests()[name].name == name == name.lower() for name in MANIFESTS.names())
    assert all(load_families()[name].name == name == name.lower() for name in FAMILIES.names())
    assert {manifest.family for manifest in ALL.values()} == set(load_families())


def test_a_served_name_means_one_manifest() -> None:
    for name, manifest in MLLMS.items():
        model = str(manifest.model)
        for served in (model, model.rpartition("/")[2], model.upper(), *SERVED.get(name, ())):
            assert claimants(served) == [name]
    assert set(SERVED) <= set(MLLMS)
    assert all(claimants(name) in ([], [name]) for name in ALL)
    assert not [served for served in STRANGERS if claimants(served)]


@pytest.mark.slow  # transformers takes seconds to import
def test_the_limits_of_qwen2_5_vl_are_kept_by_transformers() -> None:
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import smart_resize

    image = load_families()["qwen2.5-vl"].image
    limits = {"factor": image.multiple, "min_pixels": image.min_pixels, "max_pixels": image.max_pixels}
    for size in ((1920, 1080), (5000, 4000), (40, 30), (641, 17)):
        height, width = smart_resize(size[1], size[0], **limits)
        assert height % 28 == width % 28 == 0
        assert image.min_pixels <= height * width <= image.max_pixels
        assert smart_resize(height, width, **limits) == (height, width), "it is not resized once more"


@pytest.mark.parametrize("name", OPEN)
def test_open_weights_are_named_without_pickles_and_run_here_where_transformers_has_their_class(name: str) -> None:
    manifest = OPEN[name]
    (source,) = manifest.sources.values()
    assert manifest.weights == source.repository == manifest.model
    assert manifest.licence == source.licence != ""

    def taken(file: str) -> bool:
        return any(fnmatchcase(file, pattern) for pattern in source.files)

    assert all(taken(file) for file in ("model-00001-of-00004.safetensors", "merges.txt", *NEEDED))
    assert not any(taken(file) for file in (*PICKLES, "modeling.py"))
    runs = manifest.family != "llava-onevision-1.5"
    assert bool(manifest.local) == runs
    assert manifest.extra == ("local" if runs else "providers")
    assert ({"torch", "transformers", "accelerate"} <= set(manifest.modules)) == runs
    if runs:
        assert manifest.local["max_new_tokens"] == manifest.defaults["max_tokens"]
    if name.endswith("-thinking"):
        assert manifest.parameters == OPEN[name.removesuffix("-thinking")].parameters
    assert manifest.defaults.get("temperature") == (None if name.endswith("-thinking") else 0)


def test_services_have_no_weights_and_need_no_more_than_their_client() -> None:
    for manifest in SERVICES.values():
        assert (manifest.licence, manifest.weights) == ("proprietary service", None)
        assert {**manifest.sources, **manifest.parameters, **manifest.local} == {}
        assert (manifest.extra, manifest.modules) == ("providers", ("pydantic_ai",))


@pytest.mark.slow
@pytest.mark.parametrize("size", QWEN3_VL)
def test_parameters_of_qwen3_vl_follow_from_its_sizes(size: str) -> None:
    """One that is dense and tied, and a mixture of experts."""
    import torch
    import transformers

    numbers, rest, vision = QWEN3_VL[size]
    kind = "Qwen3VLMoe" if "num_experts" in rest else "Qwen3VL"
    text = dict(zip(TEXT, numbers, strict=True)) | {"vocab_size": 151936, "head_dim": 128} | rest
    shared = {"patch_size": 16, "num_heads": 16, "num_position_embeddings": 2304, "out_hidden_size": numbers[0]}
    config = getattr(transformers, f"{kind}Config")(
        text_config=text, vision_config=shared | vision, tie_word_embeddings=rest.get("tie_word_embeddings", False)
    )
    with torch.device("meta"):
        parts: Any = getattr(transformers, f"{kind}ForConditionalGeneration")(config)
    parts.tie_weights()  # a weight that two layers share counts once
    total, vision_encoder = (sum(each.numel() for each in part.parameters()) for part in (parts, parts.model.visual))
    wanted = {"vision_encoder": vision_encoder, "language_model": total - vision_encoder}
    assert OPEN[f"qwen3-vl-{size}"].parameters == wanted
