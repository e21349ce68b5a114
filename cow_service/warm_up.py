"""One tiny simulation before anybody asks: else the first request waits for modules, grammar, tables and threads."""

from __future__ import annotations

import logging
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from cow_service.errors import CowError
from cow_service.media.images import encode_png
from cow_service.requests import ImageArtifact, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

WIDTH, HEIGHT = 320, 180  # px
BALL, BOX = (80, 110), (220, 85, 260, 130)  # px
QUESTION = "If the red ball moves in the direction of the arrow, will it hit the blue box?"

log = logging.getLogger("cow_service")


def warm_up(settings: Settings) -> None:
    """Imagines with the backends that need no weights. Nothing of it is kept; a failure is logged."""
    try:
        with TemporaryDirectory(prefix="cow-warm-up-") as folder:
            alone = {"data_dir": Path(folder), "artifacts": None, "reader": "embedded", "generator": "cutout"}
            service = Service(settings.model_copy(update=alone))
            artifact, image = service.keep_image(encode_png(_picture()))
            request = SimulateRequest(image=ImageArtifact(artifact=artifact.sha256), question=QUESTION, num_frames=9)
            service.simulate(request, image=image).model_dump_json()
            service.close()
    except (CowError, OSError) as error:
        log.warning("the warm-up failed, the first request will take longer: %s", error)


def _picture() -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """A ball, an arrow on it and a box, on a floor."""
    picture = np.full((HEIGHT, WIDTH, 3), 190, np.uint8)
    picture[: HEIGHT // 3] = 225
    cv2.circle(picture, BALL, 22, (200, 40, 40), -1, cv2.LINE_AA)
    cv2.rectangle(picture, BOX[:2], BOX[2:], (40, 70, 200), -1)
    cv2.arrowedLine(picture, (105, 110), (165, 110), (240, 40, 40), 4, cv2.LINE_AA, 0, 0.3)
    return picture
