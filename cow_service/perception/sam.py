"""Segmenters: SAM 2.1 (Ravi et al., 2024, arXiv:2408.00714) as `Sam2Model` of transformers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor
from transformers import Sam2Model

from cow_service.media.types import Image
from cow_service.perception.base import Prompt, Segment
from cow_service.perception.loading import LoadedModel, load, load_pretrained
from cow_service.settings import Settings

MOST_TOGETHER = 32  # prompts in one pass of the decoder, which takes some 40 MB for each
ON_IT, CORNERS = (1,), (2, 3)  # labels of the points of a prompt: one on the thing; first and last corner of a box


@dataclass(frozen=True)
class SamEmbedding:
    """What the image encoder made of one image."""

    maps: list[Tensor]  # [1, C, h, w] each, the finest first
    size: tuple[int, int]  # width and height of the image, px


class SamSegmenter:
    """A `Segmenter`. Three candidates for a point; one for a box, which leaves less open."""

    def __init__(self, model: LoadedModel) -> None:
        self._model = model
        self._side = int(model.network.config.prompt_encoder_config.image_size)
        self.fingerprint = model.fingerprint

    def embed(self, image: Image) -> SamEmbedding:
        """Runs the image encoder once. Raises `PerceptionUnavailable`."""
        with self._model.computing() as network:
            # A square whatever the shape of the image, as the model was trained.
            maps = network.get_image_embeddings(self._model.pixels(image, (self._side, self._side)))
        return SamEmbedding([each.float() for each in maps], (image.shape[1], image.shape[0]))

    def segment(self, embedding: SamEmbedding, prompts: Sequence[Prompt]) -> tuple[tuple[Segment, ...], ...]:
        """Candidates of each prompt, best first. A box counts more than a point. Raises `PerceptionUnavailable`."""
        found: dict[int, tuple[Segment, ...]] = {}
        # Points and boxes apart: filled up to one length, a prompt would get another mask than alone.
        for labels in (ON_IT, CORNERS):
            chosen = [i for i, prompt in enumerate(prompts) if (prompt.bbox is None) == (labels == ON_IT)]
            for start in range(0, len(chosen), MOST_TOGETHER):
                batch = chosen[start : start + MOST_TOGETHER]
                places = [prompts[i].bbox or prompts[i].point for i in batch]
                found |= zip(batch, self._decode(embedding, np.array(places, np.float32), labels), strict=True)
        return tuple(found[i] for i in range(len(prompts)))

    def _decode(
        self, embedding: SamEmbedding, places: np.ndarray, labels: tuple[int, ...]
    ) -> list[tuple[Segment, ...]]:
        """For places [P, 2 * len(labels)], px of the image."""
        # The model takes indices of pixels and adds half of one itself.
        points = places.reshape(1, len(places), -1, 2) * self._side / np.array(embedding.size, np.float32) - 0.5
        with self._model.computing(is_precise=True) as network:  # half precision would move points by pixels
            output = network(
                image_embeddings=embedding.maps,
                input_points=torch.tensor(points, device=self._model.device),
                input_labels=torch.tensor(labels, device=self._model.device).expand(1, len(places), -1),
                multimask_output=labels == ON_IT,
            )
            logits = output.pred_masks[0].cpu().numpy()  # [P, candidates, h, w]
            scores = output.iou_scores[0].clamp(0, 1).cpu().numpy()  # [P, candidates]
        return [
            tuple(Segment(logits[i, j], float(scores[i, j])) for j in np.argsort(-scores[i], kind="stable"))
            for i in range(len(places))
        ]


def load_segmenter(name: str, settings: Settings) -> SamSegmenter:
    """Factory of the entry points. Raises `PerceptionUnavailable`."""
    # The public code computes in bfloat16 on GPUs, too. What the checkpoint has for videos is left out.
    return SamSegmenter(load(name, settings, partial(load_pretrained, Sam2Model, name), torch.bfloat16))


create_sam2_tiny = partial(load_segmenter, "sam2-tiny")
create_sam2_large = partial(load_segmenter, "sam2-large")
