"""Memory and time of the vision models at their published sizes with random weights; quality is not measured.

    python benchmarks/perception.py [NAME...]

Each runs in a process of its own, on an image of 1024x1024 px; first calls are not counted. Writes a JSON file.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import Any

import numpy as np
import torch
import transformers as tf

from cow_service.perception.base import Prompt
from cow_service.perception.depth import DepthAnythingEstimator, MogeEstimator
from cow_service.perception.dino import DinoDetector
from cow_service.perception.loading import LoadedModel
from cow_service.perception.moge import Moge
from cow_service.perception.sam import SamSegmenter
from cow_service.weights.manifests import load_manifests

RESULTS = Path(__file__).parent / "results" / "perception.json"
SIDE = 1024  # px
PHRASES = ["yellow ball", "blue mug", "wooden table", "glass bottle", "red block"]
METRIC = tf.DepthAnythingConfig(depth_estimation_type="metric", max_depth=20)
# Words are unknown here, one token each: the real vocabulary comes with the weights.
VOCABULARY = {"[PAD]": 0, "[UNK]": 100, "[CLS]": 101, "[SEP]": 102, "[MASK]": 103, ".": 1012}
LARGE_HIERA = {
    "hidden_size": 144, "num_attention_heads": 2, "embed_dim_per_stage": [144, 288, 576, 1152],
    "num_attention_heads_per_stage": [2, 4, 8, 16], "blocks_per_stage": [2, 6, 36, 4],
    "global_attention_blocks": [23, 33, 43], "window_size_per_stage": [8, 4, 16, 8],
}  # fmt: skip
STAGES: Any = {"out_indices": [2, 3, 4]}
BASE_SWIN = {"embed_dim": 128, "depths": [2, 2, 18, 2], "num_heads": [4, 8, 16, 32], "window_size": 12}


def sam(**hiera: Any) -> torch.nn.Module:
    backbone = tf.Sam2HieraDetConfig(**hiera)
    channels = list(backbone.embed_dim_per_stage or ())[::-1]
    vision = tf.Sam2VisionConfig(backbone_config=backbone, backbone_channel_list=channels)
    return tf.Sam2Model(tf.Sam2Config(vision_config=vision))


def dino(**swin: Any) -> torch.nn.Module:
    backbone = tf.SwinConfig(**STAGES, **swin) if swin else None  # by default Swin-T
    return tf.GroundingDinoForObjectDetection(tf.GroundingDinoConfig(backbone_config=backbone))


def moge(backbone: str, width: int, layers: list[int]) -> torch.nn.Module:
    """The layout that is published for ViT-L; that of ViT-S stands in its checkpoint and is taken to be the same."""
    widths, resamplers = [width, 256, 128, 64, 32], ["conv_transpose"] * 3 + ["bilinear"]
    stack = {"dim_in": widths, "dim_res_blocks": widths, "num_res_blocks": [0, 1, 1, 1, 0], "resamplers": resamplers}
    stack |= {"res_block_in_norm": "none", "res_block_hidden_norm": "none"}
    encoder = {"backbone": backbone, "intermediate_layers": layers, "dim_out": width}
    neck = stack | {"dim_in": [width + 2, 2, 2, 2, 2], "num_res_blocks": [0, 2, 2, 2, 0], "dim_out": None}
    points, mask = (stack | {"dim_out": [None] * 4 + [channels]} for channels in (3, 1))
    return Moge(encoder, neck, points, mask, {"dims": [width, width, width, 1]}, "exp", (1200, 3600))


NETWORKS: dict[str, Callable[[], torch.nn.Module]] = {
    "sam2-tiny": sam,
    "sam2-large": lambda: sam(**LARGE_HIERA),
    "grounding-dino-tiny": dino,
    "grounding-dino-base": lambda: dino(**BASE_SWIN),
    "moge-2-small": lambda: moge("dinov2_vits14", 384, [2, 5, 8, 11]),
    "moge-2-large": lambda: moge("dinov2_vitl14", 1024, [5, 11, 17, 23]),
    "depth-anything-indoor": lambda: tf.DepthAnythingForDepthEstimation(METRIC),
}


def calls(model: LoadedModel, image: np.ndarray) -> Iterator[tuple[str, Callable[[], Any]]]:
    name = model.manifest.name
    if name.startswith("sam2"):
        segmenter = SamSegmenter(model)
        yield "embed", lambda: segmenter.embed(image)
        known = segmenter.embed(image)
        yield "1 prompt", lambda: segmenter.segment(known, [Prompt(point=(300.0, 400.0))])
        yield "16 prompts", lambda: segmenter.segment(known, [Prompt(bbox=(40.0, 50.0, 240.0, 300.0))] * 16)
    elif name.startswith("grounding"):
        detector = DinoDetector(model, tf.BertTokenizer(vocab=VOCABULARY))
        yield "5 phrases", lambda: detector.detect(image, PHRASES)
    else:
        estimator = (MogeEstimator if name.startswith("moge") else DepthAnythingEstimator)(model)
        yield "depth", lambda: estimator.estimate(image, None)


def measure(name: str) -> dict[str, Any]:
    torch.manual_seed(0)
    network = NETWORKS[name]().eval().requires_grad_(False)
    model = LoadedModel(load_manifests()[name], Path(), network, torch.device("cpu"), name)
    image = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3), np.uint8)
    times: dict[str, dict[str, float]] = {}
    for what, call in calls(model, image):
        call()
        wall, cpu = time.perf_counter(), time.process_time()
        call()
        times[what] = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    size, peak = sum(each.numel() for each in network.parameters()), 1024 * getrusage(RUSAGE_SELF).ru_maxrss
    return {"name": name, "parameters": size, "peak_bytes": peak, "times": times}


def main() -> None:
    rows: list[dict[str, Any]] = []
    print("| model | parameters | peak memory | wall time (CPU time) |\n|---|---|---|---|")
    for name in sys.argv[1:] or NETWORKS:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            rows.append(row := pool.submit(measure, name).result())
        times = ", ".join(f"{what} {t['wall_s']:.1f} s ({t['cpu_s']:.1f})" for what, t in row["times"].items())
        print(f"| `{name}` | {row['parameters'] / 1e6:.1f} M | {row['peak_bytes'] / 1e9:.1f} GB | {times} |")
    facts = {"image": SIDE, "weights": "random", "torch": torch.__version__, "threads": torch.get_num_threads()}
    RESULTS.write_text(json.dumps(facts | {"models": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
