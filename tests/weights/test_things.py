"""The weights of the eye that are shipped in `models/`."""

from __future__ import annotations

import hashlib
import json

import cv2
import numpy as np
from conftest import ROOT

WEIGHTS = ROOT / "models" / "things.onnx"


def test_the_file_is_the_one_that_its_card_names() -> None:
    card = json.loads(WEIGHTS.with_suffix(".json").read_text())
    assert card["sha256"] == hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()
    assert card["bytes"] == WEIGHTS.stat().st_size <= 3_000_000
    assert card["licence"] == "Apache-2.0"


def test_opencv_reads_it_at_any_size() -> None:
    network = cv2.dnn.readNetFromONNX(str(WEIGHTS))
    for height, width in ((384, 640), (640, 384), (64, 96)):
        network.setInput(cv2.dnn.blobFromImage(np.zeros((height, width, 3), np.uint8), 1 / 255))
        fine, coarse = network.forward(["fine", "coarse"])
        assert fine.shape == (1, 6, height // 2, width // 2)
        assert coarse.shape == (1, 7, height // 4, width // 4)
        assert np.isfinite(fine).all()
        assert np.isfinite(coarse).all()
