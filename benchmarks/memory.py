"""Measures how much memory the server and its worker take at the most, by kind and size of picture.

    python benchmarks/memory.py [--megapixels 2 8 24] [--kinds NAME ...] [--json FILE]

A real server with one worker process computes one job after another, each of another kind; Linux forgets the peaks of
both processes before each of them. `download` is the peak of the server while every format of the job is fetched.
Figures are MB (10^6 bytes) of resident memory; what both processes share, some 40 MB of libraries, is counted twice.
"""

from __future__ import annotations

import argparse
import base64
import json
import math
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import psutil
from growth import of_objects, of_size  # beside this file
from latency import peak_memory_mb, start_server

from cow_service.media.images import encode_png

Asked = tuple[bytes, dict[str, Any]]
"""A picture, and the request."""
KINDS: dict[str, Callable[[int, int], Asked]] = {}
QUESTION = "If the red box moves to the right, will it hit the blue box?"
FORMATS = "zip", "page", "film", "card", "gif", "webp", "sheet"
MASKS = 16


def kind(make: Callable[[int, int], Asked]) -> Callable[[int, int], Asked]:
    """Lists a kind of picture, made of its width and height (px)."""
    KINDS[make.__name__] = make
    return make


def boxes(width: int, height: int) -> tuple[list[int], list[int]]:
    """Where the red and the blue box are, [x0, y0, x1, y1] px."""
    side, top = width // 10, height // 2
    return [side, top, 2 * side, top + side], [5 * side, top, 6 * side, top + side]


