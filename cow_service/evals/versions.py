"""What took part in an evaluation, and in which version."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version

from cow_service import __version__
from cow_service.readers.prompts import load_prompt

PACKAGES = ("inspect-ai", "numpy", "opencv-python-headless", "rapier3d", "scipy", "torch", "diffusers", "openai")
PROMPTS = ("eval-question", "identify", "locate", "scale", "answer-from-image", "answer-with-frames")


def versions() -> dict[str, str]:
    """Of this service, of Python, of the packages that are installed, and of the prompts."""
    found = {"cow-service": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    for name in PROMPTS:
        prompt = load_prompt(name)
        digest = hashlib.sha256(prompt.body.encode()).hexdigest()
        found[f"prompts/{name}"] = f"{prompt.version} (sha256 {digest})"
    return found
