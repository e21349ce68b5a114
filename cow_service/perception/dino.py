"""Detectors: Grounding DINO (Liu et al., 2023, arXiv:2303.05499) of transformers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from transformers import AutoTokenizer, GroundingDinoForObjectDetection

from cow_service.media.masks import iou
from cow_service.media.types import Image
from cow_service.perception.base import Detection
from cow_service.perception.loading import LoadedModel, load, load_pretrained, translated
from cow_service.records import BBox
from cow_service.settings import Settings

SHORT_SIDE, LONG_SIDE = 800, 1333  # px: as the model was trained, the first as far as the second allows
LEAST_SIDE = 32  # px: the coarsest of its feature maps has one cell for that


class DinoDetector:
    """A `Detector`. Of the manifest it takes `box_threshold`, `text_threshold` and `overlap`."""

    def __init__(self, model: LoadedModel, tokenizer: Any) -> None:
        self._model = model
        self._tokenizer = tokenizer
        self._most = int(model.network.config.max_text_len)
        self._stop = int(tokenizer.convert_tokens_to_ids("."))
        defaults = model.manifest.defaults
        self._box, self._text, self._overlap = (
            float(defaults[name]) for name in ("box_threshold", "text_threshold", "overlap")
        )
        self.fingerprint = model.fingerprint

    def detect(self, image: Image, phrases: Sequence[str]) -> tuple[Detection, ...]:
        """What the phrases name, best first; each thing goes to the phrase that fits it best.

        Phrases that do not fit into the model's text together are sought one group after the other.
        Raises `PerceptionUnavailable`.
        """
        groups: list[list[tuple[str, list[int]]]] = [[]]
        length = 2  # of a group: the tokens around it, and each phrase with its full stop
        for phrase in dict.fromkeys(phrases):
            ids = self._tokenizer(phrase.lower(), add_special_tokens=False)["input_ids"]
            ids = [each for each in ids if each != self._stop][: self._most - 3]
            if length + len(ids) + 1 > self._most:
                groups.append([])
                length = 2
            if ids:
                groups[-1].append((phrase, ids))
                length += len(ids) + 1
        found = [each for group in groups if group for each in self._detect(image, group)]
        kept: list[Detection] = []
        for each in sorted(found, key=lambda each: -each.score):
            if not any(each.phrase == one.phrase and iou(each.bbox, one.bbox) > self._overlap for one in kept):
                kept.append(each)
        return tuple(kept)

    def _detect(self, image: Image, group: list[tuple[str, list[int]]]) -> list[Detection]:
        height, width = image.shape[:2]
        scale = min(SHORT_SIDE / min(width, height), LONG_SIDE / max(width, height))
        size = max(LEAST_SIDE, round(width * scale)), max(LEAST_SIDE, round(height * scale))
        ids = [self._tokenizer.cls_token_id]
        spans: list[slice] = []
        for _, tokens in group:
            spans.append(slice(len(ids), len(ids) + len(tokens)))
            ids += [*tokens, self._stop]
        text = torch.tensor([[*ids, self._tokenizer.sep_token_id]], device=self._model.device)
        with self._model.computing() as network:
            pixels = self._model.pixels(image, size)
            output = network(
                pixel_values=pixels,
                pixel_mask=torch.ones_like(pixels[:, 0], dtype=torch.long),
                input_ids=text,
                token_type_ids=torch.zeros_like(text),
                attention_mask=torch.ones_like(text),
            )
            chances = output.logits[0].float().sigmoid().cpu().numpy()  # [queries, tokens]
            boxes = output.pred_boxes[0].float().cpu().numpy()  # [queries, 4]: middle and size, as shares of the image
        # The mean over a phrase's tokens, so that a long phrase does not win by its length.
        shares = np.stack([(chances * (chances > self._text))[:, span].mean(axis=1) for span in spans])
        scores = np.stack([chances[:, span].max(axis=1) for span in spans])
        return [
            Detection(group[best][0], _bbox(boxes[query], width, height), float(scores[best, query]))
            for query, best in enumerate(shares.argmax(axis=0))
            if scores[best, query] > self._box
        ]


def _bbox(box: np.ndarray, width: int, height: int) -> BBox:
    """In pixels, clipped to the image."""
    middle, half = box[:2], box[2:] / 2
    corners = np.clip([*(middle - half), *(middle + half)], 0, 1) * [width, height, width, height]
    x0, y0, x1, y1 = corners.tolist()
    return x0, y0, x1, y1


def load_detector(name: str, settings: Settings) -> DinoDetector:
    """Factory of the entry points. Raises `PerceptionUnavailable`."""
    # Float32 on GPUs, too: half precision moves the points at which its attention samples.
    model = load(name, settings, partial(load_pretrained, GroundingDinoForObjectDetection, name))
    with translated(name, "has no tokenizer that can be loaded", model.device):
        return DinoDetector(model, AutoTokenizer.from_pretrained(model.folder, local_files_only=True))


create_dino_tiny = partial(load_detector, "grounding-dino-tiny")
create_dino_base = partial(load_detector, "grounding-dino-base")