def drawn(width: int, height: int, channels: int = 3) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A red and a blue box on grey."""
    image = np.full((height, width, channels), 200, np.uint8)
    for (x0, y0, x1, y1), colour in zip(boxes(width, height), ((200, 30, 30, 255), (30, 30, 200, 255)), strict=True):
        image[y0:y1, x0:x1] = colour[:channels]
    return image


def given(width: int, height: int) -> dict[str, Any]:
    """A request that says where both boxes are."""
    red, blue = boxes(width, height)
    return {
        "grounding": {"object": "red box", "bbox": red},
        "objects": [{"object": "blue box", "bbox": blue}],
        "motion": {"kind": "linear", "direction": [1, 0]},
    }


def png_url(pixels: Any) -> str:
    """A data URL."""
    return "data:image/png;base64," + base64.b64encode(encode_png(pixels)).decode()


@kind
def drawing(width: int, height: int) -> Asked:
    """Flat colours."""
    return encode_png(drawn(width, height)), given(width, height)


@kind
def read(width: int, height: int) -> Asked:
    """The same, with nothing given but the question."""
    return encode_png(drawn(width, height)), {}


@kind
def photograph(width: int, height: int) -> Asked:
    """An example enlarged, with the noise of a sensor."""
    return of_size(width * height / 1e6)


@kind
def noise(width: int, height: int) -> Asked:
    """Every pixel random, but for the boxes."""
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    for (x0, y0, x1, y1), colour in zip(boxes(width, height), ((30, 30, 200), (200, 30, 30)), strict=True):
        image[y0:y1, x0:x1] = colour
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])
    return encoded.tobytes(), given(width, height)


@kind
def progressive(width: int, height: int) -> Asked:
    """A photograph whose decoder holds all coefficients until its last scan."""
    image, request = of_size(width * height / 1e6)
    pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    return encoded.tobytes(), request


@kind
def transparent(width: int, height: int) -> Asked:
    """A drawing with an alpha channel."""
    return encode_png(drawn(width, height, 4)), given(width, height)


@kind
def grey16(width: int, height: int) -> Asked:
    """A drawing in grey of 16 bits."""
    return encode_png(drawn(width, height)[..., 0].astype(np.uint16) * np.uint16(257)), given(width, height)


@kind
def objects(width: int, height: int) -> Asked:
    """Forty separate things."""
    image, request = of_objects(40)
    pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    factor = width / pixels.shape[1]
    large = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_NEAREST)[..., ::-1]
    x0, y0, x1, y1 = request["grounding"]["bbox"]
    across, down = factor, height / pixels.shape[0]
    box = [x0 * across, y0 * down, x1 * across, y1 * down]
    return encode_png(np.ascontiguousarray(large, np.uint8)), {**request, "grounding": {"object": "ball", "bbox": box}}


@kind
def masks(width: int, height: int) -> Asked:
    """A drawing with the masks of the mover and of sixteen things."""
    request, (red, blue) = given(width, height), boxes(width, height)

    def mask(x0: int, y0: int, x1: int, y1: int) -> str:
        found = np.zeros((height, width), bool)
        found[y0:y1, x0:x1] = True
        return png_url(found)

    side = (blue[2] - blue[0]) // 5
    things = [
        {
            "object": f"thing {at}",
            "mask": mask(x := blue[0] + at % 4 * side, y := blue[1] + at // 4 * side, x + side // 2, y + side // 2),
        }
        for at in range(MASKS)
    ]
    return encode_png(drawn(width, height)), {
        **request,
        "grounding": {"object": "red box", "mask": mask(*red)},
        "objects": things,
    }


@kind
def depth(width: int, height: int) -> Asked:
    """A drawing with a depth map, of a floor seen from above it."""
    rows = np.linspace(6000, 2000, height).astype(np.uint16)
    far = np.repeat(rows[:, None], width, axis=1)
    return encode_png(drawn(width, height)), {**given(width, height), "depth": {"map": png_url(far), "scale": 0.001}}


@kind
def changes(width: int, height: int) -> Asked:
    """A drawing of which the blue box is taken away, with the frames of the scene as it is."""
    request = given(width, height)
    taken = {"kind": "remove", "object": "blue box"}
    return encode_png(drawn(width, height)), {**request, "interventions": [taken]}


@kind
def arrow(width: int, height: int) -> Asked:
    """The photograph with an arrow drawn over it, which is erased."""
    image, request = of_size(width * height / 1e6)
    pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    x0, y0, x1, y1 = (round(side) for side in request["grounding"]["bbox"])
    start, tip = (x1 + (x1 - x0) // 2, (y0 + y1) // 2), (x1 + 3 * (x1 - x0), (y0 + y1) // 2)
    cv2.arrowedLine(pixels, start, tip, (60, 20, 255), max(4, width // 160), cv2.LINE_AA, 0, 0.25)
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return encoded.tobytes(), {"grounding": request["grounding"]}


def reset_peak(process: psutil.Process) -> None:
    """Forgets the largest resident set of a process."""
    Path(f"/proc/{process.pid}/clear_refs").write_text("5")


def measure(megapixels: list[float], names: list[str]) -> dict[str, Any]:
    """Peaks by kind and size."""
    figures: dict[str, Any] = {"cores": os.cpu_count()}
    os.environ |= {"COW_CONCURRENCY": "1", "COW_MAX_BODY_MB": "100"}
    for size in megapixels:
        height = round(math.sqrt(size * 1e6 * 3 / 4))
        width = round(height * 4 / 3)
        with tempfile.TemporaryDirectory() as data:
            started, address, _ = start_server(Path(data))
            server = psutil.Process(started.pid)
            try:
                for name in names:
                    row = figures.setdefault(f"{size:g} MP", {})
                    row[name] = peaks(server, address, *KINDS[name](width, height))
                    print(f"{size:g} MP", name, row[name], flush=True)
            finally:
                started.terminate()
                started.wait()
    return figures


def peaks(server: psutil.Process, address: str, image: bytes, request: dict[str, Any]) -> dict[str, Any]:
    """MB of one job."""
    for process in (server, *server.children()):
        reset_peak(process)
    asked = {"seed": 1, "live": "interventions" not in request, "video": True, **request}
    with httpx.Client(base_url=address, timeout=600) as client:
        files = {"image": ("picture", image)}
        reply = client.post("/simulate", files=files, data={"question": QUESTION, "request": json.dumps(asked)})
        if reply.status_code != 200:
            print(reply.text[:300], file=sys.stderr)
        figures: dict[str, Any] = {"status": reply.status_code, "server": round(peak_memory_mb(server.pid))}
        figures["worker"] = round(max(peak_memory_mb(each.pid) for each in server.children()))
        figures["together"] = figures["server"] + figures["worker"]
        if reply.status_code == 200:
            reset_peak(server)
            for wanted in FORMATS:
                client.get(f"/jobs/{reply.json()['id']}/download", params={"format": wanted})
            figures["download"] = round(peak_memory_mb(server.pid))
        return figures


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megapixels", type=float, nargs="+", default=[2, 8, 24])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    figures = measure(arguments.megapixels, arguments.kinds)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
