"""The manifests of multimodal LLMs: which served name means which, what each family does, sizes computed again."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any

import pytest
import torch

from cow_service.weights.manifests import FAMILIES, MANIFESTS, Manifest, load_families, load_manifests

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

# Names as servers give them, of the vendors, Ollama, vLLM and gateways, and the manifest that each means.
SERVED = {
    "Qwen3-VL-8B-Instruct": "qwen3-vl-8b",
    "qwen/qwen3-vl-8b-instruct": "qwen3-vl-8b",
    "Qwen/Qwen3-VL-8B-Instruct-FP8": "qwen3-vl-8b",
    "/weights/Qwen3-VL-8B-Instruct": "qwen3-vl-8b",
    "qwen3-vl:8b-instruct-q4_K_M": "qwen3-vl-8b",
    "qwen3-vl": "qwen3-vl-8b-thinking",
    "qwen3-vl:8b": "qwen3-vl-8b-thinking",
    "qwen3-vl:8b-thinking": "qwen3-vl-8b-thinking",
    "qwen3-vl:2b-instruct": "qwen3-vl-2b",
    "qwen3-vl:30b": "qwen3-vl-30b-a3b-thinking",
    "qwen3-vl:30b-a3b-instruct-q8_0": "qwen3-vl-30b-a3b",
    "qwen3-vl:32b-instruct": "qwen3-vl-32b",
    "qwen3-vl:235b-instruct-cloud": "qwen3-vl-235b-a22b",
    "qwen3-vl-235b-a22b-thinking": "qwen3-vl-235b-a22b-thinking",
    "qwen2.5vl": "qwen2.5-vl-7b",
    "qwen2.5vl:3b": "qwen2.5-vl-3b",
    "qwen2.5vl:32b": "qwen2.5-vl-32b",
    "Qwen/Qwen2.5-VL-72B-Instruct-AWQ": "qwen2.5-vl-72b",
    "lmms-lab/LLaVA-OneVision-1.5-4B-Instruct": "llava-onevision-1.5-4b",
    "gpt-5": "gpt-5",
    "gpt-5-2025-08-07": "gpt-5",
    "openai/gpt-5.1": "gpt-5",
    "gpt-5.5-2026-04-23": "gpt-5",
    "gpt-5-mini-2025-08-07": "gpt-5-mini",
    "gpt-5.4-mini": "gpt-5-mini",
    "gpt-5.6": "gpt-5.6",
    "gpt-5.6-luna": "gpt-5.6",
    "gpt-6-sol": "gpt-6.1-sol",
    "gemini-2.5-pro-preview-06-05": "gemini-2.5-pro",
    "google/gemini-2.5-flash": "gemini-2.5-flash",
    "gemini-2.5-flash-preview-09-2025": "gemini-2.5-flash",
    "gemini-2.5-flash-lite": "gemini-3.5-flash-lite",
    "gemini-3-pro-preview": "gemini-3.1-pro",
    "gemini-3.6-flash": "gemini-3.8-flash",
    "claude-sonnet-5": "claude-sonnet-5-5",
    "claude-opus-4-8": "claude-opus-5-5",
    "claude-sonnet-4-5-20250929": "claude-sonnet-4-6",
    "anthropic/claude-opus-4.6": "claude-opus-4-6",
    "claude-haiku-4-5-20251001": "claude-haiku-4-5",
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
    "4b": ((2560, 36, 32, 8, 9728), {"tie_word_embeddings": True}, SMALL_VIT),
    "8b": ((4096, 36, 32, 8, 12288), {}, VIT),
    "32b": ((5120, 64, 64, 8, 25600), {}, VIT),
    "30b-a3b": ((2048, 48, 32, 4, 6144), {"num_experts": 128, "moe_intermediate_size": 768}, VIT),
    "235b-a22b": ((4096, 94, 64, 4, 12288), {"num_experts": 128, "moe_intermediate_size": 1536}, VIT),
}
QWEN2_5_VL: dict[str, tuple[tuple[int, ...], dict[str, Any], int]] = {
    "3b": ((2048, 36, 16, 2, 11008), {"vocab_size": 151936, "tie_word_embeddings": True}, 3420),
    "7b": ((3584, 28, 28, 4, 18944), {"vocab_size": 152064}, 3420),
    "32b": ((5120, 64, 40, 8, 27648), {"vocab_size": 152064}, 3456),
    "72b": ((8192, 80, 64, 8, 29568), {"vocab_size": 152064}, 3456),
}


def claimants(served: str) -> list[str]:
    """The manifests that a served name means; upper and lower case are the same."""
    return [
        name
        for name, manifest in MLLMS.items()
        if any(fnmatchcase(served.lower(), each.lower()) for each in (manifest.model or "", *manifest.also))
    ]


def counts(model: torch.nn.Module) -> dict[str, int]:
    """Parameters by part; a weight that two layers share counts once."""
    parts: Any = model
    parts.tie_weights()
    total, vision = (sum(each.numel() for each in part.parameters()) for part in (model, parts.model.visual))
    return {"vision_encoder": vision, "language_model": total - vision}


class TestNames:
    def test_are_those_of_the_files_and_lower_case(self) -> None:
        assert all(load_manifests()[name].name == name == name.lower() for name in MANIFESTS.names())
        assert all(load_families()[name].name == name == name.lower() for name in FAMILIES.names())

    def test_every_model_is_claimed_by_its_own_manifest_alone(self) -> None:
        for name, manifest in MLLMS.items():
            model = str(manifest.model)
            for served in (model, model.rpartition("/")[2], model.upper()):
                assert claimants(served) == [name]

    @pytest.mark.parametrize(("served", "name"), SERVED.items())
    def test_a_served_name_means_one_manifest(self, served: str, name: str) -> None:
        assert claimants(served) == [name]

    @pytest.mark.parametrize("served", STRANGERS)
    def test_other_models_are_not_claimed(self, served: str) -> None:
        assert claimants(served) == []

    @pytest.mark.parametrize("name", ALL)
    def test_the_name_of_a_manifest_means_no_other(self, name: str) -> None:
        assert claimants(name) in ([], [name])

    def test_no_model_that_pydantic_ai_knows_is_claimed_twice(self) -> None:
        names = pytest.importorskip("pydantic_ai.models").known_model_names()
        assert not {each: found for each in names if len(found := claimants(each.partition(":")[2])) > 1}


class TestFamilies:
    def test_each_is_used_and_each_manifest_has_one(self) -> None:
        assert {manifest.family for manifest in ALL.values()} == set(load_families())

    @pytest.mark.parametrize("size", [(1920, 1080), (5000, 4000), (40, 30), (641, 17)], ids="{0[0]}x{0[1]}".format)
    def test_the_limits_of_qwen2_5_vl_are_kept_by_transformers(self, size: tuple[int, int]) -> None:
        from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import smart_resize

        image = load_families()["qwen2.5-vl"].image
        limits = {"factor": image.multiple, "min_pixels": image.min_pixels, "max_pixels": image.max_pixels}
        height, width = smart_resize(size[1], size[0], **limits)
        assert height % 28 == width % 28 == 0
        assert image.min_pixels <= height * width <= image.max_pixels
        assert smart_resize(height, width, **limits) == (height, width), "it is not resized once more"

    def test_an_image_within_the_limits_of_claude_is_not_shrunk(self) -> None:
        """Its vendor shrinks what has a longer side than 1568 px or more than about 1600 tokens of 750 pixels."""
        image = load_families()["claude"].image
        assert image.max_side == 1568
        assert image.max_pixels / 750 <= 1600


class TestOpenWeights:
    @pytest.mark.parametrize("manifest", OPEN.values(), ids=OPEN)
    def test_its_files_are_named_without_pickles_and_with_a_licence(self, manifest: Manifest) -> None:
        assert set(manifest.sources) == {"weights"}
        source = manifest.sources["weights"]
        assert manifest.weights == source.repository == manifest.model
        assert manifest.licence == source.licence != ""

        def taken(file: str) -> bool:
            return any(fnmatchcase(file, pattern) for pattern in source.files)

        assert all(taken(file) for file in ("model-00001-of-00004.safetensors", "merges.txt", *NEEDED))
        assert not any(taken(file) for file in (*PICKLES, "modeling.py"))

    @pytest.mark.parametrize("manifest", OPEN.values(), ids=OPEN)
    def test_it_runs_in_process_only_where_transformers_has_its_class(self, manifest: Manifest) -> None:
        runs = manifest.family != "llava-onevision-1.5"
        assert bool(manifest.local) == runs
        assert manifest.extra == ("local" if runs else "providers")
        assert ({"torch", "transformers", "accelerate"} <= set(manifest.modules)) == runs
        if runs:
            assert manifest.local["max_new_tokens"] == manifest.defaults["max_tokens"]

    @pytest.mark.parametrize("name", [name for name in OPEN if not name.endswith("-thinking")])
    def test_one_that_thinks_has_the_same_sizes(self, name: str) -> None:
        thinking = OPEN.get(f"{name}-thinking")
        if thinking is not None:
            assert thinking.parameters == OPEN[name].parameters
            assert "temperature" not in thinking.defaults
        assert OPEN[name].defaults["temperature"] == 0

    @pytest.mark.parametrize("size", QWEN3_VL)
    def test_parameters_of_qwen3_vl_follow_from_its_sizes(self, size: str) -> None:
        import transformers

        numbers, rest, vision = QWEN3_VL[size]
        kind = "Qwen3VLMoe" if "num_experts" in rest else "Qwen3VL"
        tied = rest.get("tie_word_embeddings", False)
        text = dict(zip(TEXT, numbers, strict=True)) | {"vocab_size": 151936, "head_dim": 128} | rest
        shared = {"patch_size": 16, "num_heads": 16, "num_position_embeddings": 2304, "out_hidden_size": numbers[0]}
        config = getattr(transformers, f"{kind}Config")(
            text_config=text, vision_config=shared | vision, tie_word_embeddings=tied
        )
        with torch.device("meta"):
            model = getattr(transformers, f"{kind}ForConditionalGeneration")(config)
        assert counts(model) == OPEN[f"qwen3-vl-{size}"].parameters

    @pytest.mark.parametrize("size", QWEN2_5_VL)
    def test_parameters_of_qwen2_5_vl_follow_from_its_sizes(self, size: str) -> None:
        from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

        numbers, rest, intermediate = QWEN2_5_VL[size]
        vision = {"depth": 32, "hidden_size": 1280, "num_heads": 16, "patch_size": 14, "out_hidden_size": numbers[0]}
        config = Qwen2_5_VLConfig(
            text_config=dict(zip(TEXT, numbers, strict=True)) | rest,
            vision_config=vision | {"intermediate_size": intermediate},
            tie_word_embeddings=rest.get("tie_word_embeddings", False),
        )
        with torch.device("meta"):
            model = Qwen2_5_VLForConditionalGeneration(config)
        assert counts(model) == OPEN[f"qwen2.5-vl-{size}"].parameters


class TestServices:
    @pytest.mark.parametrize("manifest", SERVICES.values(), ids=SERVICES)
    def test_it_has_no_weights_and_needs_no_more_than_its_client(self, manifest: Manifest) -> None:
        assert manifest.licence == "proprietary service"
        assert manifest.weights is None
        assert {**manifest.sources, **manifest.parameters, **manifest.local} == {}
        assert (manifest.extra, manifest.modules) == ("providers", ("pydantic_ai",))

    @pytest.mark.parametrize("provider", sorted({str(manifest.provider) for manifest in SERVICES.values()}))
    def test_pydantic_ai_knows_its_provider(self, provider: str) -> None:
        assert pytest.importorskip("pydantic_ai.providers").infer_provider_class(provider)

    @pytest.mark.parametrize("manifest", SERVICES.values(), ids=SERVICES)
    def test_pydantic_ai_says_that_it_takes_what_it_is_sent(self, manifest: Manifest) -> None:
        """A schema for the reply; a temperature only where the model takes one."""
        provider = pytest.importorskip("pydantic_ai.providers").infer_provider_class(str(manifest.provider))
        profile = dict(provider.model_profile(manifest.model))
        assert profile["supports_json_schema_output"]
        if "temperature" in manifest.defaults:
            assert manifest.family == "claude", "the others reason first"
            assert not profile.get("anthropic_disallows_sampling_settings")
