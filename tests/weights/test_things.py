"""The weights of the eye that are shipped in `models/`."""

from __future__ import annotations

import hashlib
import json
import sys
from importlib.util import module_from_spec, spec_from_file_location

import cv2
import numpy as np
import pytest
from conftest import ROOT

from cow_service.perception.eye import Eye

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


def test_training_and_service_see_the_same() -> None:
    """What is measured and calibrated where the network is trained has an implementation of its own."""
    spec = spec_from_file_location("decode", ROOT / "cow-scenes" / "cow_scenes" / "eye" / "decode.py")
    assert spec is not None
    assert spec.loader is not None
    decode = sys.modules["decode"] = module_from_spec(spec)
    spec.loader.exec_module(decode)
    image = cv2.imread(str(ROOT / "examples" / "ball-and-mug" / "clean.jpg"))[..., ::-1].copy()
    trained = [each for each in decode.Eye(WEIGHTS).look(image).instances if not each.is_flat]
    served = Eye().look(image).instances
    assert [each.probability for each in served] == pytest.approx([each.probability for each in trained])
    assert all(np.array_equal(one.mask.full(), other.mask) for one, other in zip(served, trained, strict=True))
    assert served
