"""The vision models at toy size: real classes, seeded random weights, files as they are published.

To be imported in fixtures: it loads torch and transformers.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch
import transformers
from safetensors.torch import load_file, save_file
from transformers import BertConfig, BertTokenizer, Dinov2Config, Sam2HieraDetConfig, Sam2VisionConfig, SwinConfig

from cow_service.perception import depth, dino, moge, sam
from cow_service.perception.loading import LoadedModel, load, load_pretrained
from cow_service.settings import Settings

__all__ = ["load_file", "save_file", "torch"]  # for tests that may not import them
SIDE = 128  # px: what the toy segmenter sees
MOGE_BACKBONE = {"toy": (32, 2, 2)}  # to be added to `moge.BACKBONES`
WORDS = ("blue", "mug", "ball", "yellow", "table", "red", "a")


def save_lively(network: Any, folder: Path) -> None:
    """With larger weights than those of transformers, which would make nearly the same of everything."""
    for weight in network.parameters():
        if weight.ndim > 1:
            weight.data *= 8
    network.save_pretrained(folder)


def make_sam(folder: Path) -> None:
    """As it is published: a model for videos; only its part for images is used."""
    hiera = Sam2HieraDetConfig(
        hidden_size=8, image_size=[SIDE, SIDE], embed_dim_per_stage=[8, 16, 32, 64], blocks_per_stage=[1, 1, 2, 1],
        num_attention_heads_per_stage=[1, 1, 2, 2], window_size_per_stage=[4, 4, 4, 4], global_attention_blocks=[3],
    )  # fmt: skip
    vision = Sam2VisionConfig(
        backbone_config=hiera, backbone_channel_list=[64, 32, 16, 8], fpn_hidden_size=32,
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
    )  # fmt: skip
    config = transformers.Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": 32, "image_size": SIDE},
        mask_decoder_config={"hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
        memory_attention_hidden_size=32, memory_attention_num_layers=1, memory_encoder_hidden_size=32,
        memory_attention_feed_forward_hidden_size=32, mask_downsampler_embed_dim=32, memory_fuser_embed_dim=32,
        memory_fuser_intermediate_dim=32, memory_fuser_num_layers=1, image_size=SIDE,
    )  # fmt: skip
    save_lively(transformers.Sam2VideoModel(config), folder)


def make_dino(folder: Path) -> None:
    swin = SwinConfig(
        embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 2, 2], window_size=4, out_indices=[2, 3, 4], image_size=64
    )
    text = BertConfig(
        vocab_size=1100, hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=16
    )  # fmt: skip
    config = transformers.GroundingDinoConfig(
        backbone_config=swin, text_config=text, d_model=32, num_queries=20, encoder_layers=1, decoder_layers=2,
        encoder_attention_heads=2, decoder_attention_heads=2, encoder_ffn_dim=32, decoder_ffn_dim=32, max_text_len=8,
    )  # fmt: skip
    save_lively(transformers.GroundingDinoForObjectDetection(config), folder)
    # The ids of these four are fixed in the model's code.
    fixed = {0: "[PAD]", 100: "[UNK]", 101: "[CLS]", 102: "[SEP]", 103: "[MASK]", 1012: ".", 1029: "?"}
    words = dict(enumerate(WORDS, start=1040))
    vocabulary = [(fixed | words).get(i, f"[unused{i}]") for i in range(1100)]
    (folder / "vocab.txt").write_text("\n".join(vocabulary))
    BertTokenizer(vocab={word: i for i, word in enumerate(vocabulary)}).save_pretrained(folder)


def make_depth_anything(folder: Path) -> None:
    backbone = Dinov2Config(
        hidden_size=32, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, neck_hidden_sizes=[8, 8, 8, 8], reassemble_hidden_size=32, fusion_hidden_size=8,
        head_hidden_size=8, depth_estimation_type="metric", max_depth=20,
    )  # fmt: skip
    save_lively(transformers.DepthAnythingForDepthEstimation(config), folder)


def make_moge(folder: Path) -> None:
    widths = [16, 8, 8]
    stack = {"dim_in": widths, "dim_res_blocks": widths, "resamplers": ["conv_transpose", "bilinear"]}
    stack |= {"num_res_blocks": [0, 1, 0], "res_block_in_norm": "none", "res_block_hidden_norm": "none"}
    config = {
        "encoder": {"backbone": "toy", "intermediate_layers": [0, 1], "dim_out": 16},
        "neck": stack | {"dim_in": [18, 2, 2], "dim_out": None},
        "points_head": stack | {"dim_out": [None, None, 3]}, "mask_head": stack | {"dim_out": [None, None, 1]},
        "normal_head": stack | {"dim_out": [None, None, 3]}, "scale_head": {"dims": [32, 16, 1]},
        "remap_output": "exp", "num_tokens_range": [12, 54],
    }  # fmt: skip
    weights = dict(moge.Moge(**config).state_dict())
    weights |= {"normal_head.x": torch.zeros(1), "encoder.image_mean": torch.zeros(1, 3, 1, 1)}
    weights["mask_head.output_blocks.2.bias"] += 5  # it sees a surface everywhere
    torch.save({"model_config": config, "model": weights}, folder / "model.pt")


MAKERS = {
    "sam2-tiny": make_sam, "grounding-dino-tiny": make_dino, "depth-anything-indoor": make_depth_anything,
    "moge-2-small": make_moge,
}  # fmt: skip

FACTORIES = {
    "sam2-tiny": sam.create_sam2_tiny, "grounding-dino-tiny": dino.create_dino_tiny,
    "depth-anything-indoor": depth.create_depth_anything_indoor, "moge-2-small": depth.create_moge_2_small,
}  # fmt: skip
CALLS = {
    "sam2-tiny": lambda toy, image: toy.embed(image),
    "grounding-dino-tiny": lambda toy, image: toy.detect(image, ["ball"]),
    "depth-anything-indoor": lambda toy, image: toy.estimate(image, None),
    "moge-2-small": lambda toy, image: toy.estimate(image, None),
}


def networks(settings: Settings) -> tuple[dict[str, LoadedModel], Any]:
    """The networks inside of the models and the detector's tokenizer, for tests that listen to them."""
    builders = {
        "sam2-tiny": partial(load_pretrained, transformers.Sam2Model),
        "grounding-dino-tiny": partial(load_pretrained, transformers.GroundingDinoForObjectDetection),
        "depth-anything-indoor": partial(load_pretrained, transformers.DepthAnythingForDepthEstimation),
        "moge-2-small": moge.load_moge,
    }
    loaded = {name: load(name, settings, partial(build, name)) for name, build in builders.items()}
    return loaded, transformers.AutoTokenizer.from_pretrained(loaded["grounding-dino-tiny"].folder)
