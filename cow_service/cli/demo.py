"""The example of `cow demo`."""

from __future__ import annotations

from contextlib import AbstractContextManager
from importlib.resources import as_file
from pathlib import Path

from cow_service.weights.manifests import EXAMPLES

QUESTION = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"


def example_image() -> AbstractContextManager[Path]:
    """Its image as a file, inside the block."""
    return as_file(EXAMPLES["ball-and-mug"].file("image"))
